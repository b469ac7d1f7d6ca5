"""The other studies as matrices: two unstable modes, a beam with two good places for its actuator, a heated room."""

from __future__ import annotations

import numpy as np

from gallery.oracle.statement import Array, Statement


def two_unstable_modes() -> Statement:
    """Two unstable modes on one input that saturates: how strongly the second mode is driven."""

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        return np.diag([0.5, 0.2]), np.array([[1.0], [p[0]]]), np.eye(2)

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        drive = 0.95 * u[:, 0] + 0.1
        return x * np.array([0.5, 0.2]) + np.stack([drive, p[0] * drive], axis=1) + w

    return Statement(
        matrices, Q=[1.0, 1.0], R=[0.1], std=[0.3, 0.3], x0=[0.8, 0.8], p0=[1.4], lower=[0.4], upper=[2.0],
        x_max=[3.0, 3.0], u_max=[1.0], dt=0.1, real=real,
    )  # fmt: skip


def beam() -> Statement:
    """Two modes of a simply supported beam, a disturbance off its middle, and the place of the actuator."""
    frequencies = 2 * np.pi * np.array([0.8, 1.6])

    def shapes(place: float) -> Array:
        return np.sin(np.pi * np.array([1, 2]) * place)

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.diag(frequencies**2), -np.diag(0.04 * frequencies)]])
        B = np.r_[np.zeros(2), shapes(p[0])][:, None]
        E = np.r_[np.zeros(2), shapes(0.3)][:, None]
        return A, B, E

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        A, B, E = matrices(p)
        rates = x @ A.T + u @ B.T + w @ E.T
        rates[:, 2] -= 8.0 * x[:, 0] ** 3
        return rates

    return Statement(
        matrices, Q=[100.0, 100.0, 1.0, 1.0], R=[0.02], std=[5.0], x0=[0.2, 0.3, 0.0, 0.0], p0=[0.8],
        lower=[0.05], upper=[0.95], x_max=[0.8, 0.8, 5.0, 8.0], u_max=[60.0], dt=0.05, real=real,
    )  # fmt: skip


def heated_room() -> Statement:
    """A room and its wall, heated from within: how thick the wall is, deviations from the set temperature."""
    area, conductivity, volumetric, air, film = 60.0, 0.5, 1.2e6, 6e5, 3.0  # m², W/(m K), J/(m³ K), J/K, W/(m² K)

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        thickness = p[0]
        wall = volumetric * area * thickness
        half = 2 * conductivity * area / thickness
        inside = 1 / (1 / (film * area) + 1 / half)
        A = [[-inside / air, inside / air], [inside / wall, -(inside + half) / wall]]
        return np.array(A), np.array([[1e3 / air], [0]]), np.array([[1e3 / air, 0], [0, half / wall]])

    def real(x: Array, u: Array, w: Array, p: Array) -> Array:
        A, B, E = matrices(p)
        rates = x @ A.T + 0.7 * u @ B.T + w @ E.T
        rates[:, 0] -= 1.5e-5 * np.abs(x[:, 0]) * x[:, 0]
        return rates

    return Statement(
        matrices, Q=[1.0, 0.1], R=[0.05], std=[0.6, 6.0], x0=[-3.0, -4.0], p0=[0.4], lower=[0.05], upper=[0.6],
        x_max=[8.0, 8.0], u_max=[10.0], dt=900.0, real=real,
    )  # fmt: skip
