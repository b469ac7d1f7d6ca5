"""Plants with algebraic variables: trajectories beside IDAS, derivatives, no number where there is no root."""

import copy
import pickle

import algebraic_plants as cases
import casadi as ca
import numpy as np
import pytest
import torch
from algebraic_plants import apart
from small_plants import problem_of

from ccdtools import DesignSpace, InputError, Plant, codesign, equilibrium, feasible_sets, linearise, simulate
from ccdtools.plants import to_torch
from mpc.optimal_control import NonlinearMPC, Phase

ONE = DesignSpace(["p"], [0.5], [2.0])
CASES = {
    "pendulum": cases.pendulum, "pendulum in mm, g, ms": lambda: cases.pendulum(1e3, 1e3, 1e3), "diode": cases.diode,
    "diode in mV, uA, ms": lambda: cases.diode(1e3, 1e6, 1e3), "reactor": cases.reactor,
    "reactor in mmol, min": lambda: cases.reactor(1e3, 60), "column": lambda: cases.column(3),
}  # fmt: skip


def stated(equations, rates=None, size=1, **changes):
    """A plant of one state whose rate is z, from equations of (x, z, u, p)."""
    x, z, u, p = ca.SX.sym("x"), ca.SX.sym("z", size), ca.SX.sym("u"), ca.SX.sym("p")
    rates = z[0] if rates is None else rates(x, z, u, p)
    return Plant(x, u, None, p, rates, ONE, dt=0.1, z=z, algebraic=equations(x, z, u, p), **changes)


def rate(plant, x, u=0.0, p=1.0):
    """dx/dt at a point."""
    return float(plant.right_hand_side(x, u, [], p))


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_trajectories_are_those_of_idas_in_any_units(name):
    case = CASES[name]()
    assert apart(case.by_plant(), case.by_idas()) < 1e-6


