"""Every tolerance of `ccdtools.evidence`, with its meaning."""

NOT_WORSE = 0.005  # A candidate that loses less than this part of the size of a return [-] is called not worse.
