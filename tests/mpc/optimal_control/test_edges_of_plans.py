"""What a solution says of itself, on both sides of what it says it from."""

import casadi as ca
import numpy as np
import pytest

from mpc.optimal_control import (
    NonlinearMPC,
    OffsetFreeNonlinearMPC,
    OptimalControlStatus,
    Phase,
    Radau,
    build,
    refine,
    solve,
)


@pytest.mark.parametrize(("beside", "named"), [(3e-5, True), (3e-4, False)])
def test_a_duration_that_came_down_to_its_bound_is_named(beside, named):
    least = 2 * (1 - beside)  # a metre from rest to rest takes 2 s at 1 m/s²
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], u), 2, 1, start=[0, 0], end=[1, 0], u_bounds=(-1, 1), duration=(least, 5),
        terminal_cost=lambda t: t,
    )  # fmt: skip
    found = solve(build(phase, Radau(2), 2))
    assert found.phases[0].duration == pytest.approx(2.0, rel=1e-4)
    assert any("came down to its lower bound" in note for note in found.notes) == named


@pytest.mark.parametrize(("intervals", "missed", "coarse"), [(5, 0.02, False), (3, 0.17, True)])
def test_dynamics_that_are_missed_by_a_part_of_the_states_make_a_mesh_coarse(intervals, missed, coarse):
    # an oscillation of 8 rad/s that costs nothing, beside what is planned
    phase = Phase(
        lambda x, u: ca.vertcat(x[1], -64 * x[0], u), 3, 1, start=[1, 0, 0], end=[None, None, 1.0],
        stage_cost=lambda u: u**2, duration=1.0,
    )  # fmt: skip
    found = solve(build(phase, Radau(3), intervals))
    assert found.mesh_error == pytest.approx(missed, rel=0.1)
    assert (found.status is OptimalControlStatus.COARSE) == coarse


@pytest.mark.parametrize(("drift", "steady"), [(3e-9, True), (3e-8, False)])
def test_a_target_of_a_nonlinear_model_that_drifts_by_rounding_is_steady(drift, steady):
    controller = NonlinearMPC(
        lambda x, u: ca.vertcat(0.5 * x[0] + u[0], x[1]), 2, 1, Q=[1.0, 0.0], R=1.0, P=np.eye(2), horizon=3,
        U=(-1, 1), X=([-5, -1], [5, 1]),
    )  # fmt: skip
    target = OffsetFreeNonlinearMPC(controller, [[1, 0]], disturbance=[0.0, drift]).nearest_target([0.2])
    assert target.steady == steady


@pytest.mark.parametrize(("share", "cut"), [(0.3, False), (0.8, True)])
def test_an_input_that_crosses_most_of_its_range_within_an_interval_jumps_there(share, cut):
    phase = Phase(
        lambda x, u: u, 1, 1, start=[0], end=[None], duration=1.0,
        stage_cost=lambda u, t: (u - (1 - share) * t - share * ca.if_else(t > 0.55, 1, 0)) ** 2 + 9,
    )  # fmt: skip
    found = refine(phase, Radau(2), intervals=10)
    assert (len(found.phases[0].times) > 11) == cut
