"""Parameters and first states of differential equations from measurements."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import as_choice, as_weight
from mpc.budgets import ASIDE, GUESSED_STEPS
from mpc.checks import Array, as_array, as_count, as_floats, as_seconds
from mpc.exceptions import InputError
from mpc.optimal_control.bounds import INF, Bounds, as_bounds, as_end, as_names, check_within, middle
from mpc.optimal_control.estimation.experiment import Experiment, as_experiments, whitened
from mpc.optimal_control.estimation.most_likely import most_likely
from mpc.optimal_control.estimation.parameter_estimate import EstimationStatus, ParameterEstimate, estimate_of
from mpc.optimal_control.functions import Statement, compiled, symbols_of
from mpc.optimal_control.phase import Phase, interpolated
from mpc.optimal_control.planning import Clock
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.refinement import refine
from mpc.optimal_control.solving import solve
from mpc.tolerances import NEGLIGIBLE, SUPPOSED_NOISE


def estimate_parameters(
    experiments: Experiment | Sequence[Experiment], dynamics: Statement, output: Statement, *, states: int,
    p_bounds: Bounds, p_guess: ArrayLike | None = None, noise: ArrayLike | None = None,
    disturbance: ArrayLike | None = None, x_bounds: Bounds = (-INF, INF), p_names: Sequence[str] = (),
    state_names: Sequence[str] = (), **options: Any,
) -> ParameterEstimate:  # fmt: skip
    """Most likely parameters and first states, from measurements.

    Of dx/dt = f(x, u, w, p, t), y = h(x, u, p, t) + noise.
    Least squares by direct collocation, trajectories and parameters in one program, on a mesh that is refined. Beside a
    disturbance parameters maximise the likelihood over all its courses, by Laplace's approximation.

    Parameters
    ----------
    experiments : Experiment or list of Experiment
        They share p; each has a start of its own.
    dynamics : function of x, u, w, p, t
        dx/dt (nx, 1), in CasADi; its arguments are named after what it needs. u are the inputs of the experiments.
    output : function of x, u, p, t
        y (ny, 1).
    states : int
        nx.
    p_bounds : (lower, upper)
        Each (np,), None or infinite where there is none.
    p_guess : (np,) array, optional
        Where to start from, and the size of parameters that turn out to be 0; about the middle of bounds by default.
    noise : (ny, ny) or (ny,) array, optional
        Covariance of the noise of one row of outputs, or its variances. By default all outputs have the same variance,
        which is estimated: supposed to be a hundredth of their deviation, squared, all together, or what that leaves
        where a combination is open. Give the noise where outputs differ by more than thousands.
    disturbance : (nw, nw) or (nw,) array, optional
        Spectral density of white noise w [its unit² s]. A first state that is free counts as unknown beside it, each
        value as likely before.
    x_bounds : (lower, upper), optional
    p_names, state_names : sequence of str, optional
    **options
        For `refine`: `tolerance`, `time_limit`, …

    Returns
    -------
    ParameterEstimate
        Never SOLVED without the solver's own flag and the check of its optimum, by second derivatives, too, nor where
        the data leave a combination open.

    Raises
    ------
    InputError
        If functions or sizes cannot be meant, a guess is beyond its bounds, or more is unknown than was measured.

    References
    ----------
    Bock, "Randwertproblemmethoden zur Parameteridentifizierung in Systemen nichtlinearer Differentialgleichungen",
    Bonner Mathematische Schriften 183, 1987; Biegler, *Nonlinear Programming*, SIAM 2010, chapter 10; Kristensen et
    al., "TMB: automatic differentiation and Laplace approximation", Journal of Statistical Software 70, 2016.
    """
    clock = Clock(as_seconds("time_limit", options.get("time_limit")))
    known = [name for one in (estimate_parameters, solve, refine) for name in list(signature(one).parameters)[1:]]
    for name in options:
        as_choice("options", name, known)
    given = as_experiments(experiments)
    states = as_count("states", states)
    bounds = as_bounds("p_bounds", p_bounds, None)
    one = given[0]
    nu, ny = one.inputs_seen.shape[1], one.outputs.shape[1]
    if disturbance is not None and noise is None:
        raise InputError("noise", "nothing", "the noise of the outputs, which a disturbance is weighed against")
    density = np.zeros((0, 0)) if disturbance is None else as_covariance("disturbance", disturbance, None)
    sizes = {"x": states, "u": nu, "w": len(density), "p": len(bounds[0]), "t": 1}
    f = moved_by_noise("dynamics", compiled("dynamics", dynamics, sizes, states))
    h = compiled("output", output, {name: sizes[name] for name in "xupt"}, ny)
    s = symbols_of(h)
    y = type(s["x"]).sym("y", ny * (1 + ny))  # rows of `whitened`
    value = ca.densify(ca.mtimes(ca.reshape(y[ny:], ny, ny), h(*s.values()) - y[:ny]))
    residual = ca.Function("residual", [*s.values(), y], [value], ["x", "w", "p", "t", "y"], ["value"])
    low, high = bounds
    if p_guess is not None:
        check_within("p_guess", as_array("p_guess", p_guess, low.shape), "p_bounds", bounds)
    size = np.clip(np.nan_to_num(middle(low, high)) if p_guess is None else as_array("p_guess", p_guess, low.shape),
                   low, high)  # fmt: skip
    aside = np.random.default_rng(0).uniform(-ASIDE, ASIDE, len(low)) * np.where(np.isfinite(high - low), high - low, 0)
    guess = size + aside if p_guess is None else size

    def fitted(covariance: Array, unit: float | None) -> ParameterEstimate:
        """Estimate at a covariance of the noise."""
        phases = [
            _phase(one, f, residual, density, (as_bounds("x_bounds", x_bounds, states), guess), covariance,
                   as_names("state_names", state_names, "x", states))
            for one in given
        ]  # fmt: skip
        problem = OptimalControlProblem(
            phases, p_bounds=bounds, p_guess=guess, linked=False, weights=np.ones(len(phases)), p_names=p_names
        )
        measured = _checked_count(problem, given, 0 if unit is None else 1)
        solution, known = most_likely(problem, residual, size, options, clock, None if unit is None else measured)
        return estimate_of(solution, given, h, known, unit)

    if noise is not None:
        return fitted(as_covariance("noise", noise, ny), None)
    unit = SUPPOSED_NOISE * _spread(given)
    found = fitted(unit**2 * np.eye(ny), unit)
    left = found.residual_variance
    if found.status is not EstimationStatus.OPEN or not 0 < left < unit**2 or clock.late:
        return found
    again = fitted(left * np.eye(ny), float(np.sqrt(left)))
    return again if again.solved else found


def _spread(given: Sequence[Experiment]) -> float:
    """Deviation of the outputs from their means."""
    every = np.vstack([one.outputs for one in given])
    outputs = [column[~np.isnan(column)] for column in every.T]
    shifted = [column - column[0] if len(column) else column for column in outputs]  # an offset does not round them
    about = [column - column.mean() if len(column) else column for column in shifted]
    spread, size = (float(np.linalg.norm(np.concatenate(one))) for one in (about, outputs))
    chosen = spread if spread > NEGLIGIBLE**2 * size else size or 1.0
    return chosen / float(np.sqrt(sum(map(len, outputs))))


def as_covariance(name: str, value: ArrayLike, size: int | None, *, singular: bool = False) -> Array:
    """Covariance (size, size), checked, also from variances (size,)."""
    given = np.atleast_1d(as_floats(name, value))
    if given.ndim == 1 and (given < 0).any():
        raise InputError(name, given, f"variances {'≥' if singular else '>'} 0")
    full = as_weight(name, np.diag(given) if given.ndim == 1 else given, size)
    if singular:
        return full
    deviation = np.sqrt(np.diag(full))
    if not (deviation > 0).all() or np.linalg.eigvalsh(full / deviation / deviation[:, None])[0] < NEGLIGIBLE**2:
        raise InputError(name, "a singular matrix", "a positive definite one", "Give what is exact a small variance.")
    return full


def moved_by_noise(name: str, function: ca.Function) -> ca.Function:
    """Function, if it depends on every w that has a covariance."""
    s = symbols_of(function)
    idle = [i for i in range(s["w"].numel()) if not ca.depends_on(function(*s.values()), s["w"][i])]
    if idle:
        got = f"a function that does not depend on {', '.join(f'w[{i}]' for i in idle)}"
        raise InputError(name, got, "one that does, as w has a covariance", "Name an argument w, and add it.")
    return function


def _phase(one: Experiment, f: ca.Function, residual: ca.Function, density: Array, limits: tuple[Any, ...],
           covariance: Array, names: tuple[str, ...]) -> Phase:  # fmt: skip
    """Phase of an experiment: disturbance as input, inputs as signal."""
    s, r = symbols_of(f), symbols_of(residual)
    unit = type(s["x"]).sym("unit", len(density))
    rates = f(s["x"], s["u"], ca.mtimes(ca.DM(np.linalg.cholesky(density)), unit), s["p"], s["t"])
    rate = ca.Function("dynamics", [s["x"], unit, s["u"], s["p"], s["t"]], [rates], [*"xuwpt"], ["value"])
    cost = ca.Function("cost", list(r.values()), [ca.sumsqr(residual(*r.values())) / 2], list(r), ["value"])
    times, samples = one.times, whitened(one.outputs, covariance)
    x_bounds, p = limits
    start = as_end("start", one.start, x_bounds)
    if one.guess is not None and one.guess.shape[1] != len(names):
        raise InputError("guess", f"shape {one.guess.shape}", f"({len(times)}, {len(names)})")
    x = _states_seen(one, residual, samples, p, start, x_bounds) if one.guess is None else one.guess
    return Phase(
        dynamics=rate, states=len(names), inputs=len(density), start=start, duration=one.duration,
        start_time=float(times[0]), x_bounds=x_bounds, signal=one.signal, state_names=names,
        stage_cost=(lambda u: ca.sumsqr(u) / 2) if len(density) else None,
        samples=(np.minimum(times - times[0], one.duration), samples), sample_cost=cost,
        guess=((times - times[0]) / one.duration, x, np.zeros((len(times), len(density)))),
    )  # fmt: skip


def _states_seen(one: Experiment, residual: ca.Function, samples: Array, p: Array, start: tuple[Array, Array],
                 bounds: tuple[Array, Array]) -> Array:  # fmt: skip
    """States (n, nx) nearest to the start that explain the outputs."""
    s = symbols_of(residual)
    value = residual(*s.values())
    both = ca.Function("both", list(s.values()), [value, ca.vec(ca.jacobian(value, s["x"]))])
    times, near = one.times, np.nan_to_num(middle(*start))
    w = one.inputs_seen
    x = np.tile(np.clip(near, *bounds), (len(times), 1))
    for _ in range(GUESSED_STEPS):
        r, H = (np.asarray(part, dtype=float).T for part in both(x.T, w.T, p, times[None], samples.T))
        if not (np.isfinite(r).all() and np.isfinite(H).all()):
            break
        slopes = H.reshape(len(x), x.shape[1], -1).transpose(0, 2, 1)
        x = np.clip(x - (np.linalg.pinv(slopes, rcond=NEGLIGIBLE) @ r[:, :, None])[:, :, 0], *bounds)
    seen = one.measured.any(axis=1)
    return interpolated(times, times[seen], x[seen])


def _checked_count(problem: OptimalControlProblem, given: Sequence[Experiment], of_noise: int) -> int:
    """Number of measured values, if no more is unknown."""
    low, high = problem.p_bounds
    p = int((low < high).sum())
    starts = sum(int((phase.start[0] < phase.start[1]).sum()) for phase in problem.phases)
    values = sum(int(one.measured.sum()) for one in given)
    if p + starts + of_noise > values:
        cure = "Measure more, give `noise`, or give parameters or starts: equal bounds hold them."
        got = f"{p} parameters, {starts} first states{' and the noise' * of_noise} from {values} measured values"
        raise InputError("experiments", got, "at least as many values as unknowns", cure)
    return values
