"""What an interruption leaves of an experiment, and what is taken for the same task."""

import functools
import os
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import joblib
import numpy as np
import pytest
from scalar_experiment import GAIN, LAWS, PLANT, A, R, by_hand, drawn, found, stopping

from ccdtools import InputError, LinearFeedback, Measurement, QuadraticObjective, Scenario, plant_from_matrices
from ccdtools.controllers import Passive
from ccdtools.plants import BlackBox


def test_a_controller_that_stops_in_one_scenario_keeps_what_it_did_in_others():
    def fragile(design, rng):
        def law(x):
            if np.abs(x).max() > 20:
                raise ZeroDivisionError("beyond")
            return -GAIN * x

        return law

    far = Scenario(PLANT, np.full((7, 1), 30.0), np.zeros((7, 20, 1)))
    result = found({"LQR": LAWS["LQR"], "fragile": fragile}, {"near": drawn, "far": far}, seeds=2)
    near, beyond = result["fragile", "near"], result["fragile", "far"]
    assert near.evidence.gain.mean == pytest.approx(0.0)
    assert near.evidence.lost == (0, 0)
    assert beyond.evidence.lost == (14, 0)
    assert "far: stopped with ZeroDivisionError: beyond" in beyond.remark


def test_a_simulator_that_dies_without_input_loses_no_controller_under_which_it_lives(tmp_path):
    def advance(x, u, w, p):
        if x[0] < 0.3:
            raise OSError("licence lost")
        return 0.9 * x + 0.1 * u

    start = Scenario(BlackBox(advance, nx=1, nu=1, dt=1.0), np.ones((2, 1)), np.zeros((2, 20, 0)))
    laws = {"LQR": lambda design, rng: LinearFeedback([[-1.0]]), "none": lambda design, rng: Passive(1)}
    options = {"seeds": 2, "folder": tmp_path, "metrics": lambda run: {"end": run.states[..., 20, 0].mean()}}
    for _ in range(2):  # the second from the folder
        result = found(laws, start, **options)
        assert result["LQR"].metrics["end"] == pytest.approx(1.0)
        assert result["none"].evidence.lost == (4, 0)
        assert "OSError: licence lost" in result["none"].remark
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.long
def test_a_scenario_in_which_every_controller_stops_stays(tmp_path):
    dead = Scenario(stopping(3.0), [[1.0], [2.0]], [[0.0], [9.0], [0.0]])
    laws = {"LQR": lambda p, rng: LinearFeedback([[0.1]]), "learned": LAWS["learned"]}
    result = found(laws, {"good": drawn, "dead": dead}, seeds=12)
    assert [cell.names[2] for cell in result] == ["good", "good", "dead", "dead"]
    cell = result["learned", "dead"]
    assert (cell.runs, cell.seeds, cell.evidence.lost, cell.evidence.runs) == (2, 12, (24, 24), 24)
    assert result.verdicts == {("learned", ""): "open: n/a on dead, better on 1 of 2"}
    assert {(row["scenario"], row["lost"]) for row in result.rows()} == {("good", False), ("dead", True)}
    assert "12 seeds, 2 or 7 runs of each" in repr(result)
    result.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    for shown in (repr(result), page):
        assert "learned: seed 0: dead: advance: got a function that stops with OSError: the solver failed" in shown


@pytest.mark.parametrize("starts", [[[4.0], [1.0]], [[4.0], [5.0]]])
def test_a_simulator_that_stops_in_the_first_step_is_a_row_that_stopped(starts):
    dead = Scenario(stopping(3.0), starts, np.zeros((2, 20, 1)))
    result = found({"LQR": LAWS["LQR"], "none": lambda p, rng: Passive(1)}, {"good": drawn, "dead": dead}, seeds=2)
    stopped = sum(start > [3.0] for start in starts)
    assert result["none", "good"].evidence.lost == (0, 0)
    assert result["none", "dead"].evidence.lost == (2 * stopped, 2 * stopped)
    assert "dead: advance: got a function that stops with OSError: the solver failed" in result["none", "dead"].remark
    assert f"at step 0, counted from 0. ({stopped} of 2 runs)" in result["none", "dead"].remark
    with pytest.raises(InputError, match="objective"):
        found(LAWS, dead, seeds=2, objective=QuadraticObjective(np.eye(2), [[1.0]]))


