"""A redesign goes only as far from what was deployed as the errors are known to follow the design."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    DigitalTwin,
    FixedStart,
    Gaussian,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
    simulate,
)
from ccdtools.co_design import LearnedCoDesign
from ccdtools.co_design.result import CoDesignStatus, History
from ccdtools.studies.redesign import same_design
from ccdtools.studies.trust_region import (
    ErrorAttribution,
    Trust,
    _identified,
    attribute_errors,
    edges,
    in_whole_box,
    within,
)
from learning import ActorCritic, NetworkConfig, QuantileConfig

SCALE = np.array([4.0, 4.0])
SMALLEST = 1 / 64  # radius


def mass(*, cubic=0.0, push=0.0):
    """A mass on a spring: `cubic` is a force the model lacks, `push` moves the position without any force."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    force = -1.5 * x[0] - cubic * x[0] ** 3 - 0.4 * x[1] + u + w
    dynamics = ca.vertcat(x[1] + push * ca.cos(3 * x[0]), force / p)
    return Plant(x, u, w, p, dynamics, DesignSpace(["m"], [0.3], [3.0]), dt=0.1)


def taught(real, model=None):
    """A twin of the linear mass after a log of the real one."""
    w = 0.5 * np.random.default_rng(0).standard_normal((40, 60, 1))
    law = LinearFeedback(np.array([[1.0, 1.0]]))
    log = simulate(real, law, x0=np.tile([1.5, 0.0], (40, 1)), steps=60, disturbance=w, design=[1.0])
    twin = DigitalTwin(discretise(mass()) if model is None else model, scale=SCALE)
    return twin.update(log, weight=np.eye(2), rng=np.random.default_rng(0), config=QuantileConfig(steps=600))


@pytest.mark.check
def test_where_the_real_plant_is_the_model_a_redesign_is_free():
    doubt = attribute_errors(taught(mass()), SCALE)
    assert doubt.rest < 1e-6
    assert doubt.explained < 0.05
    assert not doubt.limits


@pytest.mark.check
def test_what_does_not_enter_through_E_limits_a_redesign():
    doubt = attribute_errors(taught(mass(push=0.5)), SCALE)
    assert doubt.rest > 0.1
    assert doubt.limits
    assert "does not enter through E(p)" in doubt.describe()


@pytest.mark.check
def test_what_depends_on_the_state_limits_a_redesign_even_if_it_enters_as_the_disturbance_does():
    doubt = attribute_errors(taught(mass(cubic=2.0)), SCALE)
    assert doubt.rest < 0.05
    assert doubt.explained > 0.3
    assert doubt.limits


@pytest.mark.check
def test_a_disturbance_that_cannot_be_told_from_another_limits_a_redesign():
    model = discretise(mass())
    doubt = attribute_errors(taught(mass(), replace(model, E=ca.horzcat(model.E, 2 * model.E))), SCALE)
    assert not doubt.identified
    assert doubt.limits
    assert "not of full column rank" in doubt.describe()


@pytest.mark.check
def test_an_E_that_is_the_same_everywhere_need_not_be_identified():
    model = discretise(mass())
    constant = ca.SX(ca.DM([[0.1, 0.2], [0.1, 0.2]]))
    assert attribute_errors(taught(mass(), replace(model, E=constant)), SCALE).identified


@pytest.mark.check
def test_what_enters_away_from_rest_is_told_there_but_a_redesign_stays_limited():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    arm = ca.vertcat(x[1], (-1.5 * x[0] - 0.4 * x[1] + u + w * ca.sin(x[0])) / p)
    model = discretise(Plant(x, u, w, p, arm, DesignSpace(["m"], [0.3], [3.0]), dt=0.1))
    doubt = attribute_errors(taught(model, model), SCALE)
    assert doubt.rest < 1e-6
    assert doubt.explained < 0.2
    assert not doubt.identified


