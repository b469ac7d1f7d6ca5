"""Draw the picture 'falling' of start/ten_minutes.md."""

from _page import run, save

save(run("start/ten_minutes.md")["falling"], __file__)
