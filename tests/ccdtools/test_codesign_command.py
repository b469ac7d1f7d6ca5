"""`ccdtools codesign` as a stranger uses it."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest

CCDTOOLS = [sys.executable, "-m", "ccdtools", "codesign"]


def command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    return subprocess.run([*CCDTOOLS, *arguments], cwd=cwd, capture_output=True, text=True, timeout=500)


def test_the_table_is_printed_and_kept(tmp_path):
    done = command("illustrative", "--methods", "nested-lqr,sequential", "--seed", "2", "--out", "kept", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "nested LQR" in done.stdout
    assert "Equal within 0.5 %" in done.stdout  # from (−3.5, −2) both end at the bound
    assert "p upper" in done.stdout
    with (tmp_path / "kept" / "methods.csv").open(encoding="utf-8") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert float(rows["nested LQR"]["p"]) == 3.0
    assert (tmp_path / "kept" / "methods.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "kept" / "methods.html").read_text(encoding="utf-8")
    assert "data:image/png;base64," in page
    assert "<td>nested LQR</td>" in page
    again = command("illustrative", "--methods", "nested-lqr", "--out", "kept", cwd=tmp_path)
    assert again.returncode == 2
    assert "--out" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("nowhere",), "study"), (("illustrative", "--methods", "magic"), "methods"),
        (("illustrative", "--seed", "x"), "--seed"), (("illustrative", "--jobs", "0", "--methods", "nested"), "jobs"),
    ],
)  # fmt: skip
def test_misuse_is_one_line(arguments, word, tmp_path):
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith(f"ccdtools: {word}")
    assert done.stderr.count("\n") == 1
