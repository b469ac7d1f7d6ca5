"""LinearMPC(W=…): limits are kept whatever disturbances of W do, and a plan follows a plan."""

import ctypes
import itertools
import subprocess

import numpy as np
import pytest
from compiler import CC, needs_compiler

from invariant_sets import Polytope, maximal_positively_invariant_set
from mpc import ExplicitMPC, InfeasibleError, InputError, LinearMPC, Status

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
X, U, W = ([-5, -0.8], [5, 0.8]), (-1, 1), ([-0.002, -0.03], [0.002, 0.03])
OWN = {"Q": [1.0, 0.1], "R": 0.1, "X": X, "U": U}


def cart(**change):
    return LinearMPC(A, B, **{**OWN, "horizon": 8, "W": W, **change})


def random_plant(seed):
    """A plant of two or three states, unstable now and then, in units of its own, whose W enters by E."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 4))
    states = 10.0 ** rng.uniform(-3, 3, n)
    force = 10.0 ** rng.uniform(-3, 3)
    a = rng.standard_normal((n, n))
    a *= rng.uniform(0.8, 1.15) / np.abs(np.linalg.eigvals(a)).max()
    b, e = rng.standard_normal((n, 1)), 0.05 * rng.standard_normal((n, 2))
    return {
        "A": a * states[:, None] / states, "B": b * states[:, None] / force, "E": e * states[:, None],
        "Q": np.diag(1 / states**2), "R": 1 / force**2, "X": (-5 * states, 4 * states), "U": (-3 * force, 2 * force),
        "W": ([-1.0, -0.5], [0.8, 1.0]), "horizon": 5,
    }  # fmt: skip


@pytest.mark.parametrize("seed", range(12))
def test_a_loop_that_has_a_plan_keeps_its_limits_under_disturbances_at_the_vertices(seed):
    given = random_plant(seed)
    try:
        controller = LinearMPC(**given)
    except InfeasibleError:
        pytest.skip("W is too large for this plant")
    rng = np.random.default_rng(seed)
    low, high = (np.array(side) for side in given["X"])
    corners = np.array(list(itertools.product(*zip(*given["W"]))))
    begun = 0
    for x in rng.uniform(low, high, (40, len(low))):
        if controller.solve(x).status is not Status.SOLVED:
            continue
        begun += 1
        limit = int(rng.integers(len(low)))  # half of the runs are pushed towards one limit, the others at random
        for _ in range(25):
            plan = controller.solve(x)
            assert plan.status is Status.SOLVED
            assert (plan.inputs[0] >= given["U"][0] * (1 + 1e-9)).all()
            assert (plan.inputs[0] <= given["U"][1] * (1 + 1e-9)).all()
            pushes = corners @ given["E"].T
            chosen = np.argmax(pushes[:, limit]) if begun % 2 else rng.integers(len(pushes))
            x = given["A"] @ x + given["B"] @ plan.inputs[0] + pushes[chosen]
            assert (np.maximum(low - x, x - high) <= 1e-7 * (high - low)).all()
    assert begun > 0


def test_the_limits_of_a_step_are_those_that_every_sequence_of_vertices_leaves():
    controller = cart(horizon=5)
    qp, loop = controller.build(), A - B @ controller.tube_gain
    corners = np.array(list(itertools.product(*zip(*W))))
    for step in range(6):
        sums = np.zeros((1, 2))
        for _ in range(step):
            sums = np.unique((sums[:, None] @ loop.T + corners[None]).reshape(-1, 2), axis=0)
        for label, bound in zip(qp.labels, qp.w):
            if label.step == step and label.kind in ("state", "input"):
                H, h = controller.state_rows if label.kind == "state" else controller.input_rows
                error = sums if label.kind == "state" else -sums @ controller.tube_gain.T
                assert bound == pytest.approx(h[label.row] - (error @ H[label.row]).max(), abs=1e-12)


def test_without_w_the_same_loop_leaves_its_limits():
    worst = {}
    for name, controller in (("nominal", cart(W=None, horizon=50)), ("robust", cart(horizon=50))):
        x = np.array([-3.0, 0.0])
        assert controller.solve(x).status is Status.SOLVED
        reached = []
        for _ in range(60):
            x = A @ x + B @ controller(x) + W[1]
            reached.append(x[1])
        worst[name] = max(reached)
    assert worst["nominal"] > 0.8 + 0.02
    assert worst["robust"] <= 0.8 + 1e-9


def test_the_terminal_set_is_the_largest_robust_one():
    K = cart().tube_gain
    limits = Polytope.from_bounds([-5, -0.8, -1], [5, 0.8, 1])
    found = maximal_positively_invariant_set(A - B @ K, limits, C=np.vstack([np.eye(2), -K]), W=W)
    assert Polytope(*cart().terminal_rows).equals(found.set)


def test_a_set_of_no_disturbance_leaves_the_limits_as_they_are():
    none = cart(W=([0, 0], [0, 0]))
    given = cart(W=None, terminal_set=Polytope(*none.terminal_rows))
    for x in ([1.0, 0.0], [-2.0, 0.6]):
        np.testing.assert_allclose(none(x), given(x), atol=1e-10)


@pytest.mark.parametrize("solver", ["osqp", "clarabel"])
def test_the_sparse_programs_are_tightened_too(solver):
    for x in ([-1.5, 0.5], [1.0, -0.6]):
        assert cart(solver=solver)(x) == pytest.approx(cart()(x), abs=1e-5)


def test_the_explicit_law_is_the_online_one():
    controller = cart()
    law = controller.explicit()
    rng = np.random.default_rng(0)
    states = [x for x in rng.uniform(*X, (200, 2)) if controller.solve(x).status is Status.SOLVED]
    assert len(states) > 20
    np.testing.assert_allclose(law(np.array(states)), controller(np.array(states)), atol=1e-7)


@pytest.mark.long
@needs_compiler
def test_c_code_and_a_stored_law_are_the_online_one(tmp_path):
    controller = cart(horizon=5)
    law = controller.explicit()
    rng = np.random.default_rng(0)
    states = np.array([x for x in rng.uniform(*X, (300, 2)) if controller.solve(x).status is Status.SOLVED])
    assert len(states) > 20
    law.save(tmp_path / "law")
    np.testing.assert_array_equal(ExplicitMPC.load(tmp_path / "law")(states), law(states))
    law.to_c(tmp_path)
    library = tmp_path / "law.so"
    subprocess.run([CC, "-std=c99", "-O2", "-shared", "-fPIC", tmp_path / "mpc.c", "-o", library], check=True)
    c_law = ctypes.CDLL(str(library)).mpc_law
    c_law.restype = ctypes.c_double
    u = np.zeros(1)
    pointer = ctypes.POINTER(ctypes.c_double)
    for x in states:
        c_law(np.ascontiguousarray(x).ctypes.data_as(pointer), u.ctypes.data_as(pointer))
        assert u == pytest.approx(controller(x), abs=1e-7)


@pytest.mark.long
def test_an_explicit_loop_keeps_its_limits_over_thousands_of_steps_at_the_vertices():
    controller = cart(horizon=5)
    law = controller.explicit()
    rng = np.random.default_rng(1)
    corners = np.array(list(itertools.product(*zip(*W))))
    states = np.array([x for x in rng.uniform(*X, (300, 2)) if controller.solve(x).status is Status.SOLVED])
    pushed = np.argmax(corners @ rng.standard_normal((2, len(states))) / X[1][1], axis=0)
    for step in range(3000):
        u = law(states)
        assert (np.abs(u) <= 1 + 1e-9).all()
        chosen = np.where(np.arange(len(states)) % 2, pushed, rng.integers(4, size=len(states)))
        chosen = pushed if step % 500 < 250 else chosen
        states = states @ A.T + u @ B.T + corners[chosen]
        assert (np.abs(states) <= np.array(X[1]) + 1e-8).all()


@pytest.mark.parametrize("low", [-0.03, 0.0, 0.01])
def test_a_set_without_the_origin_and_a_flat_one_keep_the_limits_too(low):
    flat = Polytope.from_bounds([0.0, low], [0.0, 0.03])
    controller = cart(W=flat, E=np.eye(2))
    x = np.array([-1.0, 0.2])
    rng = np.random.default_rng(2)
    for step in range(300):
        plan = controller.solve(x)
        assert plan.status is Status.SOLVED
        x = A @ x + B @ plan.inputs[0] + [0.0, low if rng.random() < 0.3 and step > 150 else 0.03]
        assert (np.abs(x) <= np.array(X[1]) + 1e-8).all()


def test_soft_limits_priced_enough_give_nothing_where_a_plan_exists():
    hard, soft = cart(), cart(soft=(1e4, 1.0))
    for x in ([-1.5, 0.5], [1.0, -0.6], [0.2, 0.75]):
        assert hard.solve(x).status is Status.SOLVED
        assert soft(x) == pytest.approx(hard(x), abs=1e-6)


def test_a_reference_changes_the_input_and_not_which_states_have_a_plan():
    rng = np.random.default_rng(3)
    controller = cart()
    for x in rng.uniform(*X, (40, 2)):
        assert controller.solve(x).status is controller.solve(x, x_ref=[2.0, 0.0]).status
    assert controller([0.5, 0.0], x_ref=[2.0, 0.0]) > controller([0.5, 0.0])


def test_where_the_costs_gain_leaves_nothing_of_the_inputs_the_tube_has_a_lower_one():
    eager = cart(Q=[1e6, 1e3])
    wanted = np.abs(eager.gain).max()
    assert np.abs(eager.tube_gain).max() < 0.2 * wanted
    limits = Polytope.from_bounds([-5, -0.8, -1], [5, 0.8, 1])
    of_the_cost = maximal_positively_invariant_set(
        A - B @ eager.gain, limits, C=np.vstack([np.eye(2), -eager.gain]), W=W
    )
    assert of_the_cost.set.is_empty


def test_a_gain_that_no_weight_of_the_inputs_gives_is_found():
    weights, limits = {"Q": [10.0, 0.1], "R": 1.0}, {"X": ([-0.5, -0.4], [0.5, 0.4]), "U": (-0.1, 0.1)}
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.035], [0.7]])
    W = ([-0.003, -0.06], [0.003, 0.06])
    slow = np.array([[0.19, 1.43]])  # leaves something of every limit: sums over 400 steps, by hand
    rows = np.vstack([np.eye(2), slow])
    room = sum(np.abs(rows @ np.linalg.matrix_power(A - B @ slow, i)) @ W[1] for i in range(400))
    assert (room < [0.5, 0.4, 0.1]).all()
    controller = LinearMPC(A, B, **weights, **limits, horizon=10, W=W)
    assert controller.solve([0.1, 0.0]).status is Status.SOLVED


def test_a_state_without_a_plan_is_told_and_explained():
    controller = cart()
    plan = controller.solve([4.9, 0.79])
    assert plan.status is Status.SOFTENED
    assert str(controller.explain([4.9, 0.79]))


def test_another_model_has_its_own_room():
    slow = cart().with_model(A, 0.8 * B)
    again = LinearMPC(A, 0.8 * B, **OWN, horizon=8, W=W)
    np.testing.assert_allclose(slow.build().w, again.build().w)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"W": ([-0.5, -0.5], [0.5, 0.5])}, InfeasibleError, "no set of states"),
        ({"W": ([-1, -1], [0.5, np.inf])}, InputError, "unbounded"),
        ({"W": ([-np.inf] * 2, [np.inf] * 2)}, InputError, "W"),
        ({"W": Polytope.from_bounds([-1], [1])}, InputError, "1 coordinates"),
        ({"W": Polytope.empty(2)}, InputError, "empty"),
        ({"W": 0.1}, InputError, "W"),
        ({"rate_limit": 0.5}, InputError, "rate_limit"),
        ({"blocks": (1, 7)}, InputError, "blocks"),
        ({"terminal_set": ([-1e-3, -1e-3], [1e-3, 1e-3])}, InfeasibleError, "terminal"),
    ],
)
def test_wrong_sets_are_named(change, error, says):
    with pytest.raises(error, match=says):
        cart(**change)


def test_derivatives_by_the_plant_are_refused_and_by_the_state_right():
    controller = cart()
    x = np.array([0.1, 0.05])
    with pytest.raises(InputError, match="dA"):
        controller.sensitivity(x, dA=np.ones((2, 2, 1)))
    found = controller.sensitivity(x)
    step = np.array([1e-6, 0.0])
    slope = (controller(x + step) - controller(x - step)) / 2e-6
    np.testing.assert_allclose(found.input_by_state[:, 0], slope, rtol=1e-4, atol=1e-8)
