"""Plots show what was solved: every state and input, its bounds, its mesh; phases and scenarios side by side."""

import casadi as ca
import matplotlib as mpl
import numpy as np
import pytest

from mpc import InputError
from mpc.optimal_control import MultipleShooting, OptimalControlProblem, Phase, Radau, build, solve

mpl.use("Agg")


def block(**change):
    """A mass brought over a length of 1."""
    given = {
        "dynamics": lambda x, u: ca.vertcat(x[1], u), "states": 2, "inputs": 1, "start": [0, 0], "end": [1, 0],
        "stage_cost": lambda u: u**2, "u_bounds": (-5, 5), "state_names": ["place [m]", "speed [m/s]"],
    }  # fmt: skip
    return Phase(**(given | change))


@pytest.fixture(autouse=True)
def closed():
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


@pytest.mark.parametrize("scheme", [Radau(3), MultipleShooting()], ids=lambda scheme: scheme.name)
def test_lines_are_the_trajectories_with_their_bounds(scheme):
    solution = solve(build(block(), scheme, 10))
    place, speed, push = solution.plot().axes
    assert [ax.get_ylabel() for ax in (place, speed, push)] == ["place [m]", "speed [m/s]", "u1"]
    times, values = place.lines[0].get_data()
    assert values == pytest.approx(3 * times**2 - 2 * times**3, abs=2e-2)
    times, values = push.lines[0].get_data()
    assert np.nanmax(np.abs(values - (6 - 12 * times))) < 1.3
    dashed = [line.get_ydata()[0] for line in push.lines if line.get_linestyle() == "--"]
    assert sorted(dashed) == [-5, 5]
    assert "SOLVED" in push.figure.get_suptitle()


def test_costates_and_the_mesh_are_drawn_if_asked_for():
    solution = solve(build(block(), Radau(3), 7))
    figure = solution.plot(costates=True)
    assert len(figure.axes) == 5
    assert figure.axes[3].lines[0].get_ydata() == pytest.approx(solution.phases[0].costates[:, 0])
    marks = [line.get_xdata() for line in figure.axes[-1].lines if line.get_marker() == "|"]
    assert marks[0] == pytest.approx(solution.times)
    assert not [line for ax in solution.plot(mesh=False).axes for line in ax.lines if line.get_marker() == "|"]


def test_phases_stand_side_by_side_even_without_inputs():
    drop = Phase(lambda x: ca.vertcat(x[1], -9.81), 2, 0, start=[2, 0], end=[0, None], duration=(0.1, 5))
    rise = Phase(
        lambda x, u: ca.vertcat(x[1], u - 9.81), 2, 1, end=[None, 0], duration=(0.1, 5), u_bounds=(-1, 1),
        terminal_cost=lambda x: -x[0],
    )  # fmt: skip
    problem = OptimalControlProblem([drop, rise], link=lambda x: ca.vertcat(x[0], -0.8 * x[1]))
    shown = [ax for ax in solve(build(problem, Radau(3), 4)).plot().axes if ax.axison]
    assert len(shown) == 5
    assert sum(ax.get_xlabel() == "t [s]" for ax in shown) == 2
    assert sorted(ax.get_ylabel() for ax in shown) == ["", "", "u1", "x1", "x2"]


def test_discrete_dynamics_and_no_figure():
    phase = Phase(lambda x, u: x + u, 1, 1, start=[1.0], duration=5, discrete=True, stage_cost=lambda x, u: x**2 + u**2)
    solution = solve(phase)
    assert solution.plot().axes[-1].get_xlabel() == "step"
    with pytest.raises(InputError, match="Figure"):
        solution.plot(figure=3)
