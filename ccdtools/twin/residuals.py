"""One-step errors of a nominal model along a log."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

from ccdtools.arrays import Array, ArrayField, Immutable, Indices, frozen
from ccdtools.exceptions import InputError, LimitWarning
from ccdtools.plants.models import Model, as_model
from ccdtools.trajectory import Trajectory
from ccdtools.twin.stuck_sensors import warn_of_leaps, warn_of_stuck
from ccdtools_ground.door import as_finite, as_instance, shown

if TYPE_CHECKING:
    from ccdtools.co_design.problem import CoDesignProblem
    from invariant_sets import Polytope


@dataclass(frozen=True, eq=False, repr=False)
class Residuals(Immutable):
    """One-step errors along logged runs, finite and read-only.

    Attributes
    ----------
    e, x, u : (n, T, ·) arrays
        Error before the step (e₀ = 0), measured state and applied input.
    p : (np,) array
        Design of the log.
    e_next : (n, T, nx) array
        e⁺ = x⁺ − f(x, u, 0, p), at the measured state; f is A(p) x + B(p) u + c(p) of a linear model.
    numbers : (n,) int array
        Of the runs in their deployment, where some that diverged have been left out; 0, 1, … by default.
    left_out : int
        How many runs of the deployment diverged.
    """

    e: Array
    x: Array
    u: Array
    p: Array
    e_next: Array
    numbers: ArrayField = None
    left_out: int = 0

    def __post_init__(self) -> None:
        for name in ("e", "x", "u", "p", "e_next"):
            value = getattr(self, name)
            object.__setattr__(self, name, frozen(as_finite(name, value)))
        numbers = np.arange(self.runs) if self.numbers is None else np.asarray(self.numbers)
        if numbers.shape != (self.runs,):
            raise InputError("numbers", f"shape {numbers.shape}", f"({self.runs},), one per run")
        object.__setattr__(self, "numbers", frozen(numbers))

    def __repr__(self) -> str:
        return f"Residuals({self.runs} runs of {self.steps} steps, {self.x.shape[2]} states)"

    @property
    def runs(self) -> int:
        """Number of runs n."""
        return int(self.x.shape[0])

    @property
    def steps(self) -> int:
        """Length T of a run."""
        return int(self.x.shape[1])

    def part(self, runs: slice | NDArray[np.bool_], steps: slice) -> Residuals:
        """Stretch of all or some runs of the log."""
        columns = {name: getattr(self, name)[runs, steps] for name in ("e", "x", "u", "e_next")}
        return replace(self, **columns, numbers=self.numbers[runs])

    def carried(self, T: Array) -> Residuals:
        """Log with its errors carried to another design by T (nx, nx)."""
        return replace(self, e=self.e @ T.T, e_next=self.e_next @ T.T)

    def columns(self) -> tuple[Array, Array, Array, Array, Array]:
        """Columns e, x, u, p and e⁺ (n T, ·) of all samples."""
        p = np.broadcast_to(self.p, (*self.x.shape[:2], len(self.p)))
        e, x, u, p, e_next = (
            c.reshape(self.runs * self.steps, c.shape[-1]) for c in (self.e, self.x, self.u, p, self.e_next)
        )
        return e, x, u, p, e_next


def residuals(model: Model, log: Trajectory, *, met: bool = False, argument: str = "log") -> Residuals:
    """One-step errors of `model` along the undiverged runs of `log`.

    Those of f(x, u, w, p) if it has `met` the disturbance of the log, too. Every function that takes logs of states
    sees them as these errors, so what is wrong with a log is told here: a sensor that is
    stuck or leaps by a warning.

    Raises
    ------
    InputError
        If every run diverged, others have gaps, or the log is not of such a plant, or of a design outside the
        model's box.
    """
    model = as_model("model", model)
    as_instance(argument, log, Trajectory, "a Trajectory, from deploy or simulate")
    nx, nu = log.states.shape[2], log.inputs.shape[2]
    if (nx, nu) != (model.nx, model.nu):
        raise InputError(argument, f"{nx} states and {nu} inputs", f"{model.nx} and {model.nu} of the model")
    if not np.isclose(log.dt, model.dt):
        raise InputError(argument, f"dt = {log.dt:g} s", f"dt = {model.dt:g} s of the model")
    if model.design is not None:
        model.design.check_one(log.design, argument=f"{argument}.design")
    kept = ~log.diverged
    if not kept.any():
        raise InputError(argument, f"{len(kept)} runs that all diverged", "at least one that did not")
    x = as_finite(f"{argument}.states", log.states[kept])
    u = as_finite(f"{argument}.inputs", log.inputs[kept])
    w = log.disturbances[kept] if met else np.zeros((*u.shape[:2], model.nw))
    if w.shape[2] != model.nw:
        raise InputError(argument, f"{w.shape[2]} disturbances", f"{model.nw} of the model")
    step = model.stepper(log.design, batch=1)
    foretold = np.asarray(step(x[:, :-1], u, w))
    e_next = x[:, 1:] - foretold
    e = np.concatenate([np.zeros_like(e_next[:, :1]), e_next[:, :-1]], axis=1)
    names = log.names[:nx] or [f"x{j + 1}" for j in range(nx)]
    warn_of_stuck(argument, x[:, :-1], u, names, lambda: median_abs_deviation(e_next, axis=(0, 1), scale="normal"))
    p, lost = np.asarray(log.design, dtype=float), int(log.diverged.sum())
    found = Residuals(e, x[:, :-1], u, p, e_next, np.flatnonzero(kept), lost)
    warn_of_leaps(argument, found.x, e_next, lambda: x[:, 2:] - step(foretold[:, :-1], u[:, 1:], w[:, 1:]), names)
    return found


Logs: TypeAlias = Trajectory | Residuals | Sequence[Trajectory | Residuals]


def errors_of(logs: Logs, model: Model | None, argument: str = "logs") -> list[Residuals]:
    """Errors along one log or several."""
    given: list[Any] = list(logs) if isinstance(logs, list | tuple) else [logs]
    if not given:
        raise InputError(argument, shown(logs), "at least one log, a Trajectory or Residuals")
    if model is None:
        kinds = "Residuals; with `model=` a Trajectory, too"
        return [as_instance(f"{argument}[{i}]", one, Residuals, kinds) for i, one in enumerate(given)]
    return [_errors(f"{argument}[{i}]", one, model) for i, one in enumerate(given)]


def _errors(argument: str, log: Trajectory | Residuals, model: Model) -> Residuals:
    """Errors of a log of the model."""
    if isinstance(log, Trajectory):
        return residuals(model, log, argument=argument)
    as_instance(argument, log, Residuals, "a Trajectory, or Residuals")
    sizes = (log.x.shape[2], log.e_next.shape[2], log.u.shape[2])
    if sizes != (model.nx, model.nx, model.nu):
        got = f"{sizes[0]} states with {sizes[1]} errors and {sizes[2]} inputs"
        raise InputError(argument, got, f"{model.nx} states with as many errors and {model.nu} inputs of the model")
    if model.design is not None:
        model.design.check_one(log.p, argument=f"{argument}.p")
    return log


def errors_in(problem: CoDesignProblem, logs: Logs) -> list[Residuals]:
    """Errors along logs; states mostly outside X, or inputs outside U, are warned of."""
    errors = errors_of(logs, problem.model)
    for log in errors:
        warn_of_outside("states", "X", problem.state_limits(log.p), log.x)
        warn_of_outside("inputs", "U", problem.input_limits(log.p), log.u)
    return errors


def warn_of_outside(name: str, limit: str, limits: Polytope, column: Array) -> None:
    """Warn if most of a log lies outside a limit of the problem, beyond what few digits leave out."""
    inside = limits.contains(column.reshape(-1, limits.dim), 1e-3).mean()
    if inside < 0.5:
        warnings.warn(
            f"{1 - inside:.0%} of the logged {name} lie outside {limit}. A log has the units and coordinates of the "
            "problem: where that is about a rest, deviations from it.",
            LimitWarning, stacklevel=4,
        )  # fmt: skip


def of_linearisation(model: Model, errors: Residuals) -> Residuals:
    """Errors of the model's linearisation at rest, x⁺ − Ax − Bu."""
    A, B, _ = model.matrices(errors.p)
    after = model.undisturbed(errors.p)(errors.x, errors.u) + errors.e_next
    return replace(errors, e_next=after - errors.x @ A.T - errors.u @ B.T)


