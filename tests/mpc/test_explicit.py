"""The explicit controller: the same law as online, on any state, stored and drawn."""

import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest
from plants import SUSPENSION, box, double_integrator, suspension
from random_problems import random_plant

from invariant_sets import Polytope
from mpc import ExplicitMPC, InfeasibleError, InputError, LinearMPC, MPQPStatus

mpl.use("Agg")


@pytest.fixture(scope="module")
def online():
    A, B = double_integrator()
    X, U = Polytope.from_bounds([-5, -5], [5, 5]), Polytope.from_bounds([-1], [1])
    return LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=5, X=X, U=U)


@pytest.fixture(scope="module")
def law(online):
    return online.explicit()


def test_equals_the_online_controller_where_it_is_feasible(online, law):
    X = np.random.default_rng(0).uniform(-5, 5, size=(500, 2))
    plans = online.solve_many(X)
    u, outside = law.evaluate(X)
    np.testing.assert_array_equal(outside, [not plan.feasible for plan in plans])
    np.testing.assert_allclose(u[~outside], np.array([p.inputs[0] for p in plans if p.feasible]), atol=1e-9)
    np.testing.assert_allclose(law.value(X[~outside]), [p.cost for p in plans if p.feasible], rtol=1e-9)
    assert np.isinf(law.value(X[outside])).all()


def test_is_a_controller_in_SI_units():
    A, B, _ = suspension()
    online = LinearMPC(A, B, horizon=5, **SUSPENSION)
    law = online.explicit()
    x = np.array([-0.1, -1.0, -0.1, -0.5])
    for _ in range(30):
        u = law(x)
        assert u.shape == (1,)
        np.testing.assert_allclose(u, online(x), atol=1e-6)
        x = A @ x + B @ u
    assert np.abs(x).max() < 1e-2


@pytest.mark.parametrize("size", [5.0, 1e3, 1e12, 1e300])
def test_outside_it_saturates_and_never_gives_nan(law, size):
    X = size * np.array([[1.0, 1.0], [-1.0, 1.0], [0.3, -1.0]])
    u, outside = law.evaluate(X)
    assert outside.all()
    assert np.abs(u).max() <= 1.0
    assert (law.locate(X) == -1).all()


def test_single_and_batched_calls_agree(law):
    X = np.random.default_rng(1).uniform(-5, 5, size=(50, 2))
    u, outside = law.evaluate(X)
    for x, ui, out, region in zip(X, u, outside, law.locate(X)):
        single, alone = law.evaluate(x)
        assert single == ui
        assert alone == out
        assert law.locate(x) == region
    assert law(X).shape == (50, 1)
    assert law(X[:0]).shape == (0, 1)
    np.testing.assert_array_equal(law(np.asfortranarray(X)), u)
    np.testing.assert_array_equal(law(np.repeat(X, 2, axis=0)[::2]), u)


def test_regions_are_polytopes_with_laws(law):
    assert len(law.regions) == len(law) == 31
    for r, region in enumerate(law.regions):
        centre, radius = region.polytope.chebyshev_ball()
        assert radius > 0
        assert law.locate(centre) == r
        np.testing.assert_allclose(law(centre), region.gain @ centre + region.offset)
    area = sum(region.polytope.volume for region in law.regions)
    X = np.random.default_rng(2).uniform(-5, 5, size=(20_000, 2))
    share = 1 - law.evaluate(X)[1].mean()
    assert area / 100 == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / len(X)))


@pytest.mark.long
def test_tree_finds_what_a_scan_finds():
    law = random_plant(5).explicit()
    X = np.random.default_rng(3).uniform(-5, 5, size=(5000, 4))
    rows = law.partition.scaled_rows
    inside = np.maximum.reduceat(X / 5 @ rows[:, :-1].T - rows[:, -1], law.partition.offsets[:-1], axis=1)
    scan = np.where(inside.min(axis=1) <= 1e-7, inside.argmin(axis=1), -1)
    tree = law.locate(X)
    np.testing.assert_array_equal(tree == -1, scan == -1)
    known = tree >= 0
    np.testing.assert_allclose(law.law[tree[known]] @ np.ones(5), law.law[scan[known]] @ np.ones(5), atol=1e-9)
    assert law.tree.depth < 4 * np.log2(len(law))


def test_saved_and_loaded_law_is_the_same(law, tmp_path):
    arrays, manifest = law.save(tmp_path / "laws" / "integrator")
    assert arrays.name == "integrator.npz"
    assert '"regions": 31' in manifest.read_text()
    loaded = ExplicitMPC.load(tmp_path / "laws" / "integrator")
    X = np.random.default_rng(4).uniform(-5, 5, size=(200, 2))
    for a, b in zip(loaded.evaluate(X), law.evaluate(X)):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(loaded.value(X), law.value(X))
    assert loaded.partition.active_sets == law.partition.active_sets
    assert loaded.partition.problem.labels == law.partition.problem.labels
    assert loaded.status is MPQPStatus.COMPLETE
    manifest.write_text(manifest.read_text().replace("explicit-mpc/3", "explicit-mpc/0"))
    with pytest.raises(InputError, match="format 'explicit-mpc/0', expected"):
        ExplicitMPC.load(tmp_path / "laws" / "integrator")


