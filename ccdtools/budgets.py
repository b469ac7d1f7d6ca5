"""Budgets of `ccdtools`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

STRETCHES = 40  # A single long run is cut into at least so many stretches.
REPEAT_INTERRUPT = 1.0  # An interruption that nobody has felt comes again after this time [s].
SECONDS_BETWEEN_LINES = 10.0  # Lines of text about the progress are this far apart [s].

# --- statistics ------------------------------------------------------------------------------------------------------
BATCHES = 20  # The correlation of so many parts of a series decides on its interval, which needs as many samples.
