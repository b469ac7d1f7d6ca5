"""Derivatives of linear MPC are those of differences of its plans, and it says where there are none."""

import numpy as np
import pytest
from differences import distance, slope, slopes
from law_that_changes import START, STATEMENT, A, B, E, family
from plants import double_integrator, suspension

from mpc import InputError, LinearMPC, SensitivityStatus

REQUIRED = 1e-5


def compared(make, x, found, parameters, signals, step=1e-4):
    """Check all derivatives of a sensitivity against differences of the plans that `make(p)` finds."""
    origin = np.zeros(parameters)
    units = [step] * parameters
    for name, expected in (
        ("cost_by_parameters", slopes(lambda p: make(p).solve(x, **signals).cost, origin, units)),
        ("inputs_by_parameters", slopes(lambda p: make(p).solve(x, **signals).inputs, origin, units)),
        ("states_by_parameters", slopes(lambda p: make(p).solve(x, **signals).states, origin, units)),
        ("cost_by_state", slopes(lambda y: make(origin).solve(y, **signals).cost, x, [step] * len(x))),
        ("inputs_by_state", slopes(lambda y: make(origin).solve(y, **signals).inputs, x, [step] * len(x))),
        ("states_by_state", slopes(lambda y: make(origin).solve(y, **signals).states, x, [step] * len(x))),
    ):
        assert distance(getattr(found, name), expected) < REQUIRED, name


@pytest.mark.long
@pytest.mark.quick(9)
@pytest.mark.parametrize(
    ("limits", "signals", "active"),
    [
        ({}, {}, 0),
        ({"U": (-0.3, 0.3)}, {}, 1),
        ({"U": (-1, 1), "X": ([-2, -0.3], [2, 0.3])}, {}, 2),
        ({"U": (-1, 1), "rate_limit": 0.2}, {"u_prev": [0.3]}, 2),
        ({"U": (-1, 1), "X": ([-2, -0.2], [2, 0.2]), "soft": (0.5, 20.0)}, {}, 10),
        ({"U": (-1, 1), "X": ([-2, -0.2], [2, 0.2]), "soft": (0.0, 20.0)}, {}, 5),
        ({"U": (-1, 1)}, {"x_ref": [0.2, 0.0], "w": np.linspace(-0.2, 0.4, 12)[:, None]}, 0),
        ({"U": (-1, 1), "S": [[0.05], [0.02]]}, {}, 0),
        ({"U": (-3, 3), "terminal_set": ([-0.05, -0.05], [0.05, 0.05])}, {}, 1),
        ({"U": (-0.3, 0.3), "blocks": (1, 2, 3, 6)}, {}, 1),
        ({"U": (-0.3, 0.3), "P": np.diag([20.0, 3.0])}, {}, 1),
        ({"U": (-0.3, 0.3), "horizon": 80}, {}, 1),
        ({"U": (-0.3, 0.3), "X": ([-2, -0.3], [2, 0.3]), "horizon": 300}, {}, 1),
        ({"U": (-0.3, 0.3), "solver": "osqp"}, {}, 1),
    ],
    ids=["free", "inputs", "states", "rate", "soft", "soft, quadratic", "signals", "cross weight", "terminal set",
         "blocks", "given P", "growing", "growing by 1e12", "osqp"],
)  # fmt: skip
def test_derivatives_are_those_of_differences(limits, signals, active):
    changes = family(0)

    def make(p):
        moved = (M + changes[f"d{name}"] @ p for name, M in (("A", A), ("B", B), ("E", E)))
        A_, B_, E_ = moved
        return LinearMPC(A_, B_, E=E_, **(STATEMENT | limits))

    found = make(np.zeros(3)).sensitivity(START, **changes, **signals)
    assert found.smooth
    assert found.regular
    assert len(found.active) >= active
    compared(make, START, found, 3, signals)


def test_weights_limits_and_terminal_weight_change_too():
    rng = np.random.default_rng(3)
    dQ = 0.1 * rng.normal(size=(2, 2, 2))
    dQ = dQ + dQ.swapaxes(0, 1)
    changes = {"dQ": dQ, "dR": 0.02 * rng.normal(size=(1, 1, 2)), "dS": 0.01 * rng.normal(size=(2, 1, 2)),
               "dU": rng.normal(size=(2, 2)), "dX": rng.normal(size=(4, 2)),
               "d_terminal_set": rng.normal(size=(4, 2)), "dA": 0.1 * rng.normal(size=(2, 2, 2))}  # fmt: skip

    def make(p):
        dU, dX, dT = (changes[name] @ p for name in ("dU", "dX", "d_terminal_set"))
        return LinearMPC(
            A + changes["dA"] @ p, B, Q=np.diag([1.0, 0.1]) + dQ @ p, R=[[0.1]] + changes["dR"] @ p,
            S=[[0.05], [0.02]] + changes["dS"] @ p, horizon=12, U=(-0.8 - dU[1], 0.8 + dU[0]),
            X=(-np.array([2, 0.3]) - dX[2:], np.array([2, 0.3]) + dX[:2]),
            terminal_set=(-np.array([0.05, 0.05]) - dT[2:], np.array([0.05, 0.05]) + dT[:2]),
        )  # fmt: skip

    found = make(np.zeros(2)).sensitivity([0.35, -0.25], **changes)
    assert found.smooth
    assert {label.kind for label in found.active} >= {"state", "terminal"}
    compared(make, np.array([0.35, -0.25]), found, 2, {}, step=2e-5)