def test_a_plant_that_never_works_is_an_error_before_anything_is_made():
    assert found(LAWS, Scenario(stopping(3.0), [[4.0], [1.0]], np.zeros((2, 20, 1))), seeds=2).cells[0].evidence.lost
    never = Scenario(stopping(0.5), [[1.0], [2.0]], np.zeros((2, 20, 1)))
    with pytest.raises(InputError, match="advance: got a function that stops with OSError"):
        found({"LQR": lambda p, rng: pytest.fail("made")}, {"one": never}, seeds=2)


def test_runs_that_end_are_kept_beside_those_that_stop(tmp_path):
    """Returns are those by hand, and a controller's inputs and sensors those of its own runs."""
    rng = np.random.default_rng(4)
    start = rng.uniform(-1, 1, (50, 1))
    start[[7, 30, 31]] = 4.0
    w, noise = 0.1 * rng.standard_normal((50, 15, 1)), 0.01 * rng.standard_normal((50, 15, 1))
    of_output = type("OfOutput", (), {"needs": frozenset({"output"}), "__call__": lambda self, x, y: -0.3 * y})
    laws = LAWS | {"sensed": lambda p, rng: of_output()}
    seen = Measurement([[1.0]], noise=noise)
    result, whole = (
        found(laws, Scenario(plant, start, w, output=seen), seeds=2, metrics=lambda run: {"runs": len(run.states)})
        for plant in (stopping(3.0), PLANT)
    )
    ended = np.setdiff1d(np.arange(50), [7, 30, 31])
    for name in laws:
        assert result[name].evidence.lost == (6, 6)
        assert result[name].metrics["runs"] == 47
        assert "(3 of 50 runs)" in result[name].remark
        for one, other in zip(result.records, whole.records):
            np.testing.assert_allclose(one.cells[0].returns[ended], other.cells[0].returns[ended], rtol=1e-12)
            assert np.isnan(one.cells[0].returns[[7, 30, 31]]).all()
    np.testing.assert_allclose(result["LQR"].value.mean, by_hand(GAIN, start[ended], w[ended]).mean(), rtol=1e-12)
    assert result["learned"].word != "stopped"  # the baseline stops in these runs, too
    assert result["learned"].better.mean == pytest.approx(whole["learned"].better.mean, abs=3 / 47)


@pytest.mark.parametrize("bump", [0.0, 9.0])
def test_what_was_trained_is_not_trained_again_where_one_run_or_all_stopped(tmp_path, bump):
    calls = tmp_path / "calls"

    def trained(design, rng):
        with calls.open("a") as file:
            file.write(".")
        return LinearFeedback([[GAIN]])

    dead = Scenario(stopping(3.0), [[1.0], [4.0]], [[bump], [0.0], [0.0]])
    one, other = (found({"PPO": trained}, {"good": drawn, "dead": dead}, seeds=2, folder=tmp_path / "kept")
                  for _ in range(2))  # fmt: skip
    assert len(calls.read_text()) == 2
    np.testing.assert_equal(one.rows(), other.rows())
    assert repr(one).splitlines()[-1] == repr(other).splitlines()[-1]
    for file in (tmp_path / "kept").glob("*.stopped.npz"):
        file.unlink()
    found({"PPO": trained}, {"good": drawn, "dead": dead}, seeds=2, folder=tmp_path / "kept")
    assert len(calls.read_text()) == 4


@pytest.mark.check
def test_two_processes_and_a_dask_cluster_find_the_same_bits():
    distributed = pytest.importorskip("dask.distributed")
    rows = found().rows()
    assert found(jobs=2).rows() == rows
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster), joblib.parallel_config(backend="dask"),
    ):  # fmt: skip
        assert found(jobs=2).rows() == rows


KILLED = """
import os, sys
sys.path.insert(0, {folder!r})
import scalar_experiment as t
def dying(design, rng):
    if len(os.listdir(sys.argv[1])) == 3:
        os.kill(os.getpid(), 9)
    return t.LAWS["learned"](design, rng)
t.found({{"LQR": t.LAWS["LQR"], "learned": dying}}, folder=sys.argv[1])
"""


