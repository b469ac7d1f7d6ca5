"""Draw the picture 'controlled' of start/ten_minutes.md."""

from _page import run, save

save(run("start/ten_minutes.md")["controlled"], __file__)