def test_last_input_and_rate_limits_that_change():
    def make(p):
        return LinearMPC(A, B, **STATEMENT, U=(-1, 1), rate_limit=0.2 + p[0])

    found = make([0.0]).sensitivity(START, d_rate_limit=[[1.0]], u_prev=[0.3])
    assert {label.kind for label in found.active} == {"rate"}
    compared(make, START, found, 1, {"u_prev": [0.3]})
    expected = slopes(lambda u: make([0.0]).solve(START, u_prev=u).inputs, np.array([0.3]), [1e-4])
    assert distance(found.inputs_by_last_input, expected) < REQUIRED
    cost = slope(lambda t: make([0.0]).solve(START, u_prev=[0.3 + t]).cost, 1e-4)
    assert found.along(du_prev=[1.0]).cost == pytest.approx(cost, rel=REQUIRED)


def test_multipliers_are_what_a_bound_is_worth():
    found = LinearMPC(A, B, **STATEMENT, U=(-0.3, 0.3)).sensitivity(START)
    assert {label.row for label in found.active} == {0}
    assert min(found.active.values()) > 0
    cost = slope(lambda t: LinearMPC(A, B, **STATEMENT, U=(-0.3, 0.3 + t)).solve(START).cost, 1e-4)
    assert cost == pytest.approx(-sum(found.active.values()), rel=REQUIRED)


def test_the_gain_is_that_of_the_explicit_law():
    A, B = double_integrator()
    controller = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=5, U=(-1, 1), X=([-5, -5], [5, 5]))
    law = controller.explicit()
    rng = np.random.default_rng(0)
    compared_ones = 0
    for x in rng.uniform(-3, 3, size=(40, 2)):
        found = controller.sensitivity(x)
        if not found.smooth or found.margin < 1e-3 or not found.plan.feasible:
            continue
        expected = slopes(lambda y: law(y), x, [1e-5, 1e-5])
        assert found.input_by_state == pytest.approx(expected, abs=1e-6)
        compared_ones += 1
    assert compared_ones > 20


@pytest.mark.parametrize(("length", "force"), [(1e3, 1.0), (1e-6, 1e-3), (1.0, 1e6)])
def test_units_do_not_matter(length, force):
    p = np.array([27692.0, 1906.5])

    def matrices(q):
        A, B, _ = suspension(*q)
        return np.hstack([A, B])

    changes = slopes(matrices, p, 1e-3 * p)
    x = np.array([0.05, 0.5, 0.2, 1.0])

    def made(sx, su):
        A, B = np.split(matrices(p), [4], axis=1)
        X = sx * np.array([0.25, 2.5, 0.5, 2.5])
        controller = LinearMPC(
            A, B * sx / su, Q=np.diag([10, 1, 50, 5]) / sx**2, R=1e-6 / su**2, horizon=10, X=(-X, X),
            U=(-1000 * su, 1000 * su),
        )  # fmt: skip
        return controller.sensitivity(sx * x, dA=changes[:, :4], dB=changes[:, 4:] * sx / su)

    plain, scaled = made(1.0, 1.0), made(length, force)
    assert plain.active
    assert list(scaled.active) == list(plain.active)
    assert scaled.status is plain.status
    assert scaled.margin == pytest.approx(plain.margin, rel=1e-5)
    assert distance(scaled.cost_by_parameters, plain.cost_by_parameters) < 1e-7
    assert distance(scaled.inputs_by_parameters / force, plain.inputs_by_parameters) < 1e-7
    assert distance(scaled.inputs_by_state * length / force, plain.inputs_by_state) < 1e-7

    def cost(q):
        A, B = np.split(matrices(q), [4], axis=1)
        X = np.array([0.25, 2.5, 0.5, 2.5])
        made = LinearMPC(A, B, Q=[10, 1, 50, 5], R=1e-6, horizon=10, X=(-X, X), U=(-1000, 1000))
        return made.solve(x).cost

    assert distance(plain.cost_by_parameters, slopes(cost, p, 1e-3 * p)) < REQUIRED


# ── where the active set changes ──


