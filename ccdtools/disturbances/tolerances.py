"""Tolerances of `ccdtools.disturbances`."""

SAMPLING = 1e-3  # The steps of a recording may differ from each other and from dt by this part of themselves [-].
