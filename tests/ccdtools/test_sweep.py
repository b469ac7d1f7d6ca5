"""A TOML file that states a study with lists of options is run in every combination, and goes on."""

import csv

import pytest

from ccdtools.cli import main

SWEEP = """
study = "illustrative"
quick = true
generations = 1
sets = "none"
seed = [0, 1]
x0 = [-2, -2]
"""


def sweep(monkeypatch, *arguments):
    """Run the command line in this process."""
    monkeypatch.setattr("sys.argv", ["ccdtools", "sweep", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code


@pytest.mark.check
def test_every_combination_is_run_once_and_told_in_one_table(tmp_path, monkeypatch, capsys):
    (tmp_path / "seeds.toml").write_text(SWEEP)
    monkeypatch.chdir(tmp_path)
    assert sweep(monkeypatch, "seeds.toml") in (0, None)
    where = tmp_path / "runs" / "seeds"
    rows = list(csv.DictReader((where / "sweep.csv").read_text().splitlines()))
    assert {(row["run"], row["seed"]) for row in rows} == {("seed-0", "0"), ("seed-1", "1")}
    assert {row["source"] for row in rows} >= {"design", "policy", "total"}
    before = {path: path.stat().st_mtime_ns for path in where.glob("*/results.json")}
    assert len(before) == 2
    capsys.readouterr()
    assert sweep(monkeypatch, "seeds.toml") in (0, None)
    assert capsys.readouterr().out.count("finished before") == 2
    assert {path: path.stat().st_mtime_ns for path in before} == before
    (tmp_path / "seeds.toml").write_text(SWEEP.replace("-2, -2", "-3, -2"))
    assert sweep(monkeypatch, "seeds.toml") == 2
    assert "begun with other options" in capsys.readouterr().err
