"""The mechanical studies as matrices: masses, springs, a quarter car, a pendulum, a platform, a rail, a servo."""

from __future__ import annotations

import numpy as np

from gallery.oracle.statement import Array, Statement


def second_order(M: Array, D: Array, S: Array, inputs: Array, disturbances: Array) -> tuple[Array, Array, Array]:
    """Matrices of M q̈ + D q̇ + S q = inputs u + disturbances w, in the state [q, q̇]."""
    n = len(M)
    zero = np.zeros((n, n))
    A = np.block([[zero, np.eye(n)], [-np.linalg.solve(M, S), -np.linalg.solve(M, D)]])
    B = np.vstack([np.zeros_like(inputs), np.linalg.solve(M, inputs)])
    E = np.vstack([np.zeros_like(disturbances), np.linalg.solve(M, disturbances)])
    return A, B, E


def spring_chain(n: int, stiffness: float, damping: float, wall: float) -> tuple[Array, Array]:
    """Damping and stiffness matrices of n masses in a row, the first of them on a wall of another stiffness."""
    links = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    links[-1, -1] = 1.0
    S = stiffness * links
    S[0, 0] += wall - stiffness
    return damping * links, S


def mass_spring_damper() -> Statement:
    """One mass, which is the design."""

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        force = np.array([[1.0]])
        return second_order(p.reshape(1, 1), np.array([[0.3]]), np.array([[2.0]]), force, force)

    return Statement(
        matrices, Q=[10.0, 1.0], R=[0.1], std=[1.8], x0=[1.0, 0.0], p0=[2.0], lower=[0.3], upper=[3.0],
        x_max=[3.0, 5.0], u_max=[20.0], dt=0.1,
    )  # fmt: skip


def quarter_car() -> Statement:
    """Spring, damper and tyre of a quarter car."""
    sprung, unsprung = 300.0, 40.0

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        spring, damper, tyre = p
        A = [
            [0, 1, 0, 0],
            [-tyre / unsprung, -damper / unsprung, spring / unsprung, damper / unsprung],
            [0, -1, 0, 1],
            [0, damper / sprung, -spring / sprung, -damper / sprung],
        ]
        return np.array(A), np.array([[0], [-1 / unsprung], [0], [1 / sprung]]), np.array([[-1.0], [0], [0], [0]])

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        spring, damper, tyre = p
        deflection, rate = x[:, 2], x[:, 3] - x[:, 1]
        force = spring * (deflection + 40.0 * deflection**3) + damper * np.where(rate > 0, 1.3, 0.7) * rate
        acceleration = (-tyre * x[:, 0] + force - u[:, 0]) / unsprung
        return np.stack([x[:, 1] - w[:, 0], acceleration, rate, (u[:, 0] - force) / sprung], axis=1)

    return Statement(
        matrices, Q=[4e4, 1.0, 2e3, 40.0], R=[1e-5], std=[0.25], x0=[0.0, 0.0, 0.05, 0.0],
        p0=[30000.0, 800.0, 250000.0], lower=[8000.0, 400.0, 120000.0], upper=[40000.0, 4000.0, 300000.0],
        x_max=[0.06, 3.0, 0.12, 1.5], u_max=[4000.0], dt=0.02, real=real,
    )  # fmt: skip


def pendulum() -> Statement:
    """An inverted pendulum in gusts, whose rod and bob are the design."""
    gravity, friction = 9.81, 0.1

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        length, mass = p
        inertia = mass * length**2
        A = [[0, 1], [gravity / length, -friction / inertia]]
        return np.array(A), np.array([[0], [1 / inertia]]), np.array([[0], [length / inertia]])

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        length, mass = p
        inertia = mass * length**2
        drag = friction * x[:, 1] + 0.15 * np.tanh(x[:, 1] / 0.05)
        torque = 0.85 * u[:, 0] + length * w[:, 0] - drag
        return np.stack([x[:, 1], gravity / length * np.sin(x[:, 0]) + torque / inertia], axis=1)

    return Statement(
        matrices, Q=[50.0, 5.0], R=[0.4], std=[1.0], x0=[0.4, 0.0], p0=[0.7, 0.6], lower=[0.3, 0.3],
        upper=[1.0, 1.5], x_max=[1.0, 3.0], u_max=[12.0], dt=0.05, real=real,
    )  # fmt: skip


def platform() -> Statement:
    """A platform on two struts with an actuator each: where the rear strut stands, and how stiff both are."""
    mass, inertia, damping, front = 20.0, 1.5, 30.0, 0.4

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        rear, stiffness = p
        struts = np.array([[1.0, 1.0], [front, -rear]])
        M = np.diag([mass, inertia])
        return second_order(M, damping * struts @ struts.T, stiffness * struts @ struts.T, struts, np.eye(2))

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        rear, stiffness = p
        struts = np.array([[1.0, 1.0], [front, -rear]])
        stretch, rate = x[:, :2] @ struts, x[:, 2:] @ struts
        forces = u * np.array([1.0, 0.6]) - damping * rate - stiffness * (stretch + 20.0 * stretch**3)
        return np.hstack([x[:, 2:], (forces @ struts.T + w) / np.array([mass, inertia])])

    return Statement(
        matrices, Q=[400.0, 200.0, 5.0, 1.0], R=[2e-4, 2e-4], std=[40.0, 8.0], x0=[0.1, -0.1, 0.0, 0.0],
        p0=[0.8, 1500.0], lower=[0.1, 100.0], upper=[1.0, 3000.0], x_max=[0.2, 0.2, 1.5, 2.0],
        u_max=[400.0, 400.0], dt=0.05, real=real,
    )  # fmt: skip


