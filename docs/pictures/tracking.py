"""An output held at its reference under a force that the model does not know, with and without an estimate of it."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mpc import LinearMPC, OffsetFreeMPC

A, B = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.005], [0.1]])
mpc = LinearMPC(A, B, Q=[1.0, 1.0], R=0.5, horizon=20, X=(-5, 5), U=(-1, 1), E=B)
tracking = OffsetFreeMPC(mpc, C=[[1.0, 0.0]])
loop = tracking.loop()
laws = {
    "plain MPC": lambda x: mpc(x, x_ref=[2.0, 0.0]),
    "offset-free MPC": lambda x: loop(x[None], x_ref=np.array([[2.0, 0.0]]), u_prev=last)[0],
}

figure = Figure(figsize=(8, 2.8), layout="constrained")
position, force = figure.subplots(1, 2)
for name, law in laws.items():
    x, last, states, inputs = np.zeros(2), np.zeros((1, 1)), [], []
    for _ in range(100):
        u = law(x)
        states.append(x)
        inputs.append(u[0])
        x, last = A @ x + B @ u + B @ [-0.4], u[None]
    position.plot(0.1 * np.arange(100), np.array(states)[:, 0], label=name)
    force.plot(0.1 * np.arange(100), inputs)
position.axhline(2.0, color="k", lw=0.8, ls="--")
position.set(xlabel="time [s]", title="position [m], reference 2 m")
force.set(xlabel="time [s]", title="input [m/s²]; an unknown −0.4 m/s² acts")
position.legend(loc="lower right")
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
