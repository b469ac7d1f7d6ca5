"""Plans from several starts: the best optimum, and how many ended where."""

import casadi as ca
import numpy as np
import pytest

from mpc import InputError
from mpc.optimal_control import MultipleShooting, OptimalControlProblem, Phase, Radau, build, refine, solve

NAMES = [*["SOLVED", "LIMITS_PASSED", "COARSE"]]


def between_wells(unit=1.0, second=1.0):
    """A point that may stay in the well that it begins in, or go to one that is twice as deep."""

    def cost(x, u):
        z, v = x[0] / unit, u[0] * second / unit
        return (1 - ca.exp(-(z**2) / 0.1) - 2 * ca.exp(-((z - 2) ** 2) / 0.1) + 0.05 * v**2) / second

    return Phase(
        dynamics=lambda u: u, states=1, inputs=1, stage_cost=cost, start=[0], duration=4 * second,
        x_bounds=([-4 * unit], [4 * unit]), u_bounds=([-3 * unit / second], [3 * unit / second]),
    )  # fmt: skip


def past_disc():
    """A point that passes a disc below its way on the shorter side, above it, or on the longer one."""
    return Phase(
        dynamics=lambda u: u, states=2, inputs=2, stage_cost=lambda u: ca.sumsqr(u), start=[-2, 0], end=[2, 0],
        duration=1.0, path=lambda x: 1 - ca.sumsqr(x - ca.DM([0, -0.3])), x_bounds=([-3, -3], [3, 3]),
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("unit", "second"), [(1, 1), (1e-4, 1), (1e3, 60)])
@pytest.mark.parametrize("how", [refine, solve])
def test_the_deeper_well_is_found_from_the_other_in_any_units(unit, second, how):
    phase = between_wells(unit, second)
    near, best = how(phase), how(phase, starts=6)
    assert near.solved
    assert best.solved
    assert near.cost > -1e-6
    np.testing.assert_allclose(best.x(4 * second), 2 * unit, rtol=0.02)
    assert best.cost < near.cost - 1
    assert sum(one.count for one in best.ends) == 6
    np.testing.assert_allclose(best.cost, min(one.cost for one in best.ends), rtol=1e-6)
    assert f"Of 6 starts ended: {best.ends[0].count} SOLVED at {best.cost:.6g}" in best.advice


def test_one_start_is_told_as_before():
    found = solve(between_wells())
    assert found.ends == ()
    assert "starts" not in found.advice


def test_of_guesses_given_the_shorter_side_is_taken():
    program = build(past_disc(), intervals=20)
    ways = [([0, 0.5, 1], [[-2, 0], [0, side], [2, 0]], np.zeros((3, 2))) for side in (-2, 2)]
    longer, shorter = (solve(program, starts=[way]) for way in ways)
    assert longer.cost > 1.05 * shorter.cost
    both = solve(program, starts=[*ways, longer])
    np.testing.assert_allclose(both.cost, shorter.cost, rtol=1e-6)
    assert [one.count for one in both.ends] == [1, 2]
    np.testing.assert_allclose([one.cost for one in both.ends], [shorter.cost, longer.cost], rtol=1e-6)


@pytest.mark.long
def test_a_homotopy_over_a_limit_goes_on_from_the_optimum_that_a_tighter_one_forces():
    """A motor that is too weak to lift a pendulum at once swings it up, which is cheaper for a strong one, too."""
    swing = Phase(
        lambda x, u: ca.vertcat(x[1], u - 9.81 * ca.sin(x[0])), 2, 1, stage_cost=lambda u: u**2, start=[0, 0],
        end=[np.pi, 0], duration=4.0, path=lambda u, p: ca.vertcat(u - p, -u - p),
    )  # fmt: skip
    program = build(OptimalControlProblem(swing, p_bounds=(0.5, 20)), Radau(3), 40)
    found = None
    for torque in (4, 8, 20):
        found = solve(program, p=[torque], start=found)
        assert found.solved
    assert found.cost < 0.71 * solve(program, p=[20]).cost


def test_an_optimum_on_the_longer_side_is_refined_only_if_it_may_be_better():
    ways = [([0, 0.5, 1], [[-2, 0], [0, side], [2, 0]], np.zeros((3, 2))) for side in (-2, 2)]
    both = refine(past_disc(), starts=ways)
    assert both.solved
    np.testing.assert_allclose(both.cost, refine(past_disc(), starts=ways[1:]).cost, rtol=1e-6)


def test_what_is_infeasible_stays_so_from_every_start():
    phase = Phase(dynamics=lambda u: u, states=1, inputs=1, stage_cost=lambda u: u**2, start=[0], end=[3],
                  duration=1.0, u_bounds=([-1], [1]))  # fmt: skip
    found = solve(phase, starts=4)
    assert found.status.name == "INFEASIBLE"
    assert sum(one.count for one in found.ends) == 4
    assert not any(one.status.name in NAMES for one in found.ends)