def block_parts(log: Residuals, held_out: float, blocks: int, *, last: bool) -> list[Residuals]:
    """First or held-out last part of every block, see `block_spans`."""
    return [log.part(runs, steps) for runs, steps in block_spans(log, held_out, blocks, last=last)]


def block_spans(log: Residuals, held_out: float, blocks: int, *, last: bool) -> list[tuple[slice, slice]]:
    """Runs and steps of each block's first or held-out last part, if not empty.

    A single long run is cut into blocks; several runs, one after the other, are one block of whole runs.
    """
    if log.runs > 1:
        cut = log.runs - max(1, round(held_out * log.runs))
        kept = slice(cut, log.runs) if last else slice(0, cut)
        return [(kept, slice(0, log.steps))] if kept.start < kept.stop else []
    edges = np.linspace(0, log.steps, blocks + 1).round().astype(int)
    cuts = edges[1:] - np.round(held_out * np.diff(edges)).astype(int)
    spans = zip(cuts, edges[1:]) if last else zip(edges[:-1], cuts)
    return [(slice(0, 1), slice(int(a), int(b))) for a, b in spans if a < b]


def stacked(parts: Sequence[Residuals]) -> list[Array]:
    """Columns e, x, u, p and e⁺ of all parts."""
    return [np.concatenate(column) for column in zip(*(part.columns() for part in parts))]


def is_common(numbers: Indices) -> NDArray[np.bool_]:
    """Whether runs of these numbers meet the same disturbance in every deployment: every second one, from the first."""
    common: NDArray[np.bool_] = numbers % 2 == 0
    return common


def groups(logs: Sequence[Residuals]) -> Indices:
    """Group of every run: its number if all logs share its disturbance, else a unique one."""
    several = 1 + max(int(log.numbers.max()) for log in logs)
    own = [(k + 1) * several + log.numbers for k, log in enumerate(logs)]
    return np.concatenate([np.where(is_common(log.numbers), log.numbers, alone) for log, alone in zip(logs, own)])