@pytest.mark.long
def test_a_killed_experiment_goes_on_where_it_was(tmp_path):
    script = KILLED.format(folder=str(Path(__file__).parents[2] / "cases"))
    ended = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, check=False)
    assert ended.returncode == -9, ended.stderr.decode()
    kept = {path.name for path in tmp_path.glob("*.npz")}
    assert len(kept) == 3
    assert found(folder=tmp_path).rows() == found().rows()
    assert kept < {path.name for path in tmp_path.glob("*.npz")}


def test_threads_may_share_a_folder(tmp_path):
    scenario = drawn(np.random.default_rng(0))
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: found(scenarios=scenario, folder=tmp_path), range(4)))
    assert len({result["learned"].evidence.gain for result in results}) == 1
    assert not list(tmp_path.glob("*.partial"))


def test_what_is_finished_is_not_computed_again_and_what_changed_is(tmp_path):
    calls = tmp_path / "calls"  # not a list, which would be part of what the function holds

    def law(design, rng):
        with calls.open("a") as file:
            file.write(".")
        return LinearFeedback([[GAIN]])

    laws = {"LQR": law}
    for options in ({}, {}, {"seeds": 5}, {"objective": QuadraticObjective(Q=[[1.0]], R=[[0.6]])}):
        found(laws, folder=tmp_path / "kept", **options)
    assert len(calls.read_text()) == 4 + 0 + 1 + 4


@pytest.mark.parametrize("change", [
    {"X": ([-40.0], [50.0])}, {"limit": [9.0]}, {"metrics": lambda run: {"end [m]": run.states[0, -1, 0] + 1}},
    {"plants": {"": plant_from_matrices([[0.8]], [[1.0]], [[1.0]], dt=1.0, continuous=False)}},
])  # fmt: skip
def test_a_changed_condition_is_another_task(tmp_path, change):
    base = {"limit": [8.0], "metrics": lambda run: {"end [m]": run.states[0, -1, 0]}, "X": ([-50.0], [50.0])}
    found(folder=tmp_path, seeds=1, **base)
    found(folder=tmp_path, seeds=1, **base | change)
    assert len(list(tmp_path.iterdir())) == 4


def latch(depth):
    """A plant that grips within 0.02 of 0.51, which hardly any run meets."""

    def advance(x, u, w, p):
        return (A * x + u + w) * (1 - depth * (abs(x[0] - 0.51) < 0.01))

    return BlackBox(advance, nx=1, nu=1, nw=1, dt=1.0)


class Costly(QuadraticObjective):
    """An objective of a user's own."""

    dear = 1.0

    def rewards(self, x_next, u, x=None, p=None):
        return -self.dear * (x_next[..., 0] ** 2 + (x_next[..., 0] > 30))


class Dearer(Costly):
    """One that differs far outside alone."""

    def rewards(self, x_next, u, x=None, p=None):
        return -self.dear * (x_next[..., 0] ** 2 + (x_next[..., 0] > 31))


@pytest.mark.parametrize(("one", "other"), [
    ({"metrics": lambda run: {"effort": float(abs(run.inputs[0]).mean())}},
     {"metrics": lambda run: {"effort": float(abs(run.inputs[0]).max())}}),
    ({"plants": {"": latch(0.0)}}, {"plants": {"": latch(0.9)}}),
    ({"objective": Costly([[1.0]], [[1.0]])}, {"objective": Dearer([[1.0]], [[1.0]])}),
    ({"scenarios": Scenario(latch(0.0), [[1.0]], np.zeros((4, 1)))},
     {"scenarios": Scenario(latch(0.9), [[1.0]], np.zeros((4, 1)))}),
    ({"scenarios": Scenario(PLANT, [[1.0]], np.zeros((4, 1)), output=lambda x: x * (x < 77))},
     {"scenarios": Scenario(PLANT, [[1.0]], np.zeros((4, 1)), output=lambda x: x * (x < 78))}),
])  # fmt: skip
def test_what_was_given_tells_tasks_apart_not_what_it_shows(tmp_path, one, other):
    for given, files in ((one, 2), (one, 2), (other, 4), (one, 4)):
        found(folder=tmp_path, seeds=1, **given)
        assert len(list(tmp_path.iterdir())) == files


def test_what_cannot_be_told_is_computed_anew(tmp_path):
    held = memoryview(b"which has no content that can be copied")
    for files in (2, 4):
        found(folder=tmp_path, seeds=1, metrics=lambda run: {"bytes": len(held)})
        assert len(list(tmp_path.iterdir())) == files