def test_time_that_is_up_leaves_starts_out():
    found = solve(between_wells(), starts=100_000, time_limit=0.5)
    assert found.solved
    assert sum(one.count for one in found.ends) < 100_000


@pytest.mark.long
def test_discrete_linked_free_and_shared_statements_have_starts_too():
    step = Phase(dynamics=lambda x, u: x + 0.1 * u, states=1, inputs=1, stage_cost=lambda x, u: x**2 + u**2, start=[1],
                 duration=20, discrete=True)  # fmt: skip
    there = Phase(dynamics=lambda x, u: ca.vertcat(x[1], u), states=2, inputs=1, stage_cost=lambda u: u**2 + 1,
                  start=[0, 0], end=[1, None], duration=(0.1, 9), u_bounds=([-1], [1]))  # fmt: skip
    back = Phase(dynamics=lambda x, u, p: ca.vertcat(x[1], p * u), states=2, inputs=1, stage_cost=lambda u: u**2,
                 end=[0, 0], duration=3.0)  # fmt: skip
    linked = OptimalControlProblem([there, back], p_bounds=([0.5], [2.0]), p_cost=lambda p: p**2)
    one = Phase(dynamics=lambda x, u, p: p * u - x, states=1, inputs=1, stage_cost=lambda x, u: (x - 1) ** 2 + u**2,
                start=[0], duration=2.0)  # fmt: skip
    worst = OptimalControlProblem([one, one], p_bounds=([0.5], [2.0]), linked=False, risk="worst")
    drawn = Phase(dynamics=lambda z: z, states=1, inputs=1, algebraic=lambda x, u, z: z - u + x, algebraics=1,
                  stage_cost=lambda x, u: x**2 + u**2, start=[1], duration=2.0)  # fmt: skip
    for problem in (step, linked, worst, drawn):
        alone, several = solve(problem), solve(problem, starts=3)
        assert several.solved_on_mesh
        np.testing.assert_allclose(several.cost, alone.cost, rtol=1e-5)
        assert sum(end.count for end in several.ends) == 3


@pytest.mark.parametrize("starts", [0, -1, 1.5, "all", [], [3], [([0, 1], [[0], [2], [3]], [[0], [0]])], None])
def test_bad_starts_are_named(starts):
    with pytest.raises(InputError):
        solve(between_wells(), starts=starts)


def test_a_start_beside_a_list_and_a_path_of_several_phases_are_refused():
    found = solve(between_wells())
    with pytest.raises(InputError, match="Put it into the list"):
        solve(between_wells(), start=found, starts=[found])
    with pytest.raises(InputError, match="a Solution of these phases"):
        solve(OptimalControlProblem([past_disc(), past_disc()], linked=False),
              starts=[([0, 1], np.zeros((2, 2)), np.zeros((2, 2)))])  # fmt: skip
    by_shooting = solve(build(between_wells(), MultipleShooting(), 40), starts=[found])
    assert by_shooting.solved_on_mesh


def test_of_starts_that_were_stopped_the_best_is_handed_out():
    phase = Phase(
        dynamics=lambda u: u, states=1, inputs=1, start=([-5], [5]), duration=1.0, u_bounds=([-1], [1]),
        stage_cost=lambda x, u: (x - 3) ** 2 * (1 + (x + 1) ** 2) + u**2, x_bounds=([-5], [5]),
    )  # fmt: skip
    program = build(phase, intervals=10)
    far, near = (([0, 1], [[at], [at]], np.zeros((2, 1))) for at in (-1.0, 3.0))
    one, other = (solve(program, starts=[place], max_iterations=2) for place in (far, near))
    assert one.cost > 2 * other.cost
    both = solve(program, starts=[far, near], max_iterations=2)
    assert both.status.name == other.status.name
    assert both.cost == pytest.approx(other.cost)


def test_a_cost_without_end_is_told_among_the_ends():
    phase = Phase(
        dynamics=lambda u: u, states=1, inputs=1, start=([-1e4], [1e4]), duration=1.0,
        stage_cost=lambda x, u: x**2 - x**4 / 40 + u**2,
    )  # fmt: skip
    program = build(phase, intervals=5)
    places = [([0, 1], [[at], [at]], np.zeros((2, 1))) for at in (0.1, 50.0)]
    assert solve(program, starts=places[1:]).status.name == "UNBOUNDED"
    found = solve(program, starts=places)
    assert {one.status.name for one in found.ends} == {"SOLVED", "UNBOUNDED"}
    assert "UNBOUNDED" in found.advice


@pytest.mark.parametrize("wrong", [True, 1.0, 0, "two", []])
def test_numbers_of_starts_are_whole(wrong):
    for how in (solve, refine):
        with pytest.raises(InputError, match="starts: got"):
            how(between_wells(), starts=wrong)
