"""Least squares over a window of samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from mpc.budgets import ASIDE, USUAL_ITERATIONS
from mpc.checks import Array
from mpc.optimal_control.derivatives import Derivatives
from mpc.optimal_control.estimation.experiment import whitened
from mpc.optimal_control.functions import symbols_of
from mpc.optimal_control.ipopt import Settings, once
from mpc.optimal_control.pieces import kind_of, piece_of
from mpc.optimal_control.program import SizedProgram
from mpc.tolerances import KKT_REPORTED


@dataclass(frozen=True, eq=False)
class NoisyModel:
    """z⁺ = f(z, u, v), y = h(z, u) with unit noise v, and limits."""

    f: ca.Function
    h: ca.Function
    V: Array  # (ny, ny)
    bounds: tuple[Array, Array]  # (lower, upper) of z, each (nz,)
    disturbance: Array  # (nw, nv): w of v
    disturbance_bounds: tuple[Array, Array]
    sizes: Array  # (nz,): about how large z is

    @cached_property
    def linearised(self) -> ca.Function:
        """Function (z, u) → f, ∂f/∂z, ∂f/∂v at v = 0."""
        s = symbols_of(self.f)
        slopes = [ca.vec(ca.densify(ca.jacobian(self.f(*s.values()), s[name]))) for name in "zv"]
        whole = ca.Function("whole", list(s.values()), [self.f(*s.values()), *slopes])
        return ca.Function("linearised", [s["z"], s["u"]], whole.call([s["z"], s["u"], s["v"] * 0]))

    @cached_property
    def seen(self) -> ca.Function:
        """Function (z, u) → h, ∂h/∂z."""
        s = symbols_of(self.h)
        value = self.h(*s.values())
        return ca.Function("seen", list(s.values()), [value, ca.vec(ca.densify(ca.jacobian(value, s["z"])))])

    def told(self, z: Array, u: Array, y: Array) -> bool:
        """Whether outputs (ny,) that are no NaN have values and slopes at a point."""
        known, (h, H) = ~np.isnan(y), (np.asarray(part, dtype=float).ravel() for part in self.seen(z, u))
        return bool(np.isfinite(np.vstack([h, H.reshape(len(z), -1)])[:, known]).all())

    def predicted(self, at: Array, u: Array, mean: Array, P: Array) -> tuple[Array, Array]:
        """Mean (nz,) and covariance one sample later, linearised at a point."""
        f, F, G = (np.asarray(part, dtype=float).ravel() for part in self.linearised(at, u))
        slope, reach = F.reshape(len(at), -1).T, G.reshape(-1, len(at)).T
        with np.errstate(invalid="ignore", over="ignore"):  # of a model that escapes
            after = slope @ P @ slope.T + reach @ reach.T
            return f + slope @ (mean - at), (after + after.T) / 2

    def updated(self, at: Array, u: Array, y: Array, mean: Array, P: Array) -> tuple[Array, Array]:
        """Mean (nz,) and covariance after outputs (ny,) or NaN."""
        h, H = (np.asarray(part, dtype=float).ravel() for part in self.seen(at, u))
        known = ~np.isnan(y)
        slope, V = H.reshape(len(at), -1).T[known], self.V[np.ix_(known, known)]
        with np.errstate(invalid="ignore", over="ignore"):
            S = slope @ P @ slope.T + V
            unit = np.sqrt(np.diag(S))
            alike, told = S / unit / unit[:, None], slope @ P / unit[:, None]
        if not (np.isfinite(alike).all() and np.isfinite(told).all()):
            return np.full_like(mean, np.nan), np.full_like(P, np.nan)
        try:
            gain = (np.linalg.solve(alike, told) / unit[:, None]).T
        except np.linalg.LinAlgError:  # outputs that tell the same of a state that is known badly
            gain = (np.linalg.lstsq(alike, told)[0] / unit[:, None]).T
        with np.errstate(invalid="ignore", over="ignore"):
            rest = np.eye(len(at)) - gain @ slope
            after = rest @ P @ rest.T + gain @ V @ gain.T
            return mean + gain @ (y[known] - h[known] - slope @ (mean - at)), (after + after.T) / 2


@dataclass(frozen=True, eq=False)
class Window:
    """Samples of one run, and what came before them."""

    mean: Array  # (nz,): of z at the first sample, before its outputs
    covariance: Array  # (nz, nz)
    outputs: Array  # (k, ny)
    inputs: Array  # (k, nu): held until each sample
    course: Array  # (k, nz): most likely z
    last: Array  # (nz, nz): covariance of z at the last sample
    foretold: tuple[Array, Array]  # mean and covariance of z at the last sample, before its outputs
    met: Array  # (nz,): z where outputs were met last before that

    def without_the_last(self) -> list[Window]:
        """Windows of the last sample without its outputs, then as outputs were met last."""
        known, none = (self.foretold, (self.met, self.last)), np.full_like(self.outputs[-1:], np.nan)
        return [Window(z, P, none, self.inputs[-1:], z[None], P, self.foretold, self.met) for z, P in known]

    def shortened(self, model: NoisyModel) -> Window:
        """Window without its first sample, which mean and covariance take in."""
        first = model.updated(self.course[0], self.inputs[0], self.outputs[0], self.mean, self.covariance)
        mean, P = model.predicted(self.course[0], self.inputs[1], *first)
        return replace(self, mean=mean, covariance=P, outputs=self.outputs[1:], inputs=self.inputs[1:],
                       course=self.course[1:])  # fmt: skip

    def filtered(self, model: NoisyModel) -> tuple[Array, Array]:
        """Mean and covariance at the last sample by the extended Kalman filter."""
        at, known = self.course, (self.mean, self.covariance)
        for k in range(len(at)):
            known = known if k == 0 else model.predicted(at[k - 1], self.inputs[k], *known)
            known = model.updated(at[k], self.inputs[k], self.outputs[k], *known)
        return known


class WindowProgram:
    """Program of a number of samples, whose data are unknowns that are held."""

    def __init__(self, model: NoisyModel, samples: int) -> None:
        self.model = model
        nz, nv = model.f.numel_in(0), model.f.numel_in(2)
        nu, ny, steps = model.f.numel_in(1), model.h.numel_out(0), samples - 1
        sizes = {
            "start": nz, "z": samples * nz, "v": steps * nv, "mean": nz, "spread": nz * nz, "u": samples * nu,
            "y": samples * ny * (1 + ny),
        }  # fmt: skip
        cuts = np.cumsum([0, *sizes.values()])
        self.at = {name: np.arange(a, b) for name, a, b in zip(sizes, cuts[:-1], cuts[1:])}
        widths = {"z": nz, "v": nv, "u": nu, "y": ny * (1 + ny)}
        z, v, u, y = (self.at[name].reshape(sizes[name] // width if width else samples, width).T
                      for name, width in widths.items())  # fmt: skip
        low, high = model.disturbance_bounds
        kept = np.isfinite(low) | np.isfinite(high)
        kind, reach = kind_of(model.f), ca.DM(model.disturbance[kept])

        def arrival(z: Any, start: Any, mean: Any, spread: Any, data: Any) -> list[Any]:
            return [ca.sumsqr(start) / 2, z - mean - ca.mtimes(ca.reshape(spread, nz, nz), start)]

        def step(z: Any, after: Any, v: Any, u: Any, data: Any) -> list[Any]:
            return [ca.sumsqr(v) / 2, model.f(z, u, v) - after, ca.mtimes(reach, v)]

        def sample(z: Any, u: Any, y: Any, data: Any) -> list[Any]:
            missed = ca.mtimes(ca.reshape(y[ny:], ny, ny), model.h(z, u) - y[:ny])
            return [ca.sumsqr(missed) / 2]

        first = {"z": z[:, :1], "start": self.at["start"][:, None], "mean": self.at["mean"][:, None],
                 "spread": self.at["spread"][:, None]}  # fmt: skip
        width = nz + int(kept.sum())
        rows = (1 + nz + np.arange(steps * width)).reshape(steps, width).T
        pieces = [
            piece_of(arrival, kind, first, np.arange(1 + nz)[:, None]),
            piece_of(sample, kind_of(model.h), {"z": z, "u": u, "y": y}, np.zeros((1, samples), dtype=int)),
        ]
        if steps:
            places = {"z": z[:, :-1], "after": z[:, 1:], "v": v, "u": u[:, 1:]}
            pieces.append(piece_of(step, kind, places, np.vstack([np.zeros((1, steps), dtype=int), rows])))
        count, equations = int(cuts[-1]), int(nz + rows.size)
        size = np.ones(count)
        size[self.at["z"]] = np.tile(model.sizes, samples)
        least, most = (
            np.concatenate([np.zeros(nz), np.tile(np.concatenate([np.zeros(nz), side[kept]]), steps)])
            for side in (low, high)
        )
        row_size = np.concatenate([model.sizes, np.tile(np.concatenate([model.sizes, np.ones(kept.sum())]), steps)])
        free, derivatives = np.full(count, np.inf), Derivatives(pieces, count, equations)
        origins = np.zeros(count), np.zeros(equations)
        self.program = SizedProgram(-free, free, size, origins[0], least, most, row_size, origins[1], derivatives)

    def solved(self, window: Window, tolerance: float) -> tuple[Array, bool]:
        """Most likely course (k, nz), and whether it was confirmed to be an optimum."""
        at, model = self.at, self.model
        deviation = np.sqrt(np.maximum(np.diag(window.covariance), 0.0))
        unit = np.where(deviation > 0, deviation, 1.0)
        share, turn = np.linalg.eigh(window.covariance / unit / unit[:, None])
        spread = unit[:, None] * turn * np.sqrt(np.maximum(share, 0.0))
        held = {"mean": window.mean, "spread": spread.T, "u": window.inputs,
                "y": whitened(window.outputs, model.V)}  # fmt: skip
        low, high, guess = self.program.lower.copy(), self.program.upper.copy(), np.zeros(len(self.program.lower))
        for name, value in held.items():
            low[at[name]] = high[at[name]] = np.ravel(value)
        for side, bound in zip((low, high), model.bounds):
            side[at["z"]] = np.tile(bound, len(window.outputs))
        aside = np.random.default_rng(0).uniform(-ASIDE, ASIDE, window.course.shape)
        guess[at["z"]] = (window.course + aside * model.sizes).ravel()
        guess = np.clip(guess, low, high)
        settings = Settings(tolerance, USUAL_ITERATIONS, np.inf, {})
        found = once(replace(self.program, lower=low, upper=high), guess, None, settings)
        good = found.ended and found.residuals.worst <= KKT_REPORTED
        return found.v[at["z"]].reshape(window.course.shape), bool(good)
