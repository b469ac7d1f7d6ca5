"""The notebook runs and is stored without outputs, and the page for users of MPT3 names what there is."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]


@pytest.mark.check
def test_notebook_runs_and_is_stored_without_outputs():
    notebook = nbformat.read(ROOT / "notebooks" / "02_invariant_sets.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    text = str([cell.outputs for cell in code])
    assert "CONVERGED" in text
    assert "image/png" in text


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
