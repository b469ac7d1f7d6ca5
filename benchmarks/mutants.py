"""Small wrong changes of the library: how many does `make test` see of those that all tests together see?

    python benchmarks/mutants.py --reach                   which test enters which function: once
    python benchmarks/mutants.py [--killed 200] [--seed 0] [--under mpc]    draws mutants until so many were killed
    python benchmarks/mutants.py --thresholds --drawn 50   the numbers of files of tolerances, each tenfold

A mutant is one change of one line: a number tenfold or of the other sign, a comparison or its boundary turned, + for -,
`and` for `or`, a condition negated, a result left out, a call removed. Every mutant stands in a copy of the tree. The
quick tests that enter its function run first, and only where none of them fails the others and the types. A mutant
that no test sees is not counted: it may be right. What was found is kept in ``build/mutants`` and taken up again.

Functions that only a child process enters are held by the tests that start one. Both files there go stale with the
tests: delete them to begin anew.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import house
import numba
import pytest
from reach_of_tests import CHILDREN, PACKAGES, told

ROOT = Path(__file__).resolve().parents[1]
STORE = ROOT / "build" / "mutants"
COPIED = (*PACKAGES, "ccdtools_ground", "tests", "benchmarks", "notebooks", "docs", "pyproject.toml", "README.md",
          "LICENSE", "Makefile", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md")  # fmt: skip
PATIENCE = 4.0  # times what the tests of a mutant took without it
FIRST = 25  # tests that are run by themselves, before all others of a mutant
KERNELS = ROOT / "mpc" / "explicit" / "kernels"
COMPILED = ("mpc/explicit/", "mpc/tolerances.py")  # numba keeps what it compiled of these
TURNED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Add: ast.Sub, ast.Sub: ast.Add,
    ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
FOREIGN = ("casadi", "clarabel", "control", "cvxpy", "daqp", "matplotlib.pyplot", "osqp", "scipy.optimize", "torch")
MIRRORED = {ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE}


def measure_reach(processes: int, arguments: list[str]) -> None:
    """Run the tests once, in a copy whose functions say that they were entered, and keep what each enters."""
    STORE.mkdir(parents=True, exist_ok=True)
    for old in STORE.glob("part.*"):
        old.unlink()
    tree = copied(STORE / "told")
    for path in (path for package in PACKAGES for path in (tree / package).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        path.write_text(told(source, path.relative_to(tree).as_posix()), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "reach_of_tests", *arguments]
    path = os.pathsep.join((str(tree), str(tree / "benchmarks")))
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "REACH": str(STORE / "part")}
    subprocess.run([*command, "-n", str(processes), "--dist", "worksteal"], cwd=tree, env=environment, check=False)
    shutil.rmtree(tree)
    rows = [line for path in sorted(STORE.glob("part.*")) for line in path.read_text(encoding="utf-8").splitlines()]
    (STORE / "reach.jsonl").write_text("\n".join(rows) + "\n", encoding="utf-8")
    print(f"{len(rows)} tests")


def passes(tree: Path, arguments: list[str], limit: float, more: dict[str, str]) -> bool:
    """Run pytest in a tree within a limit [s]; in a copy of this process, which has imported what is not ours."""
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        os.chdir(tree)
        os.environ.update({"PYTHONPATH": os.pathsep.join((str(tree), str(tree / "benchmarks")))} | more)
        numba.core.config.reload_config()
        sys.path[:0] = [str(tree), str(tree / "benchmarks")]
        sink = os.open(tree / "tests.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        code = 1
        try:
            code = pytest.main(["-q", "-p", "no:cacheprovider", *arguments])
        finally:
            os._exit(int(code))
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


# ── mutants ──


def sites(path: Path):
    """Yield every change of a file: (line, what, text before, text after)."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    skipped = {id(part) for node in ast.walk(tree) for part in _no_logic(node)}

    def walk(node):
        if id(node) in skipped:
            return
        for what, new in _changes(node):
            before = ast.get_source_segment(source, node)
            yield node, what, before, new
        for child in ast.iter_child_nodes(node):
            yield from walk(child)

    yield from walk(tree)


