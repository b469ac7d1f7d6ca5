"""The README's code runs as it stands."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.check
def test_readme_code_runs_from_top_to_bottom(tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.S)
    assert len(blocks) >= 4
    monkeypatch.chdir(tmp_path)
    namespace: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), namespace)
    assert namespace["u0"].shape == (1,)
    assert {score.controller for score in namespace["table"]} == {"passive", "LQR", "PID", "MPC", "learned"}
    learned = next(s for s in namespace["table"] if s.controller == "learned")
    lqr = next(s for s in namespace["table"] if s.controller == "LQR")
    assert learned.paired_to_lqr.ci95[0] > -0.005 * abs(lqr.summary.mean)  # not worse


def test_every_file_the_readme_links_to_exists():
    text = README.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if not link.startswith("https://")]
    missing = [link for link in links if not (README.parent / link).exists()]
    assert missing == []