def test_a_damaged_record_is_named(tmp_path):
    found(folder=tmp_path, seeds=1)
    file = next(tmp_path.iterdir())
    file.write_bytes(b"nothing")
    with pytest.raises(InputError, match=f"folder: got .*{file.name}"):
        found(folder=tmp_path, seeds=1)


@pytest.mark.long
def test_a_process_that_dies_is_named(tmp_path):
    def dies(design, rng):
        os._exit(9)

    with pytest.raises(InputError, match=r"jobs: got a process that ended at .*, seed 0, or at what follows it"):
        found(LAWS | {"dies": dies}, seeds=1, jobs=2, folder=tmp_path)


def test_a_law_that_cannot_be_sent_to_a_process_is_named(tmp_path):
    @functools.cache
    def kept():
        return LinearFeedback([[GAIN]])

    laws = LAWS | {"kept": lambda design, rng: kept()}
    with pytest.raises(InputError, match=r"jobs: got what cannot be sent to a process \(.*pickle.*, expected jobs=1"):
        found(laws, seeds=1, jobs=2, folder=tmp_path)
    assert found(laws, seeds=1, folder=tmp_path)["kept"].value.mean == found(seeds=1)["LQR"].value.mean


def still(noise=None, C=None, reference=None, w=None):
    """A run from rest that nothing moves before the fifth sample."""
    later = np.zeros((15, 1))
    later[4:] = 1.0 if w is None else w
    output = None if C is None else Measurement(C, noise=noise)
    return Scenario(PLANT, [[0.0]], later, reference=reference, output=output, seed=1)


BUMPED = plant_from_matrices([[A]], [[3.0]], [[1.0]], dt=1.0, continuous=False)
FASTER = plant_from_matrices([[0.5]], [[1.0]], [[1.0]], dt=1.0, continuous=False)


@pytest.mark.parametrize("change", [
    {"plants": {"": BUMPED}}, {"plants": {"": FASTER}}, {"objective": QuadraticObjective(Q=[[5.0]], R=[[R]])},
    {"objective": QuadraticObjective(Q=[[1.0]], R=[[9.0]])}, {"scenarios": still(C=[[1.0]], reference=[3.0])},
    {"scenarios": still(C=[[2.0]])}, {"scenarios": still(C=[[1.0]], noise=[3.0])},
    {"scenarios": still(C=[[1.0]], w=2.0)},
    {"metrics": lambda run: {"end [m]": 1.0 + float(run.states[0, -1, 0] > 2)}},
])  # fmt: skip
def test_no_record_is_taken_for_other_conditions(tmp_path, change):
    base = {
        "scenarios": still(C=[[1.0]], reference=[1.0]),
        "plants": {"": PLANT},
        "metrics": lambda run: {"end [m]": 1.0},
    }
    found(folder=tmp_path, seeds=1, **base)
    before = set(tmp_path.iterdir())
    found(folder=tmp_path, seeds=1, **base)
    assert set(tmp_path.iterdir()) == before
    found(folder=tmp_path, seeds=1, **base | change)
    assert len(set(tmp_path.iterdir()) - before) == 2


def test_where_a_controller_stopped_is_told():
    def brittle(design, rng):
        def law(x):
            if np.abs(x).max() > 50:
                raise RuntimeError("too far")
            return -GAIN * x

        return law

    far = Scenario(PLANT, [[99.0]], np.zeros((3, 1)))
    result = found({"LQR": LAWS["LQR"], "brittle": brittle}, {"near": drawn, "far": far}, seeds=1)
    assert "seed 0: far: " in result["brittle", "far"].remark


def test_runs_and_steps_by_chance_beyond_all_numbers_are_lost_without_a_warning(tmp_path):
    steep = BlackBox(lambda x, u, w, p: 0.5 * x + np.exp(0.1 * u), nx=1, nu=1, dt=1.0)
    # e^500 is a number, and its square is none
    start = Scenario(steep, np.zeros((3, 1)), np.zeros((3, 4, 0)))
    laws = {"LQR": lambda design, rng: LinearFeedback([[0.1]]),
            "wild": lambda design, rng: lambda x: np.full((len(x), 1), 5000.0)}  # fmt: skip
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")  # as an error it would be one of the simulator
        result = found(laws, start, seeds=1, folder=tmp_path)
    assert not said
    assert result["wild"].evidence.lost == (3, 0)
