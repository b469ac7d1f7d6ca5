"""Draw the picture 'recoverable' of start/ten_minutes.md."""

from _page import run, save

save(run("start/ten_minutes.md")["recoverable"], __file__)
