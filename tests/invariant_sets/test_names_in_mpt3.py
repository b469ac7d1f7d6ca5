"""The page for users of MPT3 names what there is."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_name_on_the_mpt3_page_exists():
    import invariant_sets
    from invariant_sets import ParametricSet, Polytope

    text = (ROOT / "docs" / "reference" / "names_in_mpt3.md").read_text(encoding="utf8")
    ours = [line.split(" | ")[1] for line in text.splitlines() if line.startswith("|") and line.count(" | ") == 1]
    assert len(ours) > 35
    for cell in ours:
        for code in re.findall(r"`([^`]*)`", cell):
            for name in re.findall(r"\b(?:P|Q)\.(\w+)", code):
                assert hasattr(Polytope, name) or name in Polytope.__dataclass_fields__
            for name in re.findall(r"(?<![.\w])([a-z]+_[a-z_]+)\(", code):
                assert name in invariant_sets.__all__
            for name in re.findall(r"^\.(\w+)\(", code):
                assert hasattr(ParametricSet, name)
