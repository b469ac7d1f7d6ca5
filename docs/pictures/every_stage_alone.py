"""Draw the picture of how_to/every_stage_alone.md: its closed loop of MPC."""

import re

from _page import DOCS, save

text = (DOCS / "how_to/every_stage_alone.md").read_text(encoding="utf-8")
names: dict = {}
for block in re.findall(r"```python\n(.*?)```", text, re.S)[:3]:
    exec(block, names)
save(names["run"].plot(), __file__)
