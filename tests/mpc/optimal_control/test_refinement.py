"""Refinement ends where it was asked to, or by time or rounds, or where finer meshes do not help; it says which."""

import casadi as ca
import numpy as np
import pytest
from classical_problems import CLASSICAL

from mpc import InputError
from mpc.optimal_control import OptimalControlStatus, Phase, Radau, build, refine, solve


def rough(power):
    """A state that moves as t^power besides: its slope at t = 0 is beyond polynomials, the more the smaller power."""
    return Phase(
        dynamics=lambda u, t: u + power * t ** (power - 1), states=1, inputs=1, start=[0], end=[0], duration=1.0,
        stage_cost=lambda u: u**2,
    )  # fmt: skip


def test_refinement_ends_where_finer_meshes_no_longer_help():
    found = refine(rough(0.01), tolerance=1e-8)
    assert found.status is OptimalControlStatus.STOPPED
    assert "2 times in a row a finer mesh missed as much" in found.advice
    assert np.diff(found.times).min() > 1e-5  # ten rounds of six parts each would come to 1e-8
    worst = found.errors[0].max()
    assert f"{worst:.1e} where 1.0e-08 was asked for" in found.advice
    reached = float(found.advice.split("Ask for ")[1].split()[0].rstrip(".,"))
    assert worst <= reached < 10 * worst


@pytest.mark.long
def test_refinement_goes_on_while_it_helps():
    # the error of the first interval falls with its root, and other intervals have none
    found = refine(rough(0.5), tolerance=3e-4, rounds=20)
    assert found.solved
    assert found.errors[0].max() <= 3e-4
    few = refine(rough(0.5), tolerance=3e-4, rounds=3)
    assert few.status is OptimalControlStatus.STOPPED
    assert "these were all the rounds" in few.advice
    assert few.errors[0].max() < solve(build(rough(0.5), Radau(3), 10)).errors[0].max()


def test_a_time_that_is_up_at_once_stops_the_first_mesh():
    late = refine(CLASSICAL["robot arm"].phase, intervals=200, time_limit=1e-3)
    assert late.status is OptimalControlStatus.STOPPED


def test_refinement_shows_how_far_it_is(capsys):
    refine(CLASSICAL["Bryson-Denham"].phase, progress=True)
    shown = capsys.readouterr().err
    assert "refining" in shown
    assert "10 intervals miss" in shown
    refine(CLASSICAL["Bryson-Denham"].phase)
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    "change", [{"tolerance": "small"}, {"tolerance": np.nan}, {"rounds": 0}, {"time_limit": -1}, {"time_limit": "1 s"}]
)
def test_bad_calls_are_refused(change):
    with pytest.raises(InputError) as caught:
        refine(CLASSICAL["Bryson-Denham"].phase, **change)
    assert caught.value.argument == next(iter(change))


def test_dynamics_that_are_not_finite_between_the_points_are_not_met():
    # a root of less than nothing where x dips below 0 between the points that keep it at 0 or more
    dipped = Phase(
        dynamics=lambda x, u: ca.vertcat(x[1], u, ca.sqrt(x[0])), states=3, inputs=1, start=[0.3, -2, 0],
        end=[0.3, 2, None], duration=1.0, stage_cost=lambda u: u**2, x_bounds=([0, -9, -9], 99),
    )  # fmt: skip
    found = solve(build(dipped, Radau(2), 2))
    values = found.phases[0].x(np.linspace(0, 1, 200))[:, 0]
    assert values.min() < 0
    assert np.isinf(found.errors[0]).any()


@pytest.mark.check
def test_a_corridor_that_is_blocked_is_not_made_passable_by_a_lower_accuracy():
    # a disc across the whole corridor: a coarse mesh steps over it, a fine one cannot
    blocked = Phase(
        dynamics=lambda u: u, states=2, inputs=2, start=[-3, 0], end=[3, 0], duration=(1, 20),
        u_bounds=([-2, -2], [2, 2]), x_bounds=([-9, -0.7], [9, 0.7]), terminal_cost=lambda t: t,
        path=lambda x: 1 - x[0] ** 2 - x[1] ** 2, path_names=["outside the disc"],
    )  # fmt: skip
    found = refine(blocked, tolerance=1e-6, intervals=10, time_limit=60)
    assert not found.solved
    assert "Ask for" not in found.advice
    told = (found.advice, *found.conflicts)
    assert any("finer mesh" in one or "outside the disc" in one for one in told)


@pytest.mark.parametrize("intervals", [1, 2])
def test_refinement_begins_at_a_mesh_of_one_or_two_intervals(intervals):
    phase = Phase(lambda x, u: u, 1, 1, start=[0], end=[1], duration=1.0, stage_cost=lambda x, u: u**2 + 2 * x**4)
    found = refine(phase, Radau(3), intervals=intervals)
    assert found.cost == pytest.approx(refine(phase, Radau(3), intervals=8).cost, rel=1e-5)
    assert len(found.phases[0].times) > intervals + 1


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["Bryson-Denham", "brachistochrone", "hypersensitive", "shortest time", "orbit raising"]
)
@pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
def test_a_tolerance_of_the_cost_asks_for_no_finer_mesh_than_the_cost_needs(name, tolerance):
    case = CLASSICAL[name]
    best = refine(case.phase, tolerance=1e-8).cost
    found, finer = (refine(case.phase, tolerance=tolerance, of=of) for of in ("cost", "dynamics"))
    assert found.solved, found.advice
    assert abs(found.cost - best) <= tolerance * abs(best)
    assert found.cost_error <= tolerance * abs(found.cost)
    beside = 6 if name == "shortest time" else 0  # a switch at a node has no unique multipliers
    assert len(found.times) <= 1.1 * len(finer.times) + beside


