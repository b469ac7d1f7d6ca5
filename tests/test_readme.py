"""The code of the README, and of every stage alone, runs as it stands."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def run(page):
    """Return the blocks of a page and the names that they leave behind."""
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S)
    namespace: dict = {}
    for block in blocks:
        exec(compile(block, page.name, "exec"), namespace)
    return blocks, namespace


@pytest.mark.long
def test_the_readme_is_short_and_its_example_co_designs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (block,), namespace = run(README)
    assert README.read_text(encoding="utf-8").count("\n") <= 120
    assert sum(bool(line.strip()) for line in block.splitlines()) <= 15
    result = namespace["result"]
    assert result.status.settled
    assert result.design == pytest.approx([2.56, 0.49], abs=0.02)


@pytest.mark.check
def test_every_stage_alone_runs_from_top_to_bottom(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks, namespace = run(README.parent / "docs" / "how_to" / "every_stage_alone.md")
    assert len(blocks) >= 4
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