def test_the_region_widens_where_the_judge_was_right_and_halves_where_it_was_wrong():
    trust = Trust(0.25)
    known = ErrorAttribution(0.0, 0.0, True)
    assert trust.after(None) is trust
    assert trust.after(True) == Trust(0.5)
    assert not trust.limits(known)
    wrong = trust.after(False)
    assert wrong == Trust(0.125, betrayed=True)
    assert wrong.limits(known)
    for _ in range(20):
        wrong = wrong.after(False)
    assert wrong.radius == SMALLEST
    for _ in range(20):
        wrong = wrong.after(True)
    assert wrong.radius == 1.0
    assert not wrong.limits(ErrorAttribution(1.0, 0.0, False))


@pytest.mark.parametrize(("rest", "explained", "limited"), [(0.02, 0.01, False), (0.2, 0.1, True), (0.1, 0.2, True)])
def test_a_redesign_is_limited_where_a_tenth_of_the_errors_is_not_known_elsewhere(rest, explained, limited):
    assert ErrorAttribution(rest, explained, True).limits == limited


@pytest.mark.parametrize(("part", "same"), [(0.3e-3, True), (3e-3, False)])
def test_designs_within_a_thousandth_of_every_range_are_one(part, same):
    space = DesignSpace(["m", "k"], [0.0, 0.0], [1.0, 4.0])
    assert same_design(space, np.array([0.5, 1.0]), np.array([0.5, 1.0 + 4 * part])) == same


@pytest.mark.parametrize(("part", "constant"), [(0.3e-9, True), (3e-9, False)])
def test_an_E_that_changes_by_a_billionth_is_the_same_everywhere(part, constant):
    model = discretise(mass())
    twice = ca.SX(ca.DM([[1.0, 2.0], [1.0, 2.0]])) * (1 + part * (model.symbols - 0.3) / 2.7)  # of rank one
    assert _identified(DigitalTwin(replace(model, E=twice), scale=SCALE), SCALE) == constant


@pytest.mark.parametrize(("angle", "told"), [(0.3e-6, False), (3e-6, True)])
def test_two_disturbances_are_told_apart_above_a_millionth(angle, told):
    model = discretise(mass())
    nearly = ca.SX(ca.DM([[1.0, 1.0], [0.0, 2 * angle]])) * model.symbols
    assert _identified(DigitalTwin(replace(model, E=nearly), scale=SCALE), SCALE) == told


def test_the_first_redesign_moves_a_parameter_by_a_quarter_of_its_range(illustrative):
    region = within(illustrative.problem(), np.array([1.75]), Trust().radius).design
    np.testing.assert_allclose([region.lower, region.upper], [[1.75 - 2.5 / 4], [1.75 + 2.5 / 4]])


def test_the_box_of_a_redesign_is_narrowed_and_stays_within_the_bounds(illustrative):
    problem = illustrative.problem()
    space = within(problem, np.array([2.9]), 0.25).design
    np.testing.assert_allclose([space.lower, space.upper], [[2.9 - 0.25 * 2.5], [3.0]])
    np.testing.assert_array_equal(within(problem, np.array([2.9]), 1.0).design.lower, problem.design.lower)


def test_the_edge_of_the_region_is_no_bound_of_the_design(illustrative, clone):
    problem = illustrative.problem()
    space = problem.design
    region = within(problem, np.array([2.9]), 0.1)
    at = {"edge": region.design.lower, "bound": region.design.upper, "between": region.design.centre}
    held = {where: edges(design, region.design, space) for where, design in at.items()}
    assert held == {"edge": {"p": "lower"}, "bound": {}, "between": {}}
    history = History(*(np.zeros(1) for _ in range(2)), np.zeros((1, 1)), *(np.zeros(1) for _ in range(3)))
    found = {where: LearnedCoDesign(
        design=design, agent=clone(illustrative), history=history, status=CoDesignStatus.AT_BOUND,
        active_bounds=region.design.active_bounds(design)) for where, design in at.items()}  # fmt: skip
    read = {where: in_whole_box(result, region.design, space) for where, result in found.items()}
    assert read["edge"].status.name == "EDGE_OF_TRUST"
    assert read["edge"].active_bounds == {}
    assert "edge of the trust region" in read["edge"].describe()[0]
    assert "another generation" in read["edge"].describe()[0]
    assert read["bound"].status.name == "AT_BOUND"
    assert read["bound"].active_bounds == {"p": "upper"}