def tenfold(path: Path):
    """Yield the change of every number of a file of tolerances to ten times its value, as `sites` does."""
    if path.name != "tolerances.py":
        return
    source = path.read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        if named(node) and node.value is not None and house.numbers(node.value):
            parts = getattr(node.value, "elts", [node.value])
            text = ", ".join(f"10 * ({ast.unparse(part)})" for part in parts)
            yield node.value, "tenfold", ast.get_source_segment(source, node.value), f"({text})"


def named(node: ast.stmt) -> list[str]:
    """Names in capitals that a statement of a module binds."""
    return house.upper_case(node) if isinstance(node, ast.Assign | ast.AnnAssign) else []


def users_of(path: Path, line: int) -> set[str]:
    """Functions that mention the constants stated at a line, or what follows from them; none if there are none."""
    names = {
        name for node in ast.parse(path.read_text(encoding="utf-8")).body
        if node.lineno <= line <= (node.end_lineno or line) for name in named(node)
    }  # fmt: skip
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")] if names else []
    trees = {file: ast.parse(file.read_text(encoding="utf-8")) for file in files}
    for _ in range(2):  # what follows from them, and what follows from that
        bound = [node for tree in trees.values() for node in tree.body if named(node) and _mentioned(node, names)]
        names |= {name for node in bound for name in named(node)}
    mentions = {(file, line) for file, tree in trees.items() for line in _mentioned(tree, names)}
    return {name for file, line in mentions for name in _function_around(file, line)}


def _mentioned(tree: ast.AST, names: set[str]) -> list[int]:
    """Lines that mention one of the names."""
    return [
        node.lineno for node in ast.walk(tree)
        if (isinstance(node, ast.Name) and node.id in names) or (isinstance(node, ast.Attribute) and node.attr in names)
    ]  # fmt: skip


