"""The gallery's table names what was missed, what became worse and what broke, and counts the rest."""

import json

import gallery.table
import numpy as np
import pytest
from gallery.measure import Measured, Step, status_of
from gallery.run import Run, carried_out, main
from gallery.table import markdown


def a_run(root, study="servo", start="study", seed=0, exit_code=0):
    """A run that has left its note behind."""
    run = Run(study, start, seed, 3, False, root)
    run.folder.with_suffix(".json").write_text(json.dumps({"exit": exit_code, "seconds": 12.0, "peak_bytes": 2**30}))
    return run


def a_measurement(
    shortfall=0.1, *, error=0.01, steps=(), deployed=(-40.0,), valley=0, beside=np.nan, designed=np.nan, learned=None
):
    """What a run might have reached."""
    end = Step(steps[-1].difference, steps[-1].low, steps[-1].high) if steps else None
    return Measured(
        {"n": 20.0}, shortfall, error, valley, "converged", True, deployed, tuple(steps), 0.0, np.nan, beside,
        at_the_end=end, designed=designed, learned=learned,
    )  # fmt: skip


@pytest.fixture
def table_of(monkeypatch, tmp_path):
    """The table of runs with the measurements given."""

    def table(*measurements, study="servo", broken=0):
        runs = [a_run(tmp_path, study, seed=seed) for seed in range(len(measurements))]
        by_folder = {run.folder: found for run, found in zip(runs, measurements)}
        runs += [a_run(tmp_path, study, seed=100 + k, exit_code=2) for k in range(broken)]
        monkeypatch.setattr(gallery.table, "measured", lambda name, folder: by_folder[folder])
        return markdown(runs)

    return table


def test_a_run_counts_as_near_only_within_half_a_per_cent(table_of):
    text = table_of(a_measurement(0.49), a_measurement(0.9), a_measurement(-0.3))
    assert "within 0.5 % of the independent optimum: 2 of 3" in text
    assert "not: servo from the study, seed 1: 0.90 %, “converged”" in text


def test_a_worse_generation_is_named_with_its_interval(table_of):
    steps = [Step(-2.0, -3.0, -1.0, kept=False), Step(0.5, -0.5, 1.5), Step(2.0, 1.0, 3.0)]
    text = table_of(a_measurement(steps=steps, deployed=(-40.0, -42.0, -41.5, -39.5)))
    assert "deployed and worse beyond the interval than what was deployed before: 1 of 3" in text
    assert "worse: servo from the study, seed 0, generation 2: -2 [-3, -1], rolled back" in text
    assert "deployed at the end and worse beyond the interval than generation 1: 0 of 1" in text
    assert "-40 → -42 ▼ (rolled back) → -41.5 → -39.5 ▲" in text


def test_what_is_deployed_at_the_end_is_named_if_it_is_worse_than_the_first(table_of):
    text = table_of(a_measurement(steps=[Step(-2.0, -3.0, -1.0)], deployed=(-40.0, -42.0)), a_measurement())
    assert "deployed at the end and worse beyond the interval than generation 1: 1 of 1" in text
    assert "worse at the end: servo from the study, seed 0: -2" in text


def test_where_the_truth_pays_the_gain_is_counted_since_what_was_first_designed(table_of):
    """What updates gain during the first deployment was learned of the real plant, too."""
    updated = a_measurement(
        steps=[Step(0.0, -1.0, 1.0)], deployed=(-77.0, -77.0), designed=-80.0, learned=Step(3.0, 2.0, 4.0)
    )
    lost = a_measurement(deployed=(-82.0,), designed=-80.0, learned=Step(-2.0, -3.0, -1.0))
    text = table_of(updated, lost, study="pendulum")
    assert "better in 1 of 2 runs, by -2.5 to 3.8 % from what was first designed" in text
    assert "| -80; -77 → -77 | +3.75 % ▲ |" in text
    assert "| -80; -82 | -2.50 % ▼ |" in text


def test_a_run_that_broke_is_listed_and_not_counted(table_of):
    text = table_of(a_measurement(), broken=1)
    assert "- servo, seed 100, from the study: exit 2" in text
    assert "1 of 1" in text


def test_the_other_valley_is_named(table_of):
    text = table_of(a_measurement(40.0, valley=1), study="beam")
    assert "(valley 2)" in text
    assert "40.00 %, “converged”, the best valley is named" in text


def test_nothing_finished_is_said_so(tmp_path):
    assert markdown([Run("servo", "study", 0, 3, False, tmp_path)]) == "Nothing has finished."


def test_the_status_is_the_sentence_that_the_stage_has_kept():
    assert status_of({"ended": {"status": "AT_BOUND", "meaning": "at a bound"}}) == "at a bound"
    assert status_of({}) == "–"


def test_a_run_from_the_corner_is_told_where_the_corner_is(tmp_path):
    run = Run("servo", "corner", 4, 2, True, tmp_path)
    command = run.command()
    assert "--p0=4.0,0.01" in command
    assert command[command.index("--seed") + 1] == "4"
    assert command[-1] == "--quick"
    run.folder.mkdir()
    (run.folder / "run.json").write_text("{}")
    assert run.command()[-2:] == ["resume", str(run.folder)]


def test_a_finished_run_is_not_carried_out_again(tmp_path, monkeypatch):
    run = a_run(tmp_path)
    monkeypatch.setattr("gallery.run.subprocess.Popen", lambda *a, **k: pytest.fail("it ran again"))
    carried_out(run, 1.0)


def test_an_unknown_study_is_refused_by_name(capsys):
    with pytest.raises(SystemExit):
        main(["nonesuch"])
    assert "unknown studies: nonesuch" in capsys.readouterr().err


@pytest.mark.slow
def test_a_quick_run_of_two_generations_ends_in_a_table(tmp_path):
    main(["servo", "--seeds", "0", "--starts", "corner", "--generations", "2", "--quick", "--output", str(tmp_path)])
    text = (tmp_path / "table.md").read_text()
    assert "| servo | corner | 0 |" in text
    assert "exit" not in text
