"""`ccdtools codesign` as a stranger uses it."""

import csv
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ccdtools import Search
from ccdtools.cli import main

CCDTOOLS = [sys.executable, "-m", "ccdtools", "codesign"]


def command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    return subprocess.run([*CCDTOOLS, *arguments], cwd=cwd, capture_output=True, text=True, timeout=500)


def left(monkeypatch, *arguments: str) -> int:
    """How the command ends in this process."""
    monkeypatch.setattr(sys, "argv", ["ccdtools", "codesign", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


@pytest.mark.check
def test_the_table_is_printed_and_kept(tmp_path, monkeypatch, capsys):
    asked = ("--methods", "nested-lqr,sequential", "--seed", "2", "--output", "kept")
    done = command("illustrative", *asked, cwd=tmp_path)
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
    again = ("illustrative", "--methods", "nested-lqr", "--out", "kept")
    monkeypatch.chdir(tmp_path)
    assert left(monkeypatch, *again) == 2
    refused = capsys.readouterr().err
    assert "--output" in refused
    assert "resume" not in refused  # a comparison is not a run
    assert left(monkeypatch, *again, "--overwrite") == 0
    with (tmp_path / "kept" / "methods.csv").open(encoding="utf-8") as file:
        assert [row["method"] for row in csv.DictReader(file)] == ["nested LQR"]


def test_a_folder_of_something_else_is_not_overwritten(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("x")
    refused = command("illustrative", "--methods", "nested-lqr", "--out", "thesis", "--overwrite", cwd=tmp_path)
    assert refused.returncode == 2
    assert "holds no methods.csv" in refused.stderr
    assert [file.name for file in (tmp_path / "thesis").iterdir()] == ["chapter.tex"]


@pytest.mark.long
@pytest.mark.parametrize(("methods", "said"), [("nested-lqr,cma-es", "have ended:"), ("cma-es", "No method has")])
def test_an_interrupted_comparison_says_what_has_ended(methods, said, tmp_path, monkeypatch, capsys):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Search, "run", interrupted)
    assert left(monkeypatch, "illustrative", "--methods", methods, "--out", "kept") == 130
    out = capsys.readouterr().out
    assert said in out
    assert ("Their table: " in out) == ("nested" in methods)


@pytest.mark.check
def test_an_interruption_loses_only_the_method_that_it_falls_in(tmp_path):
    asked = ("illustrative", "--methods", "sequential,nested-lqr,pathwise", "--out", "kept")
    process = subprocess.Popen(
        [*CCDTOOLS, *asked], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    table = tmp_path / "kept" / "methods.csv"
    deadline = time.monotonic() + 300
    while not (table.is_file() and "nested LQR" in table.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)  # the next method is named
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert "now pathwise: 2 of 3" in err
    assert "Interrupted. The methods that have ended:" in out
    assert "Equal within 0.5 %" in out
    with table.open(encoding="utf-8") as file:
        assert [row["method"] for row in csv.DictReader(file)] == ["sequential", "nested LQR"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("nowhere",), "study"), (("illustrative", "--methods", "magic"), "--methods"),
        (("illustrative", "--seed", "x"), "--seed"), (("illustrative", "--jobs", "0"), "--jobs"),
    ],
)  # fmt: skip
def test_misuse_is_one_line(arguments, word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert left(monkeypatch, *arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"ccdtools: {word}")
    assert said.count("\n") == 1
