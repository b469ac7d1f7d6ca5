"""Common errors and number checks of the other packages; internal."""
