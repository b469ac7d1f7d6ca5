"""Every tolerance of `ccdtools.evidence`, with its meaning."""

NOT_WORSE = 0.005  # A loss or a change below this part of the size of a return or a metric [-] does not matter.