@pytest.mark.check
def test_a_silent_log_leaves_nothing_to_doubt():
    twin = taught(mass())
    quiet = replace(twin.logs[0], e=0 * twin.logs[0].e, e_next=0 * twin.logs[0].e_next)
    assert attribute_errors(replace(twin, logs=(quiet,)), SCALE) == ErrorAttribution(0.0, 0.0, True)


def gears(lower, upper):
    """A mass behind a gear: its number of teeth is whole, its ratio is not."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    space = DesignSpace(["teeth", "ratio"], [lower, 0.5], [upper, 2.5], integer=["teeth"])
    plant = Plant(x, u, w, p, ca.vertcat(x[1], -x[0] + p[1] * u + w / p[0]), space, dt=0.1)
    return CoDesignProblem(
        discretise(plant), X=([-9, -9], [9, 9]), U=([-9], [9]), steps=10,
        objective=QuadraticObjective(np.eye(2), [[1.0]]), scenarios=FixedStart([1.0, 0.0], Gaussian([0.1])),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("box", "centre", "radius", "expected"),
    [
        ((2, 6), 4, SMALLEST, (3, 5)),
        ((2, 6), 4, 0.25, (3, 5)),
        ((2, 6), 4, 0.3, (2, 6)),
        ((2, 6), 2, SMALLEST, (2, 3)),
        ((2, 6), 6, 0.25, (5, 6)),
        ((1, 9), 6, 0.375 + 0.3e-9 / 8, (3, 9)),  # 3 but for rounding
        ((1, 9), 6, 0.375 + 3e-9 / 8, (2, 9)),
        ((1.6, 6.7), 4, 1.0, (2, 6)),
        ((1.6, 6.7), 2, 0.1, (2, 3)),
        ((1, 1001), 500, 0.0101, (489, 511)),
        ((3, 3), 3, 0.25, (3, 3)),
    ],
)
def test_a_whole_number_may_take_the_next_one_in_the_smallest_region(box, centre, radius, expected):
    region = within(gears(*box), np.array([centre, 2.5]), radius).design
    np.testing.assert_allclose([region.lower[0], region.upper[0]], expected)
    np.testing.assert_allclose([region.lower[1], region.upper[1]], [max(0.5, 2.5 - 2 * radius), 2.5])
    assert region.feasible([centre, 2.5])


def test_a_whole_number_at_the_edge_of_the_region_is_told_from_one_at_its_bound():
    problem = gears(1.6, 6.7)
    region = within(problem, np.array([4, 1.5]), SMALLEST).design
    assert edges(np.array([5, 1.5]), region, problem.design) == {"teeth": "upper"}
    assert edges(np.array([4, 1.5]), region, problem.design) == {}
    last = within(problem, np.array([5, 1.5]), SMALLEST).design
    assert problem.design.active_bounds([6, 1.5]) == {"teeth": "upper"}
    assert edges(np.array([6, 1.5]), last, problem.design) == {}
    history = History(*(np.zeros(1) for _ in range(2)), np.zeros((1, 2)), *(np.zeros(1) for _ in range(3)))
    agent = ActorCritic(*problem.observation_bounds, *problem.input_bounds, config=NetworkConfig((8,)), seed=0)

    def read(teeth, region):
        """What is said of a converged co-design of that many teeth."""
        found = LearnedCoDesign(
            design=np.array([teeth, 1.5]), agent=agent, history=history, status=CoDesignStatus.CONVERGED
        )
        return in_whole_box(found, region, problem.design)

    assert read(5, region).status.name == "EDGE_OF_TRUST"
    assert read(4, region).status.name == "CONVERGED"
    assert read(6, last).status.name == "CONVERGED"
    assert read(6, last).active_bounds == {"teeth": "upper"}
