"""Whether the headline of every study says what its results.json holds: every number, sign and metric that got worse.

    python benchmarks/headlines.py                 # runs all studies with --quick into a temporary folder, then checks
    python benchmarks/headlines.py runs/*          # checks finished runs

The check reads results.json alone and shares no code with the report.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

NUMBER = r"[+−]?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
MATTERS = 0.5  # per cent


def percent(text: str) -> float:
    """A printed per cent as a number."""
    return float(text.replace("−", "-"))


def close(printed: float, true: float) -> bool:
    """Whether a printed number is the true one, rounded as people read it."""
    decimals = 2 if abs(true) < 1 else 1 if abs(true) < 10 else 0
    return abs(printed - true) <= 0.51 * 10.0**-decimals


def worse_metrics(results: dict[str, Any]) -> dict[str, tuple[float, str]]:
    """Metrics that got worse beyond chance and by half a per cent anywhere: the largest change [%], and where."""
    found: dict[str, tuple[float, str]] = {}
    for place in results["gains"]:
        for metric in place["metrics"]:
            low, high = metric["change"]["ci95"]
            change = metric["after"] - metric["before"]
            certain = low is not None and (low > 0 or high < 0)
            if certain and change > 0 and change >= MATTERS / 100 * abs(metric["before"]):
                part = 100 * change / abs(metric["before"]) if metric["before"] else float("inf")
                name = metric["name"].split(" [")[0]
                found[name] = max(found.get(name, (0.0, "")), (part, place["place"]))
    return found


def faults(results: dict[str, Any]) -> list[str]:
    """Everything that the headline says otherwise than the results."""
    text = results["headline"]
    wrong = []
    last = len(results["generations"])
    rows = {(r["generation"], r["controller"]): r for r in results["comparison"] if r["plant"] == "real"}
    before, after = rows[0, "LQR"], rows[last, "learned"]
    first = results["gains"][0]
    if first["start"] and first["total"]["mean"] is not None:  # the runs that the headline is of
        before = before | {"mean": first["start"]}
        after = after | {"mean": first["start"] + first["total"]["mean"]}
    told = re.search(rf"real plant: cost (?:({NUMBER}) %|unchanged)[^(]*\(({NUMBER}) → ({NUMBER})", text, re.I)
    if told is None:
        if before["mean"] is not None and after["mean"] is not None and before["mean"] != 0:
            wrong.append("the cost before and after is not there")
    else:
        size = abs(before["mean"] + before["design_cost"])
        true = 100 * (before["mean"] - after["mean"]) / size
        if told[1] is not None and not close(percent(told[1]), true):
            wrong.append(f"cost {told[1]} %, is {true:.3g} %")
        if told[1] is None and abs(true) >= MATTERS:
            wrong.append(f"cost unchanged, is {true:.3g} %")
        for shown, row in ((told[2], before), (told[3], after)):
            if abs(percent(shown) + row["mean"]) > 6e-4 * abs(row["mean"]):
                wrong.append(f"cost {shown}, is {-row['mean']:.5g}")
    elsewhere = text.split("lsewhere: ")[-1]
    for place in results["gains"][1:]:
        size = abs(place["start"] + place["design_cost"]) if place["start"] else None
        told = re.search(rf"({NUMBER}|n/a)(?: %)? \({re.escape(place['place'])}\)", elsewhere)
        if told is None:
            wrong.append(f"nothing of {place['place']}")
        elif size and not close(percent(told[1]), -100 * place["total"]["mean"] / size):
            wrong.append(f"{place['place']}: {told[1]} %, is {-100 * place['total']['mean'] / size:.3g} %")
    listed = re.search(r"Worse: (.*?)\.(?: [A-Z]|$)", text)
    said = listed[1] if listed else ""
    for name, (change, where) in worse_metrics(results).items():
        told = re.search(rf"{re.escape(name)} ({NUMBER}) %", said)
        place = re.search(rf"{re.escape(name)} [^(,]*\({re.escape(where)}\)", said)
        if where != results["gains"][0]["place"] and place is None:
            wrong.append(f"{name} is worst on {where}, which is not named")
        if told is None:
            wrong.append(f"{name} is worse on {where} and not named")
        elif not close(percent(told[1]), change):
            wrong.append(f"{name} {told[1]} %, is {change:.3g} %")
    if not worse_metrics(results) and said:
        wrong.append(f"says worse: {said}")
    return wrong


def finished(folder: Path) -> list[Path]:
    """Quick runs of all studies, made one after the other."""
    listed = subprocess.run([sys.executable, "-m", "ccdtools", "studies"], capture_output=True, text=True, check=True)
    names = [line.split()[0] for line in listed.stdout.splitlines() if line.strip() and not line.startswith(" ")]
    made = []
    for name in names:
        out = folder / name
        command = [sys.executable, "-m", "ccdtools", "run", name, "--quick", "--output", str(out)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            print(f"{name}: run ended with {done.returncode}: {done.stderr.strip().splitlines()[-1:]}")
        else:
            made.append(out)
    return made


def main(paths: list[str]) -> int:
    """Print a line per run; the number of faults."""
    count = 0
    with tempfile.TemporaryDirectory() as folder:
        for path in [Path(p) for p in paths] or finished(Path(folder)):
            results = json.loads((path / "results.json").read_text(encoding="utf-8"))
            found = faults(results)
            count += len(found)
            worse = ", ".join(worse_metrics(results)) or "nothing"
            print(f"{results['study']:<28} worse: {worse:<60} {'; '.join(found) or 'right'}", flush=True)
    print(f"{count} faults")
    return count


if __name__ == "__main__":
    sys.exit(bool(main(sys.argv[1:])))
