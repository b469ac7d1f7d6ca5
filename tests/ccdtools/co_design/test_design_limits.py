"""Limits that depend on the design: the same as a plant stated in parts of its actuator, and as clipping by hand."""

import copy
import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from actuated_plants import (
    SPACE,
    STEPS,
    X0,
    bounds,
    full_force,
    in_parts,
    native,
    native_plant,
    range_of,
    room,
    room_of,
)

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Learned,
    LearnedPolicy,
    baselines,
    discretise,
    least_depth,
    load_policy,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import admissible_inputs, expert_dataset, feasible_sets, previewed_problem
from invariant_sets import Polytope, maximal_control_invariant_set
from learning import CloningConfig, NetworkConfig, fit_actor_critic, load
from learning.exceptions import CheckpointError
from mpc import LinearMPC, lqr

DESIGNS = np.array([[0.5], [1.3], [3.0]])


def cloned(problem):
    """An agent that imitates LQR, roughly."""
    data = expert_dataset(problem, samples=150, sets="lqr", rng=np.random.default_rng(0))
    return fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=problem.action_bounds,
        input_bounds=problem.observation_bounds, rng=np.random.default_rng(0), network=NetworkConfig((16,)),
        config=CloningConfig(steps=300, batch=256),
    )  # fmt: skip


@pytest.fixture(scope="module")
def pair():
    """Both statements of the problem, with an agent each."""
    return [(problem, cloned(problem)) for problem in (native(), in_parts())]


@pytest.mark.long
def test_the_expert_does_the_same_in_both_statements():
    own, other = (expert_dataset(problem, samples=30, sets="auto", rng=np.random.default_rng(0))
                  for problem in (native(), in_parts()))  # fmt: skip
    np.testing.assert_allclose(own.inputs, other.inputs, atol=1e-8)
    np.testing.assert_allclose(own.actions[:, 0], other.actions[:, 0] * full_force(other.inputs[:, 2:].T), atol=1e-6)


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize("method", ["pathwise", "pathwise+ppo"])
def test_a_co_design_ends_where_that_of_the_plant_in_parts_does(pair, method):
    config = CoDesignConfig(
        iterations=20, runs=16, pathwise_runs=48, evaluation_runs=100, evaluate_every=5, starts=1, design_rate=0.1
    )
    ends = []
    for problem, agent in pair:
        found = Learned(by=method, agent=agent, config=config).run(problem, np.array([2.0]), np.random.default_rng(0))
        ends.append((found.design[0], found.history.model_return.max()))
    assert abs(ends[0][0] - ends[1][0]) < 0.02 * (SPACE.upper - SPACE.lower)[0]
    assert ends[0][1] == pytest.approx(ends[1][1], rel=5e-3)


@pytest.mark.check
@pytest.mark.parametrize("p", DESIGNS)
def test_feasible_sets_and_mpc_are_those_of_the_plant_in_parts(p):
    own, other = native(), in_parts()
    assert feasible_sets(own).at(p).equals(feasible_sets(other).at(p))
    x = feasible_sets(own).at(p).sample(8, rng=np.random.default_rng(0))
    laws = [baselines(problem, p, rng=np.random.default_rng(0))["MPC"] for problem in (own, other)]
    np.testing.assert_allclose(laws[0](x), full_force(p) * laws[1](x), atol=1e-6)


# --- NumPy by hand ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", DESIGNS)
def test_lqr_in_a_loop_is_clipped_at_the_limits_of_its_design(p):
    problem = native()
    A, B, E = problem.model.matrices(p)
    K, _ = lqr(A, B, Q=problem.weights(p).Q, R=problem.weights(p).R)
    w = np.random.default_rng(0).standard_normal((60, 1))
    x, states, inputs = np.array([2.5, 2.0]), [], []
    for k in range(60):
        u = np.clip(-K @ x, *range_of(p))
        states.append(x)
        inputs.append(u)
        x = A @ x + B @ u + E @ w[k]
    run = simulate(problem.model, saturated_lqr(problem, p), x0=[2.5, 2.0], steps=60, design=p, disturbance=w)
    np.testing.assert_allclose(run.inputs[0], inputs, atol=1e-9)
    np.testing.assert_allclose(run.states[0, :-1], states, atol=1e-9)
    assert np.isclose(inputs, range_of(p)[0]).any()


@pytest.mark.check
@pytest.mark.parametrize("p", DESIGNS)
def test_every_controller_stays_within_the_limits_of_its_design_and_uses_them(p, pair):
    problem, agent = pair[0]
    everyone = baselines(problem, p, rng=np.random.default_rng(0)) | {"learned": LearnedPolicy(agent, p)}
    x = np.random.default_rng(1).uniform([-3, -4], [3, 4], (40, 2))
    for name in ("LQR", "PID", "MPC", "learned"):
        u = simulate(problem.model, everyone[name], x0=x, steps=30, design=p, limit=[1e6, 1e6]).inputs
        assert u.min() >= range_of(p)[0] * (1 + 1e-9), name
        assert u.max() <= range_of(p)[1] * (1 + 1e-9), name
        assert u.min() == pytest.approx(range_of(p)[0], rel=1e-6), name


