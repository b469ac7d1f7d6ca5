"""`ccdtools reproduce` as a stranger uses it."""

import csv
import sys

import pytest

from ccdtools.cli import main


def left(monkeypatch, *arguments: str) -> int:
    """How the command ends in this process."""
    monkeypatch.setattr(sys, "argv", ["ccdtools", "reproduce", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def test_two_budgets_at_once_are_refused(monkeypatch, capsys):
    assert left(monkeypatch, "--quick", "--paper-budgets") == 2
    assert "--paper-budgets" in capsys.readouterr().err


def test_a_folder_of_another_run_is_neither_continued_nor_overwritten(tmp_path, monkeypatch, capsys):
    (tmp_path / "run.json").write_text('{"another": 1}')
    assert left(monkeypatch, "--quick", "--output", str(tmp_path)) == 2
    assert "begun as something else" in capsys.readouterr().err
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("x")
    assert left(monkeypatch, "--quick", "--output", str(tmp_path / "thesis"), "--overwrite") == 2
    assert (tmp_path / "thesis" / "chapter.tex").is_file()


@pytest.mark.check
@pytest.mark.timeout(1800)
def test_every_row_is_filled_and_a_second_command_computes_nothing_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CCDTOOLS_DATA", str(tmp_path))  # where no road is
    out = tmp_path / "paper"
    assert left(monkeypatch, "--quick", "--output", str(out), "--jobs", "2") == 0
    table = capsys.readouterr().out
    with (out / "rows.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 50
    assert all(row["ours"] != "—" and row["verdict"] != "not measured" for row in rows)
    by_row = {(row["case"], row["row"]): row for row in rows}
    rmse = by_row["illustrative", "RMSE of the median, all states"]
    assert rmse["verdict"].startswith("cannot be, because the noise")
    after = by_row["suspension", "return after it, by default"]
    assert after["verdict"].startswith("better")
    assert float(after["mean"]) > -55  # the corner of the box; −82.1 in the paper
    second = [row["verdict"] for row in rows if "generation 2" in row["row"]]
    assert len(second) > 15
    assert all("beside generation 1; " in said and "redesigns deployed" in said for said in second)
    road = by_row["suspension", "RMSE of the median, all states"]
    assert road["verdict"].endswith("(on a generated road: the recorded one is not at hand)")
    assert "QUICK" in table
    for name in {row["figure"] for row in rows} - {""}:
        assert (out / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"id='{name}'" in (out / "paper.html").read_text(encoding="utf-8")
    written = {path: path.stat().st_mtime_ns for path in (out / "stages").glob("*/manifest.json")}
    assert left(monkeypatch, "--quick", "--output", str(out)) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "stages").glob("*/manifest.json")} == written
    assert capsys.readouterr().out.splitlines()[-20:] == table.splitlines()[-20:]