def _no_logic(node):
    """Yield the parts of a node that no test could miss: annotations, decorators, messages, what types alone need."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        yield from filter(None, [node.returns, *node.decorator_list])
    if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None:
        yield node.annotation
    if isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.JoinedStr):
        yield node
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        yield node
    if isinstance(node, ast.ClassDef) and any("Protocol" in ast.unparse(base) for base in node.bases):
        yield node


def _changes(node):
    """Yield (what, new text) of the changes of one node of the syntax tree."""
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        if isinstance(node.value, bool):
            yield "the other truth", repr(not node.value)
        elif math.isfinite(node.value):
            yield "tenfold", repr(node.value * 10 or 1)
            yield "other sign", f"({-node.value!r})" if node.value else "(-1)"
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        for table, what in ((TURNED, "boundary"), (MIRRORED, "turned")):
            if type(node.ops[0]) in table:
                yield what, f"({ast.unparse(ast.Compare(node.left, [table[type(node.ops[0])]()], node.comparators))})"
    numbers = isinstance(node, ast.BinOp) and not isinstance(node.left, ast.Constant | ast.JoinedStr)
    if numbers and type(node.op) in TURNED:
        yield "operator", f"({ast.unparse(ast.BinOp(node.left, TURNED[type(node.op)](), node.right))})"
    if isinstance(node, ast.BoolOp):
        yield "and, or", f"({ast.unparse(ast.BoolOp(TURNED[type(node.op)](), node.values))})"
    signed = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub)
    if signed and not isinstance(node.operand, ast.Constant):
        yield "without its sign", f"({ast.unparse(node.operand)})"
    if isinstance(node, ast.If):
        yield "condition", None
    if isinstance(node, ast.Return) and node.value is not None and not _is_none(node.value):
        yield "no result", "return None"
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        yield "no call", "pass"


def _is_none(node) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def mutated(source: str, node, new: str | None) -> str:
    """The source with one node replaced; a new text of None negates the condition of an `if`."""
    if new is None:
        node = node.test
        new = f"(not ({ast.unparse(node)}))"
    lines = source.encode().split(b"\n")
    first, last = node.lineno - 1, node.end_lineno - 1
    tail = lines[last][node.end_col_offset :]
    lines[first : last + 1] = [lines[first][: node.col_offset] + new.encode() + tail]
    return b"\n".join(lines).decode()


def drawn(seed: int, under: str, thresholds: bool):
    """Yield mutants in a random order: (path, node, what, before, new); of tolerances alone if asked."""
    files = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))
             if path.relative_to(ROOT).as_posix().startswith(under) and path.name != "__init__.py"]  # fmt: skip
    everything = [(path, *site) for path in files for site in (tenfold(path) if thresholds else sites(path))]
    random.Random(seed).shuffle(everything)
    print(f"{len(everything)} possible mutants")
    yield from everything


def enclosing(path: Path, line: int) -> list[str]:
    """Names of the functions around a line, as the plugin names them; those of a whole file where there is none."""
    file = path.relative_to(ROOT).as_posix()
    return _function_around(path, line) or [f"{file}:{start}" for start, _ in _functions(path)]


def _function_around(path: Path, line: int) -> list[str]:
    """Name of the innermost function around a line, if there is one."""
    around = [start for start, end in _functions(path) if start <= line <= end]
    return [f"{path.relative_to(ROOT).as_posix()}:{start}" for start in around[-1:]]


def _functions(path: Path) -> list[tuple[int, int]]:
    """First and last lines of the functions of a file, in order of their first lines."""
    return sorted(
        (min([node.lineno, *(d.lineno for d in node.decorator_list)]), node.end_lineno or node.lineno)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    )


def tests_of(reach: list[dict], path: Path, line: int) -> list[dict]:
    """Tests that enter the function of a line, those that enter little first; for a constant those of its users."""
    names = users_of(path, line) or set(enclosing(path, line))
    compiled = KERNELS.relative_to(ROOT).as_posix()
    if any(name.startswith(compiled) for name in names):  # what is compiled enters no function that Python sees
        found = [row for row in reach if any(entry.startswith("mpc/explicit/exploration") for entry in row["entered"])]
        found += [row for row in reach if names & row["entered"] and row not in found]
    elif not names:
        module = path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
        files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
        users = {file.relative_to(ROOT).as_posix() for file in files if module in file.read_text(encoding="utf-8")}
        found = [row for row in reach if any(entry.rsplit(":", 1)[0] in users for entry in row["entered"])]
    else:
        found = [row for row in reach if names & row["entered"]]
    if path.is_relative_to(ROOT / "ccdtools" / "studies") or path.name == "cli.py":
        found += [row for row in reach if CHILDREN in row["entered"] and row not in found]
    return sorted(found, key=lambda row: row["seconds"] * len(row["entered"]))


def within(rows: list[dict], seconds: float) -> list[dict]:
    """The first tests that together take so long; at least one."""
    total, kept = 0.0, []
    for row in rows:
        total += row["seconds"]
        if kept and total > seconds:
            break
        kept.append(row)
    return kept


def verdict(tree: Path, reach: list[dict], mutant, options) -> dict:
    """Put a mutant into the copy, ask tests and types, and take it out again."""
    path, node, what, before, new = mutant
    place = path.relative_to(ROOT)
    source = path.read_text(encoding="utf-8")
    text = mutated(source, node, new)
    compile(text, str(path), "exec")
    rows = tests_of(reach, path, node.lineno)
    found = {"at": f"{place.as_posix()}:{node.lineno}", "what": what, "tests": len(rows), "killed": ""}
    found |= {"before": (before or "")[:80], "after": (new or "not")[:80]}
    environment = {"NUMBA_CACHE_DIR": str(tree / ".numba")}
    if place.as_posix().startswith(COMPILED):
        environment = {"NUMBA_CACHE_DIR": str(tree / f".numba-{os.getpid()}-{time.monotonic_ns()}")}
    saved = (tree / place).stat()
    (tree / place).write_text(text, encoding="utf-8")
    try:
        for name, quick in (("quick", True), ("others", False)):
            chosen = within([row for row in rows if row["quick"] == quick], options.seconds)
            if chosen and _seen(tree, chosen, environment):
                found["killed"] = name
                break
        if found["killed"] == "others":
            mypy = Path(sys.executable).parent / "mypy"
            found["types"] = bool(subprocess.run([mypy], cwd=tree, capture_output=True).returncode)
    finally:
        (tree / place).write_text(source, encoding="utf-8")
        os.utime(tree / place, ns=(saved.st_atime_ns, saved.st_mtime_ns))  # what is compiled of it is as new
    return found


def _seen(tree: Path, rows: list[dict], environment: dict[str, str]) -> bool:
    """Whether one of the tests fails or hangs: those that take least and enter least first, and by themselves."""
    names = tree / "chosen.txt"
    for part in (rows[:FIRST], rows[FIRST:]):
        names.write_text("\n".join(row["test"] for row in part), encoding="utf-8")
        limit = 120 + PATIENCE * sum(row["seconds"] for row in part)
        if part and not passes(tree, ["-x", f"@{names}"], limit, environment):
            return True
    return False


def copied(place: Path) -> Path:
    """Copy what tests need."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, place / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, place / name)
    return place


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's interval of 95 % of a share."""
    if not trials:
        return 0.0, 1.0
    z = 1.959964
    share = successes / trials
    centre = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
    return centre - half, centre + half


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--reach", nargs="*", metavar="TESTS", help="measure which test enters which function")
    parser.add_argument("--quick", action="store_true", help="with --reach: the quick tests alone")
    parser.add_argument("--thresholds", action="store_true", help="numbers of files of tolerances alone, tenfold")
    parser.add_argument("--killed", type=int, default=200, help="draw until so many mutants were killed")
    parser.add_argument("--drawn", type=int, default=10**9, help="draw no more than so many")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--under", default="", help="a folder of the library")
    parser.add_argument("--processes", type=int, default=2, help="with --reach")
    parser.add_argument("--seconds", type=float, default=600.0, help="processor time for the tests of one mutant")
    options = parser.parse_args()
    if options.reach is not None:
        chosen = "not check and not long and not slow" if options.quick else "not slow"
        measure_reach(options.processes, [*options.reach, "-m", chosen])
        return
    reach = [json.loads(line) for line in (STORE / "reach.jsonl").read_text(encoding="utf-8").splitlines()]
    reach = [row | {"entered": set(row["entered"])} for row in reach if row["passed"]]
    kind = "thresholds" if options.thresholds else "found"
    kept = STORE / f"{kind}-{options.seed}-{options.under.replace('/', '.')}.jsonl"
    done = [json.loads(line) for line in kept.read_text(encoding="utf-8").splitlines()] if kept.exists() else []
    for name in FOREIGN:
        importlib.import_module(name)
    tree = copied(STORE / f"tree-{os.getpid()}")
    try:
        some = random.Random(0).sample([row for row in reach if row["seconds"] < 1 or "report" in row["test"]], 100)
        (tree / "chosen.txt").write_text("\n".join(row["test"] for row in some))
        if not passes(tree, [f"@{tree / 'chosen.txt'}"], 1200.0, {"NUMBA_CACHE_DIR": str(tree / ".numba")}):
            raise SystemExit(f"tests of the library as it is fail in the copy: {tree / 'tests.txt'}")
        for i, mutant in enumerate(drawn(options.seed, options.under, options.thresholds)):
            if i >= options.drawn or sum(bool(row["killed"]) for row in done) >= options.killed:
                break
            if i >= len(done):
                done.append(verdict(tree, reach, mutant, options))
                with kept.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(done[-1]) + "\n")
                row = done[-1]
                by = row["killed"] + (" (types too)" if row.get("types") else "")
                change = f"{row['what']}: {row['before']!r} -> {row['after']!r}"
                print(f"{by or 'lives':20s} {row['at']:55s} {change}", flush=True)
    finally:
        shutil.rmtree(tree, ignore_errors=True)
    killed = [row for row in done if row["killed"]]
    quick = [row for row in killed if row["killed"] == "quick"]
    seen = [row for row in killed if row["killed"] == "quick" or row.get("types")]
    print(f"{len(done)} mutants drawn, {len(killed)} killed by the tests")
    for name, rows in (("by the quick tests", quick), ("by make test (quick tests and types)", seen)):
        low, high = wilson(len(rows), len(killed))
        share = 100 * len(rows) / max(1, len(killed))
        print(f"of these {name}: {len(rows)} ({share:.1f} %, Wilson {100 * low:.1f} to {100 * high:.1f} %)")


if __name__ == "__main__":
    main()