@pytest.mark.long
def test_the_explicit_law_of_a_design_is_its_mpc():
    problem = native()
    data = expert_dataset(problem, samples=12, expert="explicit", horizon=3, rng=np.random.default_rng(0), sets="lqr")
    p = data.inputs[:, 2:]
    A, B, _ = problem.model.matrices(p)
    for i in range(0, len(p), 17):
        lower, upper = range_of(p[i])
        law = LinearMPC(A[i], B[i], **problem.weights(p[i]).keywords(), horizon=3, X=([-3, -4], [3, 4]),
                        U=([lower], [upper]))  # fmt: skip
        plan = law.solve(data.inputs[i, :2])
        if plan.status.name == "OPTIMAL":
            np.testing.assert_allclose(data.actions[i], plan.u[0], atol=1e-6)


# --- X(p) ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", DESIGNS)
def test_sets_and_filters_keep_the_room_of_the_design(p):
    problem = native(X=room)
    A, B, _ = problem.model.matrices(p)
    X = Polytope.from_bounds(*room_of(p))
    U = Polytope.from_bounds(*([bound] for bound in range_of(p)))
    expected = maximal_control_invariant_set(A, B, X, U).set
    assert feasible_sets(problem).at(p).equals(expected)
    safe = admissible_inputs(problem, p)
    assert safe.S.equals(expected)
    x = expected.sample(50, rng=np.random.default_rng(0))
    u, _ = safe.project(x, np.full((50, 1), 100.0))
    assert expected.contains(x @ A.T + u @ B.T, 1e-6).all()
    assert (u <= range_of(p)[1] + 1e-9).all()
    assert problem.kept_by_mpc(p).equals(X)


@pytest.mark.check
def test_candidates_of_the_expert_fill_the_room_of_their_own_design():
    problem = native(X=room)
    for sets in ("lqr", "none"):
        data = expert_dataset(problem, samples=100, sets=sets, rng=np.random.default_rng(0))
        first = data.inputs[: int(100 * data.acceptance)]
        lower, upper = (np.array(side) for side in zip(*(room_of(p) for p in first[:, 2:])))
        assert (first[:, :2] >= lower - 1e-6).all()
        assert (first[:, :2] <= upper + 1e-6).all()


@pytest.mark.parametrize("p", DESIGNS)
def test_the_least_depth_is_that_of_fixed_limits_equal_to_those_at_the_design(p):
    there = native(X=room_of(p), U=tuple([bound] for bound in range_of(p)))
    own = least_depth(native(X=room), p, x0=[1.25, 2.9])
    assert own == pytest.approx(least_depth(there, p, x0=[1.25, 2.9]), rel=1e-6)
    assert own > 0


def test_a_preview_keeps_both():
    ahead = previewed_problem(native(X=room), 3)
    p = DESIGNS[1]
    lower, upper = ahead.state_limits(p).bounding_box()
    np.testing.assert_allclose([lower[:2], upper[:2]], room_of(p), rtol=1e-12)
    assert ahead.X.dim == 5
    np.testing.assert_allclose(np.ravel(ahead.input_bounds_at(p)), range_of(p), rtol=1e-12)
    data = expert_dataset(ahead, samples=40, sets="lqr", rng=np.random.default_rng(0))
    designs = data.inputs[:, 5:]
    assert (data.actions[:, 0] <= range_of(designs.T)[1] + 1e-9).all()


# --- fixed limits, copies, files ----------------------------------------------------------------------------


@pytest.mark.check
def test_limits_that_happen_not_to_depend_on_the_design_are_fixed_ones():
    fixed = native(U=([-1.0], [2.0]))
    function = native(X=lambda p: ([-3, -4], np.array([3.0, 4.0])), U=lambda p: (-1, 2.0))
    own, other = (cloned(problem) for problem in (function, fixed))
    for mine, theirs in zip(own.state_dict().values(), other.state_dict().values()):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-4)
    assert feasible_sets(function).at([1.0]).equals(feasible_sets(fixed).at([1.0]))


def test_policies_are_saved_with_the_limits_of_every_design(tmp_path, pair):
    agent = pair[0][1]
    LearnedPolicy(agent, [1.0]).save(tmp_path / "policy.safetensors")
    loaded = load_policy(tmp_path / "policy.safetensors")
    x = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    np.testing.assert_array_equal(loaded(x), LearnedPolicy(agent, [1.0])(x))
    elsewhere = LearnedPolicy(loaded.agent, [3.0])
    np.testing.assert_array_equal(elsewhere(x), LearnedPolicy(agent, [3.0])(x))
    assert elsewhere(x).max() > range_of([1.0])[1]
    with pytest.raises(CheckpointError, match="load_policy"):
        load(tmp_path / "policy.safetensors")


