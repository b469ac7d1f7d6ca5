"""Every notebook runs from top to bottom, and is kept without outputs."""

from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = sorted(Path(__file__).parents[1].joinpath("notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_is_kept_without_outputs(path):
    cells = nbformat.read(path, as_version=4).cells
    assert not any(cell.get("outputs") for cell in cells)


def test_the_loop_runs_as_the_first_notebook_shows(tmp_path):
    from nbclient import NotebookClient

    path = next(p for p in NOTEBOOKS if p.stem.startswith("01"))
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(o.get("text", "") for c in notebook.cells for o in c.get("outputs", []))
    rows = [line for line in printed.splitlines() if "learned" in line and "[" in line]
    assert len(rows) == 2
    assert float(rows[-1].split("[")[1].split(",")[0]) > 0  # better than LQR on the real plant, after one update


def test_a_nonlinear_plant_of_ones_own_runs_as_its_notebook_shows(tmp_path):
    from nbclient import NotebookClient

    path = next(p for p in NOTEBOOKS if p.stem.startswith("06"))
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    told = [o["data"]["text/plain"] for c in notebook.cells for o in c.get("outputs", []) if "data" in o]
    table = next(text for text in told if "learned, observed" in text)
    rows = {line[:20].strip(): float(line[20:31]) for line in table.splitlines()[1:]}
    assert rows["learned"] > 1.02 * rows["LQR"]  # returns are negative: hardly worse, if at all
    assert rows["learned, observed"] > 2 * rows["learned"]
    assert rows["passive"] < 1.5 * rows["LQR"]