@pytest.mark.long
@pytest.mark.parametrize("name", ["pendulum", "diode", "reactor", "column"])
def test_derivatives_are_those_of_the_implicit_function(name):
    case = CASES[name]()
    plant = case.plant()
    x, u, p = case.start + 0.01 * np.ptp(case.start), case.inputs[1], np.array(case.at)
    z = ca.rootfinder("z", "newton", {"x": case.z, "p": ca.vertcat(case.x, case.u, case.p), "g": case.equations})
    guess = ca.Function("guess", [case.x, case.u, case.p], [ca.SX.ones(case.z.shape) * ca.SX(case.guess)])
    columns = [case.x, case.z, case.u, case.p]
    by = {
        name: ca.Function("f", columns, [ca.jacobian(value, one)])
        for value, ofs in ((case.rates, "xuz"), (case.equations, "XUZ"))
        for name, one in zip(ofs, (case.x, case.u, case.z))
    }
    root = z(x0=guess(x, u, p), p=np.concatenate([x, u, p]))["x"]
    f = {name: np.asarray(one(x, root, u, p), dtype=float) for name, one in by.items()}
    point = linearise(plant, x, u)
    for own, given, g in ((point.x, "x", "X"), (point.u, "u", "U")):
        expected = f[given] - f["z"] @ np.linalg.solve(f["Z"], f[g])
        found = np.asarray(ca.Function("J", [point.p], [ca.jacobian(point.dynamics, own)])(p), dtype=float)
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_second_derivatives_and_those_of_torch_are_exact():
    # z + sinh z = p x + u: z' = p / (1 + cosh z), z'' = -p² sinh z / (1 + cosh z)³
    plant = stated(lambda x, z, u, p: z + ca.sinh(z) - p * x - u)
    x = np.linspace(-3, 3, 13)
    z = np.array([rate(plant, one) for one in x])
    second = ca.Function("H", [plant.x, plant.u, plant.p], [ca.hessian(plant.dynamics, plant.x)[0]])
    np.testing.assert_allclose(z + np.sinh(z), x, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose([float(second(one, 0, 1)) for one in x], -np.sinh(z) / (1 + np.cosh(z)) ** 3, atol=1e-13)
    slope = 1 / (1 + np.cosh(z))
    for kind, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        at = torch.tensor(x[:, None], dtype=kind, requires_grad=True)
        before, none, given = (torch.full((13, size), 1.0, dtype=kind) for size in (1, 0, 1))
        (found,) = torch.autograd.grad(to_torch(plant.right_hand_side)(at, 0 * before, none, given).sum(), at)
        np.testing.assert_allclose(found.numpy().ravel(), slope, rtol=tolerance)


def test_what_no_root_is_reached_for_is_no_number():
    plant = stated(lambda x, z, u, p: (1 + z) ** 2 - 1 - 2 * z - x, z_guess=0.5)  # z² = x
    roots = np.array([rate(plant, x) for x in np.geomspace(0.01, 4, 30)])
    np.testing.assert_allclose(roots, np.sqrt(np.geomspace(0.01, 4, 30)), rtol=1e-12)
    assert all(np.isnan(rate(plant, -x)) for x in np.geomspace(1e-12, 1, 40))
    far = stated(lambda x, z, u, p: ca.exp(z) - 1 - x, z_guess=60.0)  # each step leads down by 1
    assert np.isnan(rate(far, 1.0))


@pytest.mark.parametrize(("jump", "none", "root"), [
    (ca.floor, 2.7, None), (ca.sign, 0.5, None), (lambda z: ca.if_else(z > 1, 1, 0), 1.5, None),
    (ca.sign, 3.0, 2.0), (lambda z: ca.if_else(z > 1, 1, 0), 0.5, 0.5),
])  # fmt: skip
def test_equations_that_jump_are_met_or_there_is_no_number(jump, none, root):
    found = rate(stated(lambda x, z, u, p: z + jump(z) - x), none)
    assert np.isnan(found) if root is None else found == pytest.approx(root)


def test_equations_one_after_the_other_are_as_large_as_they_are_many():
    def in_a_row(x, z, u, p):
        return ca.vertcat(*(one + one**3 - before for one, before in zip(ca.vertsplit(z), (x, *ca.vertsplit(z)))))

    plants = [stated(in_a_row, lambda x, z, u, p: z[-1], size=size) for size in (1, 2, 12)]
    one, two, twelve = (plant.right_hand_side.n_instructions() for plant in plants)
    assert twelve - one == pytest.approx(11 * (two - one), rel=0.01)
    z = 1.5
    for _ in range(12):
        z = np.roots([1, 0, 1, -z])
        z = float(z[np.abs(z.imag).argmin()].real)
    assert rate(plants[2], 1.5) == pytest.approx(z, rel=1e-12)


@pytest.mark.long
def test_random_equations_are_met_or_there_is_no_number(rng):
    found = 0
    for _ in range(40):
        a, b, c = rng.standard_normal((3, 3, 3))
        z, s = ca.SX.sym("z", 3), ca.SX.sym("s")
        g = ca.Function("g", [z, s], [ca.mtimes(a, z) + ca.mtimes(b, z**2) + ca.mtimes(c, ca.sin(z)) + s])
        plant = Plant(ca.SX.sym("x", 3), s, None, None, z, DesignSpace([], [], []), dt=1, z=z, algebraic=g(z, s))
        for at in rng.standard_normal(5):
            root = np.asarray(plant.right_hand_side([0, 0, 0], at, [], [])).ravel()
            assert np.isnan(root).any() or np.abs(np.asarray(g(root, at))).max() < 1e-12 * max(
                1, np.abs(root).max() ** 2
            )
            found += np.isfinite(root).all()
    assert found > 100


def test_affine_equations_keep_their_digits_in_mixed_units(rng):
    for spread in (1.0, 1e3, 1e9):
        M = spread ** rng.uniform(-1, 1, (6, 1)) * rng.standard_normal((6, 6)) * spread ** rng.uniform(-1, 1, (1, 6))
        x, z, p = ca.SX.sym("x", 6), ca.SX.sym("z", 6), ca.SX.sym("p")
        plant = Plant(x, None, None, p, z, ONE, dt=1, z=z, algebraic=p * ca.mtimes(M, z) - 1)
        found = np.asarray(plant.right_hand_side([0] * 6, [], [], 1.0)).ravel()
        np.testing.assert_allclose(found, np.linalg.solve(M, np.ones(6)), rtol=1e-9)


def springs(by_hand: bool) -> Plant:
    """A mass on two springs in a row, one of them the design."""
    x, u, w, k = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    z, space = ca.SX.sym("z", 3), DesignSpace(["k"], [1.0], [9.0])
    force = 4 * k / (4 + k) * x[0] if by_hand else z[2]
    rates = ca.vertcat(x[1], -force - 0.3 * x[1] + (1 + 1 / k) * u + w)
    given = {} if by_hand else {"z": z, "algebraic": [4 * z[0] - z[2], k * z[1] - z[2], z[0] + z[1] - x[0]]}
    return Plant(x, u, w, k, rates, space, dt=0.1, outputs=[force], **given)


@pytest.mark.long
def test_a_plant_with_affine_equations_is_linear_and_is_designed_as_by_hand():
    plants = [springs(True), springs(False)]
    assert plants[1].linear
    np.testing.assert_allclose(*(plant.observe([0.3, 1.0], [0.0], [2.0]) for plant in plants), rtol=1e-14)
    problems = [problem_of(plant, np.diag([10.0, 1.0]), [[0.5]]) for plant in plants]
    for matrices in zip(*(problem.model.matrices([3.0]) for problem in problems)):
        np.testing.assert_allclose(*matrices, rtol=1e-12, atol=1e-14)
    designs = [codesign(one, method="nested", rng=np.random.default_rng(0)).design for one in problems]
    np.testing.assert_allclose(*designs, rtol=1e-6)
    (by_hand,), (found,) = ((feasible_sets(one).at([3.0]),) for one in problems)
    assert found.volume == pytest.approx(by_hand.volume, rel=1e-8)


def test_a_plant_with_algebraic_variables_rests_and_is_copied():
    case = cases.diode()
    plant = case.plant()
    for one in (copy.deepcopy(plant), pickle.loads(pickle.dumps(plant))):
        assert float(one.right_hand_side(1.0, 5.0, [], 100.0)) == float(plant.right_hand_side(1.0, 5.0, [], 100.0))
    rest = equilibrium(plant, case.at, u=[5.0])
    current = float(rest.x[0]) / 1e3
    assert float(rest.x[0]) + 0.0517 * np.log1p(current / 1e-9) + 100 * current == pytest.approx(5.0, rel=1e-9)


@pytest.mark.long
def test_a_tank_is_simulated_under_nonlinear_mpc_as_with_its_flow_by_hand():
    """A tank that drains by z, z + z³ = 2 x: Cardano's root."""
    stage = {"stage_cost": lambda x, u: (x - 1) ** 2 + 0.01 * (u - 1) ** 2, "duration": 0.4, "u_bounds": (0, 3)}
    flow = {"algebraic": lambda x, z: z + z**3 - 2 * x, "algebraics": 1, "z_guess": 1.0}
    law = NonlinearMPC(Phase(lambda x, u, z: u - z, 1, 1, **stage, **flow), horizon=4, starts=1)
    plant = stated(lambda x, z, u, p: z + z**3 - 2 * x, lambda x, z, u, p: u - z, z_guess=1.0)
    x, u, p = plant.x, plant.u, plant.p
    root = ca.sqrt(x**2 + 1 / 27)
    cubes = [(x + root) ** (1 / 3), -((root - x) ** (1 / 3))]
    by_hand = Plant(x, u, None, p, u - sum(cubes), ONE, dt=0.1)
    found, expected = (
        simulate(one, law, x0=[[0.2], [2.0]], steps=12, design=[1.0]).states for one in (plant, by_hand)
    )  # fmt: skip
    np.testing.assert_allclose(found, expected, atol=1e-7)
    np.testing.assert_allclose(found[:, -1], 1.0, atol=0.02)


def test_a_discrete_plant_takes_algebraic_variables():
    plant = stated(lambda x, z, u, p: z**3 + z - x - u, continuous=False, z_guess=[1.0])
    assert rate(plant, 9.0, 1.0) == pytest.approx(2.0, rel=1e-14)


@pytest.mark.parametrize(
    ("equations", "size", "names"),
    [
        (lambda x, z, u, p: x - u, 1, ["index > 1", "equation 1, (x-u) = 0", "no z"]),
        (lambda x, z, u, p: ca.SX(1), 1, ["index > 1", "equation 1, 1 = 0", "no z"]),
        (lambda x, z, u, p: ca.vertcat(z[0] - x, x - u), 2, ["index > 1", "equation 2", "derivative by time"]),
        (lambda x, z, u, p: ca.vertcat(z[0] + z[1] - x, 2 * z[0] + 2 * z[1] - u), 2, ["singular", "equations 1, 2"]),
        (lambda x, z, u, p: z**2 - x, 1, ["singular at `z_guess`", "z_guess"]),
        (lambda x, z, u, p: z[0] - x, 2, ["1 equations", "2, one for each"]),
        (lambda x, z, u, p: ca.vertcat(z - x, z - u), 1, ["2 equations", "1, one for each"]),
        (lambda x, z, u, p: z - ca.SX.sym("other"), 1, ["unknown symbols", "other"]),
        (lambda x, z, u, p: "z = x", 1, ["algebraic", "casadi.SX"]),
        (lambda x, z, u, p: z - x * np.nan, 1, ["NaN"]),
    ],
)
def test_equations_that_do_not_determine_z_are_refused_by_name(equations, size, names):
    with pytest.raises(InputError) as error:
        stated(equations, size=size)
    for name in names:
        assert name in str(error.value)


def test_guesses_and_symbols_that_cannot_be_meant_are_refused():
    x, z, u = ca.SX.sym("x"), ca.SX.sym("z"), ca.SX.sym("u")
    for changes, name in (
        ({"z": z, "algebraic": z - x, "z_guess": [1.0, 2.0]}, "z_guess"),
        ({"z": z, "algebraic": z - x, "z_guess": z}, "z_guess"),
        ({"z": x, "algebraic": x - u}, "z"), ({"z": z + 1, "algebraic": z}, "z"), ({"z": z}, "algebraic"),
        ({"z": z, "algebraic": ca.sqrt(z) - x}, "z_guess"), ({"z": z, "algebraic": 1 / z - x}, "z_guess"),
        ({"z": z, "algebraic": ca.log(z) - x, "z_guess": -1.0}, "z_guess"),
        ({"algebraic": z - x}, "algebraic"), ({"z": z, "algebraic": z - x, "z_guess": np.nan}, "z_guess"),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            Plant(x, u, None, None, -x + u, DesignSpace([], [], []), dt=0.1, **changes)
        assert error.value.argument == name