def test_a_tolerance_is_of_dynamics_or_cost():
    with pytest.raises(InputError, match="of: got 'inputs', expected 'dynamics' or 'cost'"):
        refine(CLASSICAL["Bryson-Denham"].phase, of="inputs")
    with pytest.raises(InputError, match="of"):
        refine(CLASSICAL["Bryson-Denham"].phase, of=np.ones(2))


def test_what_misses_a_tolerance_of_the_cost_says_by_how_much():
    short = refine(CLASSICAL["hypersensitive"].phase, tolerance=1e-9, of="cost", rounds=2)
    assert short.status is OptimalControlStatus.STOPPED
    assert "the mesh misses the cost by" in short.advice


def test_a_cost_that_vanishes_is_met_by_its_size():
    # from rest to rest with nothing to do: the cost is 0
    still = refine(Phase(lambda u: u, 1, 1, stage_cost=lambda x, u: x**2 + u**2, start=[0], end=[0]), of="cost")
    assert still.solved, still.advice
    assert still.cost == pytest.approx(0.0, abs=1e-12)


def test_the_cost_of_inputs_that_jump_is_found_more_sharply_than_the_dynamics():
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, start=[0, 0], end=[1, 0], u_bounds=(-1, 1), duration=(0.1, 5),
        terminal_cost=lambda t: t,
    )  # fmt: skip
    assert refine(phase, tolerance=1e-4).cost == pytest.approx(2.0, abs=1e-6)


def test_where_dynamics_are_met_at_once_the_mesh_is_cut_for_the_cost():
    """An integrator along a fast sine: polynomials meet its dynamics, whatever the mesh."""
    phase = Phase(lambda x, u: u, 1, 1, stage_cost=lambda x, u, t: (x - ca.sin(10 * t)) ** 2 + 1e-4 * u**2, start=[0.0],
                  duration=4.0)  # fmt: skip
    best = refine(phase, Radau(5), intervals=40, of="cost", tolerance=1e-8)
    for intervals in (8, 12, 20):
        found = refine(phase, intervals=intervals)
        assert found.status.name == "SOLVED"
        assert found.cost == pytest.approx(best.cost, rel=0.003)


def test_what_meets_its_cost_and_misses_the_dynamics_says_so():
    """A state that nothing is asked of, too fast for the mesh."""
    phase = Phase(lambda x, u, t: ca.vertcat(u - x[0], 20 * ca.cos(20 * t)), 2, 1, start=[1.0, 0.0], duration=5.0,
                  stage_cost=lambda x, u: x[0] ** 2 + u**2)  # fmt: skip
    found = refine(phase, intervals=4, of="cost", tolerance=0.01, rounds=1)
    assert found.status.name == "STOPPED"
    assert "misses the dynamics by 3.6e-01 where 5.0e-02 was asked for. Take more intervals" in found.advice


def test_a_limit_that_is_passed_is_named_where_the_dynamics_are_met():
    still = Phase(
        dynamics=lambda x: 0 * x, states=1, inputs=0, duration=1.0, terminal_cost=lambda x: (x - 1) ** 2,
        path=lambda x, t: x - (t - 0.4) ** 2,
    )  # fmt: skip
    found = refine(still, intervals=1, rounds=1)
    assert found.status is OptimalControlStatus.LIMITS_PASSED
    assert "these were all the rounds: the mesh passes limits between its points by 1.0e+02" in found.advice
    assert "Call `refine`" not in found.advice


def least_time(far, fastest, forward, back, **options):
    """Refined way to rest with a limit of speed, and the least time there is."""
    least = far / fastest + fastest / (2 * forward) + fastest / (2 * back)
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, terminal_cost=lambda t: t, start=[0, 0], end=[far, 0],
        duration=(0.1, 100), duration_guess=1.3 * least, u_bounds=(-back, forward),
        x_bounds=([-np.inf] * 2, [np.inf, fastest]),
    )  # fmt: skip
    return refine(phase, **options), least


@pytest.mark.parametrize("way", [(10, 1, 1, 1), (1e4, 1e3, 1e3, 1e3), (100, 5, 2, 3), (20, 3, 1, 0.5)])
def test_a_limit_that_is_passed_by_the_tolerance_of_the_solver_is_kept_with_a_smaller_one(way):
    # where the way meets its limit intervals are so short that the solver leaves room beside the limit
    found, least = least_time(*way)
    assert found.status.name == "SOLVED"
    assert found.excess <= 1e-5
    assert found.cost == pytest.approx(least, rel=1e-6)
