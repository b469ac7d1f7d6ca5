"""Every tolerance of `ccdtools.disturbances`, with its meaning."""

SAMPLING = 1e-3  # The steps of a recording may differ from each other and from dt by this part of themselves [-].