def test_plans_that_relax_a_limit_have_no_derivatives_and_say_so():
    controller = LinearMPC(A, B, **STATEMENT, U=(-0.1, 0.1), X=([-0.2, -0.3], [0.2, 0.3]))
    found = controller.sensitivity([0.4, 0.3], dA=family(0)["dA"])
    assert found.status is SensitivityStatus.UNSOLVED
    assert not found.plan.feasible
    assert not found.smooth
    assert not found.regular
    assert np.isnan(found.cost_by_parameters).all()
    assert found.inputs_by_parameters.shape == (12, 1, 3)
    assert np.isnan(found.along([1.0, 0.0]).inputs).all()


def test_at_the_origin_the_law_is_the_regulator():
    controller = LinearMPC(A, B, **STATEMENT, U=(-1, 1))
    found = controller.sensitivity([0.0, 0.0], **family(0) | {"dE": None})
    assert found.smooth
    assert found.input_by_state == pytest.approx(-controller.gain, rel=1e-8)
    assert not found.inputs_by_parameters.any()
    assert not found.cost_by_parameters.any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dA": np.ones((2, 2))}, r"dA: got shape \(2, 2\), expected \(2, 2, np\)"),
        ({"dA": np.ones((2, 2, 1)), "dB": np.ones((2, 1, 2))}, r"dB: got shape \(2, 1, 2\)"),
        ({"dB": np.full((2, 1, 1), np.inf)}, "dB: got inf"),
        ({"dE": np.ones((2, 1, 1))}, "dE: got a derivative, expected none"),
        ({"dP": np.ones((2, 2, 1))}, "dP: got a derivative, expected none"),
        ({"dU": np.ones((3, 1))}, r"dU: got shape \(3, 1\)"),
        ({"d_rate_limit": np.ones((1, 1))}, "d_rate_limit: got shape"),
        ({"reference": [1.0]}, "reference"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(InputError, match=message):
        LinearMPC(A, B, **STATEMENT, U=(-1, 1)).sensitivity(START, **arguments)


def test_directions_of_another_size_are_named():
    with pytest.raises(InputError, match=r"dp: got shape \(2,\)"):
        LinearMPC(A, B, **STATEMENT).sensitivity(START, dA=family(0)["dA"]).along(dp=[1.0, 2.0])


@pytest.mark.parametrize(
    ("lower", "upper", "U", "rate"),
    [
        ([-2.0, -0.2], [2.0, 0.2], 1.0, None),
        ([-2.0, 0.0], [2.0, 0.2], 1.0, None),
        ([-np.inf, 0.0], [np.inf, np.inf], 0.6, None),
        ([-np.inf, 0.0], [np.inf, np.inf], 9.0, 0.3),
    ],
    ids=["bounds", "a bound of zero beside others", "a bound of zero alone", "a bound of zero and a rate"],
)
@pytest.mark.parametrize(("length", "force"), [(1.0, 1.0), (1e3, 1e-3)])
def test_prices_of_soft_limits_change_with_their_units(lower, upper, U, rate, length, force):
    lower, upper = np.array(lower), np.array(upper)
    rng = np.random.default_rng(5)
    dB = 0.05 * rng.normal(size=(2, 1, 2))
    moves = {"upper": rng.normal(size=(2, 2)), "lower": rng.normal(size=(2, 2)), "U": rng.normal(size=2)}
    moves["lower"][lower == 0] = 0.0
    moves = {name: 0.2 * move for name, move in moves.items()}
    finite = [np.isfinite(upper), np.isfinite(lower)]
    weights = {"Q": np.array([1.0, 0.1]) / length**2, "R": 0.1 / force**2, "horizon": 12, "soft": (0.05, 2.0)}

    def make(p):
        limit = {} if rate is None else {"rate_limit": force * (rate + 0.05 * p[0])}
        room, low, high = force * (U + moves["U"] @ p), length * (lower - moves["lower"] @ p), length * upper
        X = (low, high + length * moves["upper"] @ p)
        return LinearMPC(A, length / force * (B + dB @ p), X=X, U=(-room, room), **weights, **limit)

    start = length * START
    signals = {} if rate is None else {"u_prev": [0.1 * force]}
    d_rate = {} if rate is None else {"d_rate_limit": [[0.05 * force, 0.0]]}
    found = make(np.zeros(2)).sensitivity(
        start, **d_rate, dB=length / force * dB, dU=force * np.array([moves["U"]] * 2),
        dX=length * np.vstack([moves["upper"][finite[0]], moves["lower"][finite[1]]]), **signals,
    )  # fmt: skip
    assert found.smooth
    assert found.plan.violation > 1e-3 * length
    for name, of in (("cost_by_parameters", "cost"), ("inputs_by_parameters", "inputs")):
        expected = slopes(lambda p, of=of: getattr(make(p).solve(start, **signals), of), np.zeros(2), [1e-4] * 2)
        assert distance(getattr(found, name), expected) < REQUIRED, name
