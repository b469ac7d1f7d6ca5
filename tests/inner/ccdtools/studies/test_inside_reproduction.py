"""Pieces of `ccdtools reproduce`: optima, floors and verdicts."""

import copy

import numpy as np
import pytest

from ccdtools.co_design.objective import Weights
from ccdtools.studies import load_study
from ccdtools.studies.reproduce.budget import Budget
from ccdtools.studies.reproduce.dynamic_program import optimal_return, viable
from ccdtools.studies.reproduce.lines import Line, lines_of
from ccdtools.studies.reproduce.paper_figures import PAPER
from ccdtools.studies.reproduce.places import best_of, floors, steady
from ccdtools.studies.reproduce.rows import Cell, Found, apart, said_of, verdict
from ccdtools.studies.reproduce.tasks import Task
from ccdtools.studies.run_folder import RunFolder
from ccdtools.trajectory import Trajectory
from learning.networks import ActorCritic

A = np.array([[0.8, 0.5], [0.5, 0.6]])
B = np.array([[0.5], [1.0]])
STD = np.array([0.1, 0.2])


def riccati(x0, steps, *, Q, R):
    """Optimal return without limits, by the recursion of Riccati and the cost of the noise."""
    P, noise = np.zeros((2, 2)), 0.0
    for _ in range(steps):
        S = P + Q
        noise += np.trace(S @ np.diag(STD**2))
        K = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)
        P = A.T @ S @ (A - B @ K)
    return -(x0 @ P @ x0) - noise


def test_the_dynamic_program_is_riccati_where_no_input_is_limited():
    x0 = np.array([-0.7, 0.4])
    box = np.array([-4.0, -4.0]), np.array([4.0, 4.0])
    found = optimal_return(
        A, B, Weights(np.eye(2), np.array([[0.1]])), STD, (-6.0, 6.0), box, x0, steps=20, cells=(41, 41), choices=25
    )
    assert found == pytest.approx(riccati(x0, 20, Q=np.eye(2), R=np.array([[0.1]])), rel=1e-3)


def test_a_limited_input_never_earns_more():
    box = np.array([-6.0, -6.0]), np.array([6.0, 6.0])
    weights = Weights(np.eye(2), np.array([[0.1]]))
    wide, narrow = (
        optimal_return(A, B, weights, STD, (-u, u), box, np.array([-1.0, 0.5]), steps=8, cells=(31, 31), choices=21)
        for u in (5.0, 0.2)
    )
    assert narrow < wide


def test_states_that_a_double_integrator_can_stop_are_an_area_in_closed_form():
    # x⁺ = x + v, v⁺ = v + u, |u| ≤ 1: continuous in time |x + v|v|/2| ≤ 1; a fine step is close to that
    dt = 0.05
    A, B = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**2 / 2], [dt]])
    box = np.array([-1.0, -3.0]), np.array([1.0, 3.0])
    found = viable(A, B, (-1.0, 1.0), box, cells=241, choices=3)
    v = np.linspace(-2, 2, 100_001)
    assert found == pytest.approx(np.trapezoid(2 - v**2 / 2, v), rel=0.05)


def test_no_median_can_do_what_the_paper_prints_for_the_illustrative_example():
    found = floors(load_study("illustrative"), 100)
    exact = np.sqrt((0.1**2 + 0.2**2 + 2 * 0.2**2 / 12) / 2)  # normal noise, and a uniform one of width 0.2
    assert found["rmse.optimum"][0] == pytest.approx(exact, rel=5e-3)
    assert found["rmse.optimum"][0] > PAPER["illustrative"]["rmse"].mean
    assert 0 < found["pinball.optimum"][0] < found["rmse.optimum"][0]


def test_a_road_that_is_predicted_leaves_less_than_its_own_size():
    study = load_study("suspension")
    E = study.model.matrices(np.array([31863.8, 2067.1]))[2][:, 0]
    road = study.real.disturbance.sample(1, 2000, np.random.default_rng(20_240_917))[0, :, 0]
    found = floors(study, 2000)["rmse.optimum"][0]
    assert 0 < found < np.sqrt(np.mean(E**2)) * road.std()


def test_steady_state_is_the_second_half_of_a_hundred_samples():
    states = np.zeros((150, 101, 4))
    states[:, :51, 2] = 7.0  # the first half does not count
    states[:, 51::2, 3] = 2.0
    inputs = np.zeros((150, 100, 1))
    run = Trajectory(states, inputs, np.zeros((150, 100, 1)), np.full(150, -1), np.zeros(0), 0.05)
    found = steady(run)
    assert (found["sigma-1-x₃ [m]"] == 0).all()
    assert found["sigma-2-x₄ [m/s]"] == pytest.approx(1.0)


def test_a_design_that_loses_runs_is_no_optimum():
    values = np.array([[-1.0, np.nan, np.nan], [-5.0, -5.0, -5.0], [-4.0, -4.0, -4.0]])
    assert best_of(values, lower=False) == 2
    assert best_of(-values, lower=True) == 2


