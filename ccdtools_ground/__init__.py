"""What all four packages stand on: one vocabulary of errors and one check of numbers. Not for users."""