def chain_of_3() -> Statement:
    """Three masses in a row, pushed at the first: the springs and the dampers between them."""

    def parts(p: Array, scale: float) -> tuple[Array, Array, Array]:
        D, S = spring_chain(3, p[0], p[1], 50.0)
        return np.diag([1.0, 1.0, 0.5]) * scale, D, S

    at_first, at_last = np.eye(3)[:, :1], np.eye(3)[:, 2:]

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        return second_order(*parts(p, 1.0), at_first, at_last)

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        A, B, E = second_order(*parts(p, 1.3), at_first, at_last)
        return x @ A.T + u @ B.T + w @ E.T

    return Statement(
        matrices, Q=[1.0, 1.0, 20.0, 0.1, 0.1, 1.0], R=[0.01], std=[2.0], x0=[0.0, 0.0, 0.3, 0.0, 0.0, 0.0],
        p0=[30.0, 0.5], lower=[10.0, 0.1], upper=[150.0, 4.0], x_max=[0.3, 0.4, 0.6, 2.0, 2.0, 5.0],
        u_max=[60.0], dt=0.05, real=real,
    )  # fmt: skip


def chain_of_4() -> Statement:
    """Four masses in a row, pushed at the first: the springs between them and the mass at the end."""

    def parts(p: Array) -> tuple[Array, Array, Array]:
        D, S = spring_chain(4, p[0], 0.8, 80.0)
        return np.diag([1.0, 1.0, 1.0, p[1]]), D, S

    at_first, at_last = np.eye(4)[:, :1], np.eye(4)[:, 3:]

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        return second_order(*parts(p), at_first, at_last)

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        A, B, E = second_order(*parts(p), at_first, at_last)
        stretch = x[:, 1:4] - x[:, 0:3]
        hardening = np.zeros_like(x)
        extra = 1.5 * p[0] * stretch**3
        hardening[:, 4:7] += extra
        hardening[:, 5:8] -= extra
        hardening[:, 7] *= 1 / p[1]
        return x @ A.T + u @ B.T + w @ E.T + hardening

    return Statement(
        matrices, Q=[1.0, 1.0, 1.0, 20.0, 0.1, 0.1, 0.1, 1.0], R=[0.01], std=[2.0],
        x0=[0.0, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0], p0=[60.0, 1.5], lower=[20.0, 0.3], upper=[200.0, 2.0],
        x_max=[0.4, 0.4, 0.5, 0.6, 3.0, 3.0, 4.0, 10.0], u_max=[60.0], dt=0.05, real=real,
    )  # fmt: skip


def rail_mass() -> Statement:
    """A mass on a rail with a speed limit: how heavy it is."""

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        force = np.array([[1.0]])
        return second_order(p.reshape(1, 1), np.array([[0.4]]), np.array([[0.0]]), force, force)

    return Statement(
        matrices, Q=[1.0, 0.1], R=[0.5], std=[0.7], x0=[-1.5, 0.0], p0=[2.0], lower=[0.3], upper=[3.0],
        x_max=[2.0, 0.5], u_max=[2.0], dt=0.1,
    )  # fmt: skip


def servo() -> Statement:
    """A motor that turns a load over a gear: its ratio, and a flywheel on the load."""
    motor, load, torque = 2e-5, 4e-3, 0.05

    def inertia(p: Array) -> float:
        ratio, flywheel = p
        return load + flywheel + motor * ratio**2

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        ratio = p[0]
        J = inertia(p)
        friction = 1e-3 + 2e-5 * ratio**2
        return np.array([[0, 1], [0, -friction / J]]), np.array([[0], [torque * ratio / J]]), np.array([[0], [1 / J]])

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        ratio = p[0]
        J = inertia(p) + 0.5 * load
        friction = 1e-3 + 2e-5 * ratio**2
        drag = friction * x[:, 1] + 0.02 * np.tanh(x[:, 1] / 0.1)
        return np.stack([x[:, 1], (torque * ratio * u[:, 0] + w[:, 0] - drag) / J], axis=1)

    return Statement(
        matrices, Q=[20.0, 0.02], R=[0.05], std=[0.3], x0=[1.0, 0.0], p0=[30.0, 4e-3], lower=[4.0, 0.0],
        upper=[40.0, 1e-2], x_max=[2.0, 30.0], u_max=[12.0], dt=0.02, real=real,
    )  # fmt: skip
