"""Run every notebook in place and keep what it shows: ``python docs/run_notebooks.py [01 03]``, as `make notebooks`."""

import base64
import io
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
COLOURS = 256  # of a kept figure, which makes it half as large


def in_few_colours(png: str) -> str:
    """The picture with a palette."""
    figure = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    kept = io.BytesIO()
    figure.save(kept, "PNG", optimize=True)
    return base64.b64encode(kept.getvalue()).decode()


def trimmed(cell: nbformat.NotebookNode) -> None:
    """Leave progress lines out, and make the figures small."""
    cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    for output in cell.outputs:
        if "image/png" in output.get("data", {}):
            output.data["image/png"] = in_few_colours(output.data["image/png"])


for path in sorted(NOTEBOOKS.glob("*.ipynb")):
    if path.name.startswith(tuple(sys.argv[1:]) or ""):
        notebook = nbformat.read(path, as_version=4)
        where = {"metadata": {"path": NOTEBOOKS}}
        NotebookClient(notebook, timeout=1800, record_timing=False, resources=where).execute()
        for cell in notebook.cells:
            if cell.cell_type == "code":
                trimmed(cell)
        nbformat.write(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB", flush=True)
