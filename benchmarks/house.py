"""The house in numbers: lines, classes, constants, imports, frames, docstrings, pages; a row each.

    python benchmarks/house.py

Constants are upper-case names of modules bound to numbers, or to tuples and dictionaries with numbers. Chains are of
imports at the top of modules. Pages are those of README and `docs`, without `reference` and `benchmarks`.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("ccdtools_ground", "invariant_sets", "learning", "mpc", "ccdtools")
FILES = {path: ast.parse(path.read_text(encoding="utf-8")) for name in PACKAGES for path in (ROOT / name).rglob("*.py")}
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): tree
    for path, tree in FILES.items()
}
HOMES = {  # public names, and the modules that hold them
    f"{'.'.join(stub.parent.relative_to(ROOT).parts)}.{alias.name}": node.module or ""
    for name in PACKAGES for stub in (ROOT / name).rglob("__init__.pyi")
    for node in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)
    for alias in node.names
}  # fmt: skip
MID_SENTENCE = ("And", "As", "At", "Beside", "By", "From", "In", "Its", "Of", "On", "That", "The same", "Their",
                "Those", "To", "With")  # fmt: skip


def constants() -> tuple[int, int]:
    """Numeric constants of all modules, and those outside files of tolerances and budgets."""
    where = [path for path, tree in FILES.items() for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)
             and node.value is not None and numbers(node.value) for _ in upper_case(node)]  # fmt: skip
    return len(where), sum(path.name not in ("tolerances.py", "budgets.py") for path in where)


def numbers(value: ast.expr) -> bool:
    """Whether a value is made of numbers, and of no call."""
    parts = list(ast.walk(value))
    found = any(isinstance(p, ast.Constant) and type(p.value) in (int, float) for p in parts)
    return found and not any(isinstance(p, ast.Call | ast.Lambda) for p in parts)


def upper_case(node: ast.Assign | ast.AnnAssign) -> list[str]:
    """Upper-case names that a statement binds."""
    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
    names = [part.id for part in getattr(target, "elts", [target]) if isinstance(part, ast.Name)]
    return [name for name in names if re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name)]


def longest_chain() -> int:
    """Modules in the longest chain of imports."""

    @cache
    def depth(name: str) -> int:
        """Modules of the longest chain that begins with one."""
        return 1 + max((depth(other) for other in _imported(name)), default=0)

    return max(map(depth, MODULES))


def _imported(name: str) -> set[str]:
    """Modules of ours that a module imports at its top."""
    found = set()
    for node in MODULES[name].body:
        if isinstance(node, ast.ImportFrom) and node.module:
            parts = {f"{node.module}.{alias.name}" for alias in node.names}
            homes = {HOMES[part] for part in parts if part in HOMES}
            found |= parts & MODULES.keys() | homes or {node.module}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {other for other in found if other in MODULES and other != name}


def modules_before(name: str) -> int:
    """Modules of ours that stand in memory once a public name of `ccdtools` was imported."""
    code = f"import sys; from ccdtools import {name}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return sum(module.split(".")[0] in PACKAGES for module in loaded.split())


def nested_frames() -> tuple[int, int]:
    """Files that a nested co-design enters, and how many frames of ours lie above each other at the deepest place."""
    import ccdtools as cc
    from ccdtools.plants.library import mass_chain

    plant = mass_chain(2)
    space = plant.design
    model = cc.discretise(plant)
    ones = np.ones(model.nx)
    problem = cc.CoDesignProblem(
        model, X=(-ones, ones), U=(-1, 1), steps=20,
        objective=cc.QuadraticObjective(Q=np.eye(model.nx), R=np.eye(model.nu)),
        scenarios=cc.FixedStart(0.1 * ones, cc.Gaussian(np.full(model.nw, 0.01))),
    )  # fmt: skip
    ours = {str(path) for path in FILES}
    files: set[str] = set()
    depths = [0]

    def seen(frame, event, _argument):
        """Count calls and returns of ours."""
        if frame.f_code.co_filename in ours and event in ("call", "return"):
            depths.append(depths[-1] + (1 if event == "call" else -1))
            files.add(frame.f_code.co_filename)

    for watched in (None, seen):  # modules are imported at the first call
        sys.setprofile(watched)
        cc.codesign(problem, method="nested", design=(space.lower + space.upper) / 2, rng=np.random.default_rng(0))
    sys.setprofile(None)
    return len(files), max(depths)


def first_lines() -> list[str]:
    """First lines of all docstrings."""
    kinds = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = (node for tree in FILES.values() for node in ast.walk(tree) if isinstance(node, kinds))
    return [text.splitlines()[0] for node in nodes if (text := ast.get_docstring(node))]


def sentences(text: str) -> list[str]:
    """Sentences of a page, code, tables and headings left out."""
    text = re.sub(r"```.*?```", "", text, flags=re.S)
    lines = [line for line in text.splitlines() if not line.lstrip().startswith(("|", "#", "!["))]
    paragraphs = re.split(r"\n\s*\n|\n(?=\s*[-*] |\s*\d+\. )", "\n".join(lines))
    return [one for part in paragraphs for one in re.split(r"(?<=[.!?:;])\s", " ".join(part.split())) if one]


def pages() -> dict[Path, str]:
    """README and the pages of the guides."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    guides = [page for page in found if not {"reference", "benchmarks"} & set(page.relative_to(ROOT).parts)]
    return {page: page.read_text(encoding="utf-8") for page in guides}


def main() -> None:
    """Print the table."""
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in FILES)
    classes = sum(isinstance(node, ast.ClassDef) for tree in FILES.values() for node in ast.walk(tree))
    first = first_lines()
    middle = sum(line.startswith(tuple(f"{word} " for word in MID_SENTENCE)) for line in first)
    texts = pages()
    words = [len(one.split()) for text in texts.values() for one in sentences(text)]
    rows = {
        "library lines": (lines, 47_000),
        "classes": (classes, 330),
        "numeric constants; outside files of tolerances and budgets": (constants(), (400, 60)),
        "longest chain of imports, modules": (longest_chain(), 22),
        "modules before Gaussian, Plant, codesign": (
            tuple(map(modules_before, ("Gaussian", "Plant", "codesign"))), (12, 25, 140)),
        "nested co-design: files entered; deepest frame": (nested_frames(), (25, 14)),
        "docstrings that begin in the middle; mean words of first lines": (
            (middle, round(float(np.mean([len(line.split()) for line in first])), 1)), (0, 10)),
        "words of guides": (sum(len(text.split()) for text in texts.values()), 12_000),
        "sentences over 40 words": (f"{np.mean(np.array(words) > 40):.1%}", "< 1 %"),
        "pages without a picture": (sum("![" not in text and "{image}" not in text for text in texts.values()), 0),
        "longest page, lines": (max(len(text.splitlines()) for text in texts.values()), 150),
    }  # fmt: skip
    print("| | here | required |\n|---|---|---|")
    for name, (got, required) in rows.items():
        print(f"| {name} | {_text(got)} | {'' if isinstance(required, str) else '≤ '}{_text(required)} |")


def _text(value: object) -> str:
    """A number, several, or text."""
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


if __name__ == "__main__":
    main()
