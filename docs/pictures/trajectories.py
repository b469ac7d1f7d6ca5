"""The problem of Bryson and Denham: there and back within a limit, with the least effort."""

from pathlib import Path

import casadi as ca
from matplotlib.figure import Figure

from mpc.optimal_control import Phase, refine

free = float("inf")
cart = Phase(
    dynamics=lambda x, u: ca.vertcat(x[1], u),
    states=2,
    inputs=1,
    stage_cost=lambda u: u**2 / 2,
    start=[0, 1],
    end=[0, -1],
    x_bounds=([-free, -free], [1 / 9, free]),
    state_names=["position [m]", "speed [m/s]"],
    input_names=["force [N]"],
)
figure = refine(cart, tolerance=1e-6).plot(figure=Figure(figsize=(7, 4.5), layout="constrained"))
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