NOTHING = Found((), {}, (), load_study("illustrative").problem().design)
LINE = Line("illustrative", "nominal-after", "", "after")  # the paper: −69.783 ± 0.743


@pytest.mark.parametrize(
    ("ours", "optimum", "word"),
    [
        (Cell(-25.0, -26.0, -24.0), Cell(-24.0, -24.0, -24.0), "better: +64 %"),
        (Cell(-69.5, -70.5, -68.5), Cell(-24.0, -24.0, -24.0), "not told apart"),
        (Cell(-80.0, -81.0, -79.0), Cell(-24.0, -24.0, -24.0), "worse: −15 %"),
        (
            Cell(-80.0, -81.0, -79.0),
            Cell(-75.0, -75.5, -74.5, at="dynamic program at p = 3"),
            "cannot be here, because no policy at a design of the grid comes there: −75.00 at best",
        ),
        (Cell(), Cell(), "not measured"),
    ],
)
def test_the_verdict_is_that_of_the_decision_rule(ours, optimum, word):
    assert verdict(LINE, NOTHING, ours, optimum).startswith(word)


def test_a_figure_beyond_the_best_lqr_alone_is_not_called_impossible():
    """A force of nothing is no LQR's, and can be."""
    line = next(line for line in lines_of("suspension") if line.says == "σ_ss of u [N], start 2, generation 2")
    said = verdict(line, NOTHING, Cell(54.1, 38.1, 72.1), Cell(54.3, 38.3, 72.4, at="LQR at k_s = 10000 N/m"))
    assert said.startswith("worse: −984 % [")
    assert said.endswith("; no LQR of the grid comes there: 54.30 at best")


def test_less_is_better_where_it_is():
    few, many = Cell(1.0, 0.9, 1.1), Cell(2.0, 1.9, 2.1)
    assert said_of(apart(few, many, lower=True), "") == "better: +50 % [+43, +57]"
    assert said_of(apart(few, many, lower=False), "").startswith("worse")


def test_laws_on_the_same_runs_are_compared_in_pairs():
    rng = np.random.default_rng(0)
    common = rng.normal(-50.0, 20.0, 100)  # ± 4, far more than what tells the two apart
    seeds = tuple({"free-1.ours": common + gain, "free-1.lqr": common} for gain in (0.9, 1.0, 1.1))
    found = Found(seeds, {}, (), NOTHING.space)
    gain = found.beside("free-1.ours", "free-1.lqr", fresh=True, lower=False)
    assert said_of(gain, "equal").startswith("better: +2.1 %")
    assert found.beside("free-1.ours", "nowhere", fresh=True, lower=False) is None


def test_a_law_that_loses_more_runs_is_not_better_by_the_others():
    base = np.random.default_rng(0).normal(-10.0, 1.0, (3, 50))
    ours = base + 1.0
    ours[:, :25] = np.nan
    ours[0] = np.nan

    def beside(one, two):
        seeds = tuple({"free-1.ours": a, "free-1.lqr": b} for a, b in zip(one, two))
        return Found(seeds, {}, (), NOTHING.space)

    found = beside(ours, base)
    gain = found.beside("free-1.ours", "free-1.lqr", fresh=True, lower=False)
    assert said_of(gain, "equal").startswith("loses more")
    assert found.cell("free-1.ours", fresh=True).at == "66.67% of the runs lost"
    nowhere = beside(ours, base * np.nan)
    gain = nowhere.beside("free-1.ours", "free-1.lqr", fresh=True, lower=False)
    assert said_of(gain, "equal") == "equal: n/a"


def test_every_figure_of_the_paper_has_its_row():
    for case, figures in PAPER.items():
        shown = {line.paper or line.key for line in lines_of(case)}
        assert shown >= figures.keys()


def test_a_row_of_generation_2_stands_beside_that_of_generation_1():
    for case in PAPER:
        lines = {line.key: line for line in lines_of(case)}
        for line in lines.values():
            assert ("generation 2" in line.says) == bool(line.former)
            if line.former:
                assert lines[line.former].says == line.says.replace("generation 2", "generation 1")


def test_a_law_that_nothing_has_changed_is_run_once(tmp_path):
    """Neither an update that was refused nor a redesign that stays away makes another policy."""
    task = Task(RunFolder(tmp_path), Budget(), "illustrative", "loop")
    agent = ActorCritic([-9] * 3, [9] * 3, [-1], [1], seed=0)
    asked = []

    def seen(law, p):
        asked.append(p)
        return {"place": np.array([float(p[0])])}

    p = np.array([2.0])
    found = task._laws({tag: (seen, copy.deepcopy(agent), p, tag) for tag in ("1", "1-updated")})
    assert len(asked) == 2  # at its own design and at the paper's
    assert found.arrays["place-1.ours"] == found.arrays["place-1-updated.ours"] == 2.0
    assert found.arrays["place-1.policy"] == found.arrays["place-1-updated.policy"] != 2.0
