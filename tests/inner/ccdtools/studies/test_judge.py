"""The judge of a redesign has the sign of the truth, however slowly the loop settles, and whatever its units."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study, saturated_lqr, simulate
from ccdtools.co_design.landscape import Landscape
from ccdtools.evidence.evidence import Asked, Pairing
from ccdtools.studies import configuration
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.warm_up import warm_up
from ccdtools.twin import distributions, replay_problem
from ccdtools.twin.residuals import residuals
from invariant_sets import Polytope


def tank(*, wall: str, unit: float, runs: int, steps: int) -> Study:
    """Heat held by a mass C that leaks through a wall: the states are its temperature and that of the wall."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    temperature, outer = x[0] * unit, x[1] * unit
    leak, mass = {"slow": (0.02, p), "fast": (1.0, 0.05 * p)}[wall]
    rates = ca.vertcat((u + w - leak * (temperature - outer)) / mass, 5 * leak * (temperature - 2 * outer))
    plant = Plant(x, u, w, p, rates / unit, DesignSpace(["C"], [0.5], [8.0]), dt=0.1)
    noise = Gaussian([1.0])
    return Study(
        name="tank", title="Tank", plant=plant, X=Polytope.from_bounds([-20 / unit] * 2, [20 / unit] * 2),
        U=Polytope.from_bounds([-0.5], [0.5]), objective=QuadraticObjective(np.diag([1.0, 0.1]) * unit**2, [[0.5]]),
        disturbance=noise, x0=[1 / unit, 0], p0=[4.0], steps=40,
        real=RealPlant(plant, noise, x0=[0, 0], runs=runs, steps=steps),
    )  # fmt: skip


CASES = [("slow", 1.0, 1, 3000), ("slow", 1e-6, 1, 3000), ("fast", 1e3, 1, 3000), ("slow", 1.0, 24, 300),
         ("fast", 1e4, 24, 120)]  # fmt: skip


def logged(study, design):
    """What LQR at a design logs on the plant, and its deployed disturbance."""
    evaluation = Evaluation(study, replace(configuration(study), model_runs=300), 0)
    return evaluation, residuals(study.model, driven(evaluation, design))


def whole_runs(evaluation, logs):
    """Whole logged runs on the nominal model."""
    rng = np.random.default_rng(0)
    return distributions.logged(evaluation.split, logs, series=evaluation.single, most=300, rng=rng)


def compared(evaluation, after, before, on):
    """The paired gain."""
    pairing = Pairing(evaluation.study.objective, stretch=evaluation.window)
    return pairing.evidence(after, before, names=("B", "A"), distribution=on.name, asked=Asked.GAIN, groups=on.groups,
                            series=on.series).gain  # fmt: skip


def driven(evaluation, design):
    """The plant itself under LQR at a design."""
    study = evaluation.study
    w = evaluation.deployment(1)
    law = saturated_lqr(evaluation.problem, design)
    return simulate(study.real.plant, law, x0=np.tile(study.real.x0, (len(w), 1)), steps=w.shape[1], disturbance=w,
                    design=design, limit=evaluation.problem.limit)  # fmt: skip


@pytest.mark.check
@pytest.mark.parametrize(("wall", "unit", "runs", "steps"), CASES)
@pytest.mark.parametrize("design", [0.5, 8.0])
def test_the_judge_has_the_sign_and_the_size_of_the_truth_from_either_end_of_the_box(wall, unit, runs, steps, design):
    evaluation, log = logged(tank(wall=wall, unit=unit, runs=runs, steps=steps), [design])
    on = whole_runs(evaluation, [log])
    designs = [[1.0], [2.5], [6.0]]
    judged = [on.scenario.run(saturated_lqr(evaluation.problem, p), design=p) for p in designs]
    objective = evaluation.study.objective
    true = [driven(evaluation, p).returns(objective).mean() for p in designs]
    for i, k in ((0, 1), (1, 2), (0, 2)):
        gain = compared(evaluation, judged[k], judged[i], on)
        assert gain.mean == pytest.approx(true[k] - true[i], rel=1e-3)
        assert gain.ci95[0] < true[k] - true[i] < gain.ci95[1]
        assert np.isfinite(gain.ci95).all()
    nothing = compared(evaluation, judged[0], judged[0], on)
    assert (nothing.mean, nothing.ci95) == (0.0, (0.0, 0.0))


@pytest.mark.long
def test_training_waits_for_a_slow_loop_and_not_for_a_fast_one():
    waits = {}
    for wall in ("slow", "fast"):
        evaluation, log = logged(tank(wall=wall, unit=1e-6, runs=1, steps=3000), [0.5])
        waits[wall] = warm_up(evaluation.problem, [log], 40, evaluation.problem.design)
    assert waits["slow"] >= 40
    assert waits["fast"] <= 10  # a quarter of a window


@pytest.mark.long
@pytest.mark.parametrize("design", [0.5, 8.0])
def test_after_the_warm_up_windows_rank_designs_as_whole_runs_do(design):
    evaluation, log = logged(tank(wall="slow", unit=1.0, runs=1, steps=3000), [design])
    problem = evaluation.problem
    window, before = evaluation.training_episode([log], problem.design)
    replayed = replay_problem(problem, [log], window, warm_up=before)
    designs = np.array([[0.6], [2.0], [7.5]])
    rng = np.random.default_rng(0)
    windows = Landscape(replayed, rng, runs=300).returns(problem.design.to_unit(designs)) / window
    whole = [driven(evaluation, p).returns(evaluation.study.objective)[0] / 3000 for p in designs]
    assert list(np.argsort(windows)) == list(np.argsort(whole))
    np.testing.assert_allclose(windows, whole, rtol=0.15)


def test_episodes_of_several_runs_are_the_runs_themselves():
    evaluation, log = logged(tank(wall="slow", unit=1.0, runs=24, steps=300), [0.5])
    assert evaluation.training_episode([log], evaluation.problem.design) == (300, 0)


def test_common_runs_stay_one_piece_of_evidence_where_one_was_lost():
    evaluation, log = logged(tank(wall="fast", unit=1.0, runs=24, steps=120), [0.5])
    short = log.part(np.flatnonzero(np.arange(24) != 5), slice(None))
    whole, lost = (whole_runs(evaluation, logs).groups for logs in ([log, log], [log, short]))
    assert len(np.unique(whole)) == 36
    assert len(np.unique(lost)) == 35
