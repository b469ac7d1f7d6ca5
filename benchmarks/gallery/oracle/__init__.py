"""What the best design and policy of each study are worth, computed without the package: NumPy, SciPy, OSQP."""
