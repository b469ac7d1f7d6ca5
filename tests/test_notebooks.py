"""Every notebook runs from top to bottom, and is kept without outputs."""

from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = sorted(Path(__file__).parents[1].joinpath("notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_is_kept_without_outputs(path):
    cells = nbformat.read(path, as_version=4).cells
    assert not any(cell.get("outputs") for cell in cells)


@pytest.mark.check
def test_the_loop_runs_as_the_first_notebook_shows(tmp_path):
    from nbclient import NotebookClient

    path = next(p for p in NOTEBOOKS if p.stem.startswith("01"))
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(o.get("text", "") for c in notebook.cells for o in c.get("outputs", []))
    rows = [line for line in printed.splitlines() if "learned" in line and "[" in line]
    assert len(rows) == 2
    assert float(rows[-1].split("[")[1].split(",")[0]) > 0  # better than LQR on the real plant, after one update


@pytest.mark.check
def test_a_nonlinear_plant_of_ones_own_runs_as_its_notebook_shows(tmp_path):
    from nbclient import NotebookClient

    path = next(p for p in NOTEBOOKS if p.stem.startswith("06"))
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    told = [o["data"]["text/plain"] for c in notebook.cells for o in c.get("outputs", []) if "data" in o]
    table = next(text for text in told if "learned, observed" in text)
    means = {line[:20].strip(): line[20:31] for line in table.splitlines()[1:]}
    rows = {name: float(means[name]) for name in ("learned", "LQR", "learned, observed", "passive")}
    assert rows["learned"] > 1.02 * rows["LQR"]  # returns are negative: hardly worse, if at all
    assert rows["learned, observed"] > 2 * rows["learned"]
    assert rows["passive"] < 1.5 * rows["LQR"]


def printed_by(stem, folder):
    from nbclient import NotebookClient

    notebook = nbformat.read(next(p for p in NOTEBOOKS if p.stem.startswith(stem)), as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}}).execute()
    return "".join(o.get("text", "") for c in notebook.cells for o in c.get("outputs", []))


@pytest.mark.slow
def test_optimal_control_swings_up_and_keeps_the_track_as_its_notebook_shows(tmp_path):
    lines = printed_by("04", tmp_path).splitlines()
    mpc = [line for line in lines if line.startswith("nonlinear MPC, ")]
    assert len(mpc) == 2
    assert not any("(" in line for line in mpc)  # up from every start
    replayed = next(line for line in lines if line.startswith("replayed"))
    assert replayed.count("(") > 5
    ratio = next(line for line in lines if line.startswith("real-time iteration beside"))
    assert all(abs(float(word)) < 1 for word in ratio.split() if word[0] in "+-" and word != "+-")


@pytest.mark.slow
def test_methods_agree_on_the_suspension_and_not_on_the_mast_as_the_notebook_shows(tmp_path):
    suspension, mast = printed_by("05", tmp_path).split("method  ")[1:3]
    same = next(line for line in suspension.splitlines() if line.startswith("Equal within"))
    assert all(name in same for name in ("sequential", "nested MPC", "simultaneous gain", "CMA-ES", "learned"))
    worse = {line.split(":")[0] for line in mast.splitlines() if " worse than nested LQR" in line}
    assert {"sequential", "nested Riccati", "simultaneous"} <= worse
