"""Draw the picture 'trade' of start/ten_minutes.md."""

from _page import run, save

save(run("start/ten_minutes.md")["trade"], __file__)