def test_a_dot_in_the_name_of_a_saved_law_is_kept(law, online, tmp_path):
    law.save(tmp_path / "law.v1")
    files = online.explicit(max_regions=3).save(str(tmp_path / "law.v2"))
    assert [file.name for file in files] == ["law.v2.npz", "law.v2.json"]
    assert len(ExplicitMPC.load(tmp_path / "law.v1")) == 31
    assert len(ExplicitMPC.load(tmp_path / "law.v2.json")) == 3


def test_damaged_files_are_refused(law, tmp_path):
    arrays, manifest = law.save(tmp_path / "law")
    content = arrays.read_bytes()
    for damage in (b"", content[:100], content[: len(content) // 2]):
        arrays.write_bytes(damage)
        with pytest.raises(InputError, match="cannot be read"):
            ExplicitMPC.load(tmp_path / "law")
    arrays.write_bytes(content)
    for damage in ("{", "[]", '{"format": "explicit-mpc/2"}'):
        manifest.write_text(damage)
        with pytest.raises(InputError):
            ExplicitMPC.load(tmp_path / "law")


def test_a_rate_limit_makes_the_last_input_a_parameter():
    A, B = double_integrator()
    online = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=4, X=box([5, 5]), U=box([1]), rate_limit=0.5)
    law = online.explicit()
    assert law.nt == 3
    for x, last in (([1.0, 0.5], 0.2), ([-2.0, 1.0], -0.7)):
        np.testing.assert_allclose(law([*x, last]), online(x, u_prev=[last]), atol=1e-8)


def test_move_blocking_and_soft_constraints_have_explicit_laws():
    A, B = double_integrator()
    data = dict(Q=np.eye(2), R=[[0.1]], horizon=6, X=box([5, 5]), U=box([1]))
    for online in (LinearMPC(A, B, **data, blocks=(1, 2, 3)), LinearMPC(A, B, **data, soft=(100.0, 100.0))):
        law = online.explicit()
        X = np.random.default_rng(5).uniform(-5, 5, size=(100, 2))
        plans = online.solve_many(X)
        u, outside = law.evaluate(X)
        np.testing.assert_array_equal(outside, [not plan.feasible for plan in plans])
        np.testing.assert_allclose(u[~outside], np.array([p.inputs[0] for p in plans if p.feasible]), atol=1e-7)


def test_an_incomplete_law_says_so_and_treats_holes_as_outside(online):
    law = online.explicit(max_regions=5)
    assert law.status is MPQPStatus.REGION_LIMIT
    X = np.random.default_rng(6).uniform(-5, 5, size=(300, 2))
    u, outside = law.evaluate(X)
    full, truly = online.explicit().evaluate(X)
    assert outside.sum() > truly.sum()
    np.testing.assert_allclose(u[~outside], full[~outside], atol=1e-9)


def test_a_large_batch_equals_single_states(law):
    X = np.random.default_rng(7).uniform(-5, 5, size=(1_000_000, 2))
    u = law(X)
    picked = np.random.default_rng(8).integers(0, len(X), 200)
    np.testing.assert_allclose(u[picked], [law(x) for x in X[picked]], atol=1e-12)


@pytest.mark.parametrize("what", ["regions", "law", "value"])
def test_plots_return_artists(law, what):
    import matplotlib.pyplot as plt

    drawn = law.plot(what, points=21) if what != "regions" else law.plot(what)
    if what == "regions":
        assert len(drawn) == 31
    else:
        assert drawn.levels is not None
    plt.close("all")


def test_plot_of_an_unknown_thing_is_refused(law):
    with pytest.raises(InputError, match="expected 'regions', 'law' or 'value'"):
        law.plot("volume")


def test_a_section_of_a_law_of_four_states_can_be_drawn():
    import matplotlib.pyplot as plt

    A, B, _ = suspension()
    law = LinearMPC(A, B, horizon=2, **SUSPENSION).explicit()
    assert len(law.plot("regions", axes=(1, 3))) > 2
    plt.close("all")


def test_bad_input_is_refused(online, law):
    with pytest.raises(InputError, match=r"theta: got shape \(3,\), expected \(2,\) or \(n, 2\)"):
        law([1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="theta: got NaN or infinity in row 1"):
        law([[0.0, 0.0], [np.nan, 0.0]])
    with pytest.raises(InputError, match=r"theta: got '.*, expected an array of real numbers"):
        law("here")
    with pytest.raises(InputError, match="max_regions: got nan"):
        online.explicit(max_regions=np.nan)
    with pytest.raises(InputError, match=r"axes: got \(0, 2\), expected two different numbers below 2"):
        law.plot(axes=(0, 2))
    with pytest.raises(InputError, match="theta_set: got None"):
        LinearMPC(online.A, online.B, Q=np.eye(2), R=[[1.0]], horizon=2, U=box([1])).explicit()
    with pytest.raises(InfeasibleError, match="no region"):
        online.explicit(Polytope.from_bounds([90, 90], [99, 99]))


def test_importing_mpc_loads_neither_numba_nor_matplotlib():
    heavy = ("numba", "matplotlib", "torch", "casadi", "cvxpy")
    code = f"import sys, mpc; print([m for m in {heavy} if m in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert shown.strip() == "[]"
