"""Three generations by fits, beside what knowing the real plant is worth: ``python -m gallery.fitted``.

From the folder ``benchmarks``. Studies of the gallery whose truth is worth at least 2 %, and a slide with dry friction,
a slope and a weak actuator, each stated with what is unknown of it. The package makes the designs and the laws;
everything is driven by `gallery.oracle`, which shares no code with it. The truth is the best clipped affine feedback
and design that are found on the real plant itself. Honest baselines are fitted here to the logs that the generations
had: least squares of x⁺ on (x, u, 1) about the model, and LQR of it with its offset, or with an offset that is
estimated while it runs, as an offset-free MPC has it where no limit binds.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import solve_discrete_are

from ccdtools import DesignSpace, Gaussian, Nested, Plant, QuadraticObjective, RealPlant, Study
from ccdtools.co_design.methods.learned import Learned
from ccdtools.statistics import paired_difference
from ccdtools.studies import fitted_generations, load_study
from gallery.oracle.cost import real_step, simulated
from gallery.oracle.statement import Array, Statement
from gallery.oracle.truth import affine, best_feedback
from gallery.reference import reference, statement
from invariant_sets import Polytope

STUDIES = Path(__file__).resolve().parent / "studies"
RUNS = 4000  # fresh ones that everything is driven on
SUBSTEPS = 3
FILTERS = (0.02, 0.05, 0.1, 0.3)  # of the estimated offset; the best one on the real plant counts


@dataclass(frozen=True)
class Case:
    """A study, its plant with what is unknown, and its statement in plain numbers."""

    name: str
    study: Study
    wide: Plant
    statement: Statement
    best: Array  # design of the model's optimum


def unknown(plant: Plant, names: Sequence[str], lower: Any, upper: Any, rates: Callable[..., ca.SX]) -> Plant:
    """Plant with unknown entries q in its design, and dx/dt by `rates` of plant and q."""
    q, space = ca.SX.sym("q", len(names)), plant.design
    box = DesignSpace((*space.names, *names), np.r_[space.lower, lower], np.r_[space.upper, upper])
    return replace(plant, p=ca.vertcat(plant.p, q), dynamics=rates(plant, q), design=box)


def driven_by(plant: Plant, u: ca.SX) -> ca.SX:
    """dx/dt under another input."""
    return ca.substitute(plant.dynamics, plant.u, u)


def _pendulum(plant: Plant, q: ca.SX) -> ca.SX:
    return driven_by(plant, q[0] * plant.u - q[1] * plant.x[1])


def _platform(plant: Plant, q: ca.SX) -> ca.SX:
    rear, stiffness = ca.vertsplit(plant.p)
    stretch = plant.x[0] + ca.vertcat(0.4, -rear) * plant.x[1]  # of the struts
    return driven_by(plant, q[:2] * plant.u - q[2] * stiffness * stretch**3)


def _quarter_car(plant: Plant, q: ca.SX) -> ca.SX:
    (spring, damper, _), stretch, rate = ca.vertsplit(plant.p), plant.x[2], plant.x[3] - plant.x[1]
    return driven_by(plant, plant.u - q[0] * spring * stretch**3 - q[1] * damper * ca.fabs(rate))


WIDE: dict[str, tuple[Sequence[str], Any, Any, Any]] = {
    "heated_room": (["heater"], [0.3], [1.7], lambda plant, q: driven_by(plant, q * plant.u)),
    "pendulum": (["motor", "friction"], [0.4, -0.1], [1.6, 0.6], _pendulum),
    "two_unstable_modes": (
        ["strength", "bias"], [0.5, -0.5], [1.5, 0.5], lambda plant, q: driven_by(plant, q[0] * plant.u + q[1])
    ),
    "platform": (["front", "rear", "hardening"], [0.3, 0.3, -20.0], [1.7, 1.7, 60.0], _platform),
    "quarter_car": (["hardening", "asymmetry"], [-60.0, -1.0], [140.0, 1.0], _quarter_car),
}  # fmt: skip
GRAVITY, DRAG, DRY, SLOPE, WEAK = 9.81, 0.5, 0.04, 0.05, 0.7  # of the slide


def slide() -> Case:
    """A carriage whose mass is designed; really with dry friction, on a slope, its actuator weak."""

    def plant(real: bool) -> Plant:
        x, u, w, m = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("m")
        force = u + w - DRAG * x[1]
        if real:
            force = WEAK * u + w - DRAG * x[1] - m * GRAVITY * (DRY * ca.tanh(x[1] / 0.02) + SLOPE)
        return Plant(x, u, w, m, ca.vertcat(x[1], force / m), DesignSpace(["m"], [0.5], [4.0], ["kg"]), dt=0.05)

    def matrices(p: Array) -> tuple[Array, Array, Array]:
        return np.array([[0, 1], [0, -DRAG / p[0]]]), np.array([[0], [1 / p[0]]]), np.array([[0], [1 / p[0]]])

    def rates(x: Array, u: Array, w: Array, p: Array) -> Array:
        resisted = p[0] * GRAVITY * (DRY * np.tanh(x[:, 1] / 0.02) + SLOPE)
        return np.stack([x[:, 1], (WEAK * u[:, 0] + w[:, 0] - DRAG * x[:, 1] - resisted) / p[0]], axis=1)

    Q, R, std, start = [20.0, 1.0], [0.05], [1.5], [0.3, 0.0]
    s = Statement(matrices, Q=Q, R=R, std=std, x0=start, p0=[2.0], lower=[0.5], upper=[4.0], x_max=[1.0, 3.0],
                  u_max=[20.0], dt=0.05, real=rates)  # fmt: skip
    noise = Gaussian(std=std)
    study = Study(
        name="slide", title="Slide", plant=plant(False), X=Polytope.from_bounds([-1.0, -3.0], [1.0, 3.0]),
        U=Polytope.from_bounds([-20.0], [20.0]), objective=QuadraticObjective(Q=np.diag(Q), R=np.diag(R)),
        disturbance=noise, x0=start, p0=[2.0], real=RealPlant(plant(True), noise, x0=start, runs=200, steps=100),
    )  # fmt: skip
    names, lower, upper = ["actuator", "drag", "slope"], [0.3, -2.0, -0.2], [1.5, 4.0, 0.2]
    wide = unknown(study.plant, names, lower, upper, lambda own, q: driven_by(
        own, q[0] * own.u - q[1] * own.x[1] - own.p[0] * GRAVITY * q[2]
    ))  # fmt: skip
    return Case("slide", study, wide, s, np.array([2.0]))


def case(name: str) -> Case:
    """The case of a name."""
    if name == "slide":
        return slide()
    study = load_study(STUDIES / f"{name}.py")
    own, designs = statement(name), reference(name)["designs"]
    return Case(name, study, unknown(study.plant, *WIDE[name]), own, np.array(designs[0]))


Law = Callable[[Array], Array]


def knowing(case: Case, rounds: int = 2) -> tuple[Array, Law]:
    """Design and law that know the real plant, found again from where they ended."""
    s, w, best = case.statement, case.statement.disturbance(200, 11), None
    p = case.best
    for _ in range(rounds):
        _, p, z = best_feedback(s, p, w)
        K, offset = affine(s, p, z)
        law = partial(lambda x, K, offset: offset - x @ K.T, K=K, offset=offset)
        found = simulated(s, real_step(s, p, SUBSTEPS), law, w)[0].mean()
        if best is None or found > best[0]:
            best = found, p, law
    assert best is not None
    return best[1:]


def returns(s: Statement, p: Array, law: Law, w: Array) -> Array:
    """Returns (n,) on the real plant."""
    return simulated(s, real_step(s, np.asarray(p), SUBSTEPS), law, w)[0]


class OffsetLaw:
    """u = −K x + k(c), of x⁺ = A x + B u + c; with `share` > 0 c goes on to follow what the last steps told."""

    def __init__(self, s: Statement, A: Array, B: Array, c: Array, share: float) -> None:
        Q, R = np.diag(s.Q), np.diag(s.R)
        P = solve_discrete_are(A, B, Q, R)
        inner = np.linalg.solve(R + B.T @ P @ B, B.T)
        closed = A - B @ (inner @ P @ A)
        ahead = P + np.linalg.solve(np.eye(len(A)) - closed.T, closed.T @ P)  # P c + q
        self.K, self.of_offset, self.most = inner @ P @ A, inner @ ahead, s.u_max
        self.A, self.B, self.c, self.share = A, B, c, share
        self.last: tuple[Array, Array] | None = None

    def __call__(self, x: Array) -> Array:
        """Inputs (n, nu)."""
        if self.last is not None and self.share:
            before, u = self.last
            self.c = self.c + self.share * (x - before @ self.A.T - u @ self.B.T - self.c)
        u = np.clip(-x @ self.K.T - self.c @ self.of_offset.T, -self.most, self.most)
        self.last = x, u
        return u


def baselines(case: Case, designs: Sequence[Array], logs: Sequence[Any], w: Array) -> Iterator[tuple[str, Array]]:
    """Names and returns of regulators that have the same logs, at each of these designs."""
    s, nx = case.statement, len(case.statement.x0)
    rows, errors = [], []
    for log in logs:
        A, B, _ = s.sampled(log.design)
        kept = log.states[~log.diverged]
        x, after, u = kept[:, :-1].reshape(-1, nx), kept[:, 1:].reshape(-1, nx), log.inputs[~log.diverged]
        u = u.reshape(len(x), -1)
        rows.append(np.hstack([x / s.x_max, u / s.u_max, np.ones((len(x), 1))]))
        errors.append(after - x @ A.T - u @ B.T)
    told = np.linalg.lstsq(np.vstack(rows), np.vstack(errors), rcond=1e-2)[0].T  # nothing along what was not excited
    told = told / np.r_[s.x_max, s.u_max, 1.0]
    for place, p in zip(("first design", "last design"), designs):
        A, B, _ = s.sampled(p)
        fitted = A + told[:, :nx], B + told[:, nx:-1], told[:, -1]
        for model, known in {"model": (A, B, 0 * told[:, -1]), "least squares": fitted}.items():
            for share in (0.0, *FILTERS):
                try:
                    law = OffsetLaw(s, *known, share)
                except np.linalg.LinAlgError:
                    continue
                kind = f"{model}, offset followed" if share else model
                yield f"{place}, {kind}", returns(s, p, law, w)


def measure(case: Case, method: Any, truth: Array, seed: int, plant: Plant | None) -> tuple[list[str], float]:
    """Cells of a run, and the share of the truth's worth at the end."""
    s, study = case.statement, case.study
    w = s.disturbance(RUNS, 1000 + seed)
    began = time.process_time()
    found = fitted_generations(
        study.problem(), study.real, method=method, generations=3, design=study.p0, plant=plant,
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    took = time.process_time() - began
    own = [returns(s, one.design, one.controller, w) for one in found]
    size, worth = abs(own[0].mean()), (truth - own[0]).mean()
    shares = [(one - own[0]).mean() / worth for one in own[1:]]
    best: dict[str, tuple[str, Array]] = {}
    for name, values in baselines(case, [found[0].design, found[-1].design], [one.log for one in found[:-1]], w):
        place = name.split(",")[0]
        if place not in best or values.mean() > best[place][1].mean():
            best[place] = name, values
    gains = [paired_difference(own[-1], values) for _, values in best.values()]
    told = " → ".join(
        str(np.round(one.design, 4)) if one.accepted else "updated" if one.update else "kept" for one in found
    )
    why = "; ".join(one.fit.status.name if one.predicted is None else "" for one in found[1:] if one.fit is not None)
    cells = [case.name, str(seed), told + (f" ({why})" if why.strip("; ") else ""),
             f"{own[0].mean():.2f}", f"{100 * worth / size:+.2f} %", *(f"{share:.0%}" for share in shares),
             *(f"{100 * g.mean / size:+.2f} [{100 * g.ci95[0] / size:+.2f}, {100 * g.ci95[1] / size:+.2f}] ({name})"
               for g, (name, _) in zip(gains, best.values())), f"{took:.0f}"]  # fmt: skip
    return cells, shares[-1]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row per run, and one per case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=[*WIDE, "slide"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument(
        "--method", default="pathwise", choices=("pathwise", "lqr", "gain"), help="pathwise, or nested with this inside"
    )
    parser.add_argument("--changed", action="store_true", help="nothing is stated: a change where w enters is fitted")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    print("| plant | seed | designs | first return | truth | share, generation 2 | generation 3 | "
          "gain over the best baseline, first design | last design | s |\n|" + "---|" * 10)  # fmt: skip
    lines = []
    for name in given.cases:
        one = case(name)
        p, law = knowing(one)
        shares = []
        for seed in range(given.first, given.first + given.seeds):
            truth = returns(one.statement, p, law, one.statement.disturbance(RUNS, 1000 + seed))
            method = Learned() if given.method == "pathwise" else Nested(given.method)
            cells, share = measure(one, method, truth, seed, None if given.changed else one.wide)
            shares.append(share)
            print(f"| {' | '.join(cells)} |", flush=True)
        good = sum(share >= 0.8 for share in shares)
        lines.append(f"| {name} | {np.round(p, 4)} | {min(shares):.0%} | {np.median(shares):.0%} | "
                     f"{good} of {len(shares)} |")  # fmt: skip
        print(lines[-1], flush=True)
    print("\n| plant | design that knows | share, least | median | at least 80 % |\n|---|---|---|---|---|")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