def test_problems_and_agents_can_be_pickled_and_copied(pair):
    problem, agent = pair[0]
    for again in (pickle.loads(pickle.dumps(problem)), copy.deepcopy(problem)):
        np.testing.assert_array_equal(again.input_bounds_at(DESIGNS), problem.input_bounds_at(DESIGNS))
        stored = pickle.loads(pickle.dumps(feasible_sets(again)))
        assert stored.at([1.0]).equals(feasible_sets(problem).at([1.0]))
    x = np.ones((1, 2))
    for other in (pickle.loads(pickle.dumps(agent)), copy.deepcopy(agent)):
        np.testing.assert_array_equal(LearnedPolicy(other, [2.0])(x), LearnedPolicy(agent, [2.0])(x))


def test_a_casadi_function_and_columns_are_limits_too():
    p = ca.SX.sym("p")
    stored = ca.Function("U", [p], [-1.5 * ca.sqrt(p), 2 * ca.sqrt(p)])
    np.testing.assert_allclose(native(U=stored).input_bounds_at(DESIGNS), native().input_bounds_at(DESIGNS))


# --- refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (lambda p: (p[0] / 4 - 0.5, 1.0), "0 between"),
        (lambda p: (1.0 - p[0], p[0] - 1.0), "lower < upper"),
        (lambda p: (-1.0, ca.log(p[0] - 1.0)), "finite"),
        (lambda p: (-np.inf, p[0]), "finite"),
        (lambda p: (-p[0], ca.vertcat(p[0], 1.0)), "1, one per input"),
        (lambda p: p[0], "two bounds"),
        (lambda p: (-p[3], p[0]), "stops with index 3 beyond a column of 1 (line "),
        (lambda p: (-p[0], ca.SX.sym("q")), "unknown symbols"),
        (lambda p: ("low", "high"), "casadi.SX expression"),
        (lambda: (-1, 1), "stops with"),
    ],
)
def test_wrong_limits_are_refused_when_the_problem_is_made(given, says):
    with pytest.raises(InputError) as caught:
        native(U=given)
    assert caught.value.argument == "U"
    assert says in str(caught.value)
    if "one per input" not in says:
        with pytest.raises(InputError) as caught:
            native(X=given)
        assert caught.value.argument == "X"


def test_starts_outside_every_room_are_refused():
    with pytest.raises(InputError) as caught:
        native(X=lambda p: (-p[0] / 10, p[0] / 10))
    assert caught.value.argument == "scenarios.x0"


def test_a_start_that_each_design_has_room_for_in_one_state_alone_is_refused():
    """Far out where it may not be fast, and fast where it may not be far out."""
    with pytest.raises(InputError, match="outside X at every design") as caught:
        native(X=lambda p: ([-3, -4], ca.vertcat(p[0], 3.5 - p[0])), scenarios=FixedStart([2.8, 2.8], Gaussian([0.5])))
    assert caught.value.argument == "scenarios.x0"
    native(X=lambda p: ([-3, -4], ca.vertcat(p[0], 3.5 - p[0])), scenarios=FixedStart([1.7, 1.7], Gaussian([0.5])))


@pytest.mark.parametrize("argument", ["X", "U"])
def test_limits_are_looked_at_where_constraints_forbid_a_design_too(argument):
    """The expert's data cover the box: bounds that cross there are named at once, with what to do."""
    plant = replace(native_plant(), design=DesignSpace(["b"], [0.5], [3.0], constraints=lambda p: 1.5 - p[0]))
    given = {"X": ([-3, -4], [3, 4]), "U": bounds, "objective": native().objective, "steps": STEPS,
             "scenarios": FixedStart(X0, Gaussian([0.5]))}  # fmt: skip
    with pytest.raises(InputError, match="fmax") as caught:
        CoDesignProblem(discretise(plant), **given | {argument: lambda p: (-4.0, 4 * (p[0] - 1.0))})
    assert caught.value.argument == argument
    CoDesignProblem(discretise(plant), **given | {argument: lambda p: (-4.0, 4 * ca.fmax(p[0] - 1.0, 0.1))})


def test_limits_of_designs_that_constraints_leave_little_of_are_limits():
    """None of the designs that are looked at may be built."""
    narrow = DesignSpace(["b"], [0.5], [3.0], constraints=lambda p: (p[0] - 1.234) ** 2 - 1e-6)
    plant = replace(native_plant(), design=narrow)
    problem = CoDesignProblem(discretise(plant), X=([-3, -4], [3, 4]), U=bounds, objective=native().objective,
                              scenarios=FixedStart(X0, Gaussian([0.5])), steps=STEPS)  # fmt: skip
    for found, expected in zip(problem.input_limits([1.234]).bounding_box(), range_of([1.234])):
        assert found == pytest.approx([expected])


def test_limits_that_cross_between_the_designs_that_were_looked_at_are_named_there():
    narrow = lambda p: (-1.0, 1 - 2 * ca.exp(-(((p[0] - 1.2345) / 1e-6) ** 2)))  # noqa: E731
    problem = native(U=narrow)
    with pytest.raises(InputError, match=r"b = 1\.2345"):
        problem.input_limits([1.2345])
