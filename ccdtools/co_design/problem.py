"""Co-design problem: model, limits, objective and scenarios."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.co_design.idle_entries import acting_together, check_every_entry_acts
from ccdtools.co_design.objective import Objective, Weights, as_objective
from ccdtools.co_design.problem_checks import (
    bounded_limits,
    check_discrepancy,
    check_inputs,
    check_measurement,
    check_over_designs,
    check_widths,
)
from ccdtools.co_design.risk import MEAN, Risk, WorstCase, as_risk, of_logged_runs
from ccdtools.design_limits import DesignLimits, Limits, limits_at, widest
from ccdtools.disturbances.disturbance import NO_DISTURBANCE, Disturbance, drawn_moments
from ccdtools.exceptions import InputError
from ccdtools.limit_tolerance import as_limit_tolerance
from ccdtools.output_limits import OutputLimits, limits_of
from ccdtools.plants.casadi_arrays import SymbolicFunction
from ccdtools.plants.design_space import NO_DESIGN, DesignSpace
from ccdtools.plants.models import as_regulated_model, check_at_rest
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools.plants.tolerances import ACCURACY
from ccdtools.tolerances import DIVERGENCE
from ccdtools_ground.door import (
    as_count,
    as_finite,
    as_floats,
    as_instance,
    as_names,
    as_positive,
    as_vector,
    has_method,
    shown,
)
from invariant_sets import Polytope


class Scenarios(Protocol):
    """Anything that draws initial states with their disturbances.

    Where runs have a disturbance of any length that does not depend on their starts, it is an attribute `disturbance`.
    """

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and disturbances (runs, steps, nw)."""
        ...


@dataclass(frozen=True, eq=False)
class FixedStart(Immutable):
    """Starts from one state `x0` (nx,), with fresh disturbances; none of a plant without w."""

    x0: ArrayField
    disturbance: Disturbance = NO_DISTURBANCE

    def __post_init__(self) -> None:
        self._set(x0=as_vector("x0", self.x0))
        has_method("disturbance", self.disturbance, "sample", "a disturbance, such as Gaussian([0.1])")

    def sample(self, runs: int, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Initial states (runs, nx) and disturbances (runs, steps, nw)."""
        return np.tile(self.x0, (runs, 1)), self.disturbance.sample(runs, steps, rng)

    def check_within(self, X: Polytope) -> None:
        """Raise an `InputError` if the start lies outside X."""
        if not X.contains(self.x0):
            raise InputError("scenarios.x0", f"{self.x0.tolist()}, which is outside X", "a state within X")

    def check_for(self, problem: CoDesignProblem) -> None:
        """Raise an `InputError` if no design has the start within X(p) and the limits of outputs."""
        self.check_within(widest(problem.X))
        designs = problem.design.spread()
        starts = np.tile(self.x0, (len(designs), 1))
        if isinstance(problem.X, DesignLimits) and not problem.X.contains(starts, designs).any():
            got = f"{self.x0.tolist()}, which is outside X at every design"
            raise InputError("scenarios.x0", got, "a state within X at some design")
        if problem.output_limits is not None:
            broken = problem.output_limits.broken_at(self.x0, problem.model.nu, designs)
            if all(broken):
                got = f"{self.x0.tolist()}, where {broken[0]} whatever the input and the design"
                raise InputError("scenarios.x0", got, "a state within the limits of the outputs")


@dataclass(frozen=True, eq=False, repr=False)
class CoDesignProblem(Immutable):
    """Design task, and the measure that designs and policies are compared by.

    A plant without a design, or whose entries are all fixed, is a task of control alone: `codesign` by a method that
    learns finds its policy, and controllers and environments take the design [].

    Parameters
    ----------
    model : LinearModel, SampledModel, BlackBox or another Simulable
        x⁺ = A(p) x + B(p) u + E(p) w, or any x⁺ = f(x, u, w, p) that rests at x = 0, u = 0, w = 0 at every design. A
        simulator, of which only a step without memory is known, may move there by 1e-6 half-widths of X a sample.
        LQR, MPC and sets are then those of its linearisation there. The slopes of a simulator are differences, with
        steps of a thousandth of X, U and the box of designs, and twice that.
    X, U : Polytope, bounds (lower, upper), or function of p
        State and input limits; both bounded and around 0, U a box. Each bound is a number for all coordinates, or one
        number each. Leaving X is counted, it does not end an episode. A function of the design returns bounds, as
        ``U=lambda p: (-u_max(p), u_max(p))`` does: the actuator that the design has, and the room that it leaves.
    objective : QuadraticObjective or CustomObjective
    scenarios : Scenarios
        Initial states and disturbances of the episodes.
    steps : int
        Length of an episode, `warm_up` included.
    discrepancy : Discrepancy, optional
        What a digital twin has learned; it replaces the model's disturbance.
    limit_tolerance : "mpc", "off" or (fraction, depth)
        How often and how far a co-designed policy may leave X: no more than about what MPC of the same design does on
        the same scenarios; as it likes; or so large a fraction of the states, and so many half-widths of X in the mean
        of the peaks of the runs.
    risk : Mean, MeanSpread, CVaR or WorstCase
        What of the returns is optimised: by default their mean. `WorstCase` asks for scenarios with `Cases`; of a
        problem with a discrepancy, whose runs are logged ones, it is the mean.
    output_limits : OutputLimits, optional
        Limits on outputs h(x, u, p), which count and are enforced as those of X are. A model does not know those of
        its plant: `OutputLimits.of(plant)`.
    warm_up : int
        First steps of an episode whose rewards and states outside X do not count; 0 by default. For episodes that
        begin at a state that the design and policy in question have not come to themselves.
    measurement : Measurement, optional
        What the sensors of the closed loop measure, with their noise: controllers of the state then act on the estimate
        of a Kalman filter at their design, which knows mean and spread of the starts and takes the disturbance of
        `scenarios` for white noise; by default the state is known.
    hidden : int
        So many first states a policy does not see, see `history_problem`.
    divergence : float
        Half-widths of X beyond which a run is lost and ends. It bounds what a lost run costs: about the square of it
        for a quadratic cost. Episodes of `EpisodeEnv` end nearer.

    Raises
    ------
    InputError
        If the dimensions disagree (those of one sample of `scenarios` included), X or U is empty or unbounded, 0 is not
        in X or not in U, at some design if they depend on it, U is not a box or wider than the actions of an
        environment, starts lie outside X at every design or break a limit of an output that no input and no design
        mends, or the box of designs is too narrow. If nothing that is chosen changes the objective, or an entry of the
        design that is not fixed changes nothing, or nothing but how a disturbance of zero enters.
    """

    model: Any  # once the problem is made a Model, or a SimulatedModel
    X: Limits
    U: Limits
    objective: Objective
    scenarios: Scenarios
    steps: int = 100
    discrepancy: Any = None
    limit_tolerance: str | tuple[float, float] = "mpc"
    warm_up: int = 0
    risk: Risk = MEAN
    output_limits: OutputLimits | None = None
    measurement: Any = None
    hidden: int = 0
    divergence: float = DIVERGENCE

    def __post_init__(self) -> None:
        model = self._model()
        self._set(X=bounded_limits("X", self.X, model.nx, "one per state", model.design))
        self._set(U=bounded_limits("U", self.U, model.nu, "one per input", model.design))
        if not widest(self.X).contains(np.zeros(model.nx)):
            raise InputError("X", "a set without the origin", "one that holds the state 0, which is regulated to")
        U = widest(self.U)
        if len(U.minimal().b) != 2 * model.nu or (np.count_nonzero(U.minimal().A, axis=1) != 1).any():
            raise InputError("U", "a set that is not a box", "independent bounds on each input")
        if not U.contains(np.zeros(model.nu)):
            raise InputError("U", "a set without the origin", "one that holds the input 0, which keeps the state at 0")
        sizes = (model.nx, model.nu, model.design.dim)
        as_objective("objective", self.objective).check(*sizes)
        if not self.objective.judges(*sizes):
            raise InputError(
                "objective", "one that costs the same whatever is done", "a cost of states, inputs or the design",
                "Set Q or R, a stage cost that depends on its arguments, or a design_cost.",
            )  # fmt: skip
        self._set(steps=as_count("steps", self.steps))
        self._set(objective=self.objective.over(self.steps))
        self._set(model=self._differenced(model))
        check_inputs(self)
        as_risk("risk", self.risk)
        if isinstance(self.risk, WorstCase):
            risk = self.risk.over(self.scenarios) if self.discrepancy is None else of_logged_runs(self.risk)
            self._set(risk=risk)
        if self.output_limits is not None:
            as_instance("output_limits", self.output_limits, OutputLimits, "OutputLimits(h, lower, upper) or None")
            self.output_limits.check(model.nx, model.nu, model.design.dim)
        check_over_designs(self)
        self._set(warm_up=as_count("warm_up", self.warm_up, least=0))
        if self.warm_up >= self.steps:
            raise InputError("warm_up", self.warm_up, f"less than {self.steps}, the steps of an episode")
        self._set(limit_tolerance=as_limit_tolerance("limit_tolerance", self.limit_tolerance))
        self._set(divergence=as_positive("divergence", self.divergence))
        check_discrepancy(self)
        self._check_scenarios()
        self._set(hidden=as_count("hidden", self.hidden, least=0))
        check_measurement(self)
        check_every_entry_acts(self)

    def _model(self) -> Any:
        """The model, whose designs single precision tells apart."""
        model: Any = as_regulated_model("model", self.model)
        model = model if model.design is not None else model.within(NO_DESIGN)
        check_widths(model.design)
        return model

    def _differenced(self, model: Any) -> Any:
        """Model of a simulator in sizes of the problem; other models as they are."""
        if not isinstance(model, SimulatedModel) or model.extent is not None:
            return model
        w = np.abs(self._drawn()[1]).max(axis=(0, 1), initial=0.0)
        w = w if w.shape == (model.box.nw,) else np.zeros(model.box.nw)  # what is wrong with it is said later
        extent = np.r_[self.state_scale, np.max(np.abs(self.input_bounds), axis=0), w + (w == 0)]
        model = replace(model, extent=extent)
        rest = np.zeros(model.nx), np.zeros(model.nu)
        apart = np.abs(
            np.subtract(*(model.undisturbed(model.design.project(model.design.centre))(*rest) for _ in "12"))
        )
        if (apart > ACCURACY * self.state_scale).any():
            got = f"a simulator whose steps from one state differ by {apart.max():.3g}"
            raise InputError("model", got, "a deterministic one", "What is random enters by w.")
        check_at_rest("model", model, as_names("state_names", (), model.nx, "x"), ACCURACY * self.state_scale)
        return model

    def _drawn(self) -> tuple[Array, Array]:
        """Sample of the scenarios, numbers at least."""
        has_method("scenarios", self.scenarios, "sample", "scenarios, such as FixedStart(x0, disturbance)")
        drawn = self.scenarios.sample(1, self.steps, np.random.default_rng(0))
        if not (isinstance(drawn, tuple) and len(drawn) == 2):
            got = f"{shown(drawn)} from sample(runs, steps, rng)"
            raise InputError("scenarios", got, "initial states and disturbances", "Use FixedStart(x0, disturbance).")
        x0, w = (as_finite(f"scenarios, {what}", as_floats(f"scenarios, {what}", array))
                 for what, array in zip(("initial states", "disturbances"), drawn))  # fmt: skip
        return x0, w

    def _check_scenarios(self) -> None:
        """Raise an `InputError` unless a sample of the scenarios fits."""
        x0, w = (array.shape for array in self._drawn())
        if x0 != (1, self.model.nx):
            raise InputError("scenarios", f"initial states of shape {x0[1:]}", f"({self.model.nx},)")
        if callable(getattr(self.scenarios, "check_for", None)):
            self.scenarios.check_for(self)  # type: ignore[attr-defined]
        replayed = self.discrepancy is not None and self.discrepancy.noise == "replayed"
        width = self.model.nx if replayed else self.model.nw
        if (self.discrepancy is None or replayed) and w != (1, self.steps, width):
            raise InputError("scenarios", f"disturbances of shape {w[1:]}", f"({self.steps}, {width})")

    @cached_property
    def moments(self) -> tuple[Array, Array, Array]:
        """Mean (nx,) and covariance (nx, nx) of starts, second moments (nw, nw) of w about its stated mean."""
        mean, covariance, drift, noise = drawn_moments(self.scenarios, self.steps)
        unstated = drift - self.mean_disturbance
        return mean, covariance, noise + np.outer(unstated, unstated)

    @property
    def mean_disturbance(self) -> Array:
        """Mean (nw,) that the disturbance states; 0 where it states none, or errors are learned."""
        known: Any = getattr(getattr(self.scenarios, "disturbance", None), "mean", None)
        stated = self.discrepancy is None and np.shape(known) == (self.model.nw,)
        return np.asarray(known, dtype=float) if stated else np.zeros(self.model.nw)

    def driving(self, runs: int, steps: int, rng: np.random.Generator) -> Array:
        """Disturbance, draws or errors (runs, steps, ·) for any `steps`.

        They are nw disturbances, or nx draws or errors.

        Scenarios are asked for no more than an episode, which is all that they offer, and these follow one another;
        a `disturbance` of theirs has any length.
        """
        if self.discrepancy is not None and self.discrepancy.noise == "quantiles":
            return rng.random((runs, steps, self.model.nx))
        disturbance = getattr(self.scenarios, "disturbance", None)
        if callable(getattr(disturbance, "sample", None)):
            return np.asarray(disturbance.sample(runs, steps, rng))  # type: ignore[union-attr]
        episodes = [self.scenarios.sample(runs, self.steps, rng)[1] for _ in range(-(-steps // self.steps))]
        return np.concatenate(episodes, axis=1)[:, :steps]

    def __repr__(self) -> str:
        updated = "" if self.discrepancy is None else f", error model with {self.discrepancy.noise} noise"
        return f"CoDesignProblem({self.model!r}, {self.steps} steps{updated})"

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What is to be known of the model and of entries of the design that act only together."""
        return tuple(filter(None, (self.jump, acting_together(self))))

    @cached_property
    def jump(self) -> str:
        """Where plant or cost jumps, which gradients do not see; empty where no jump is known."""
        return self.model.jump or self.objective.jump(*self._boxes, (self.design.lower, self.design.upper))

    @property
    def design(self) -> DesignSpace:
        """Box of designs."""
        space: DesignSpace = self.model.design
        return space

    def weights(self, p: Array) -> Weights:
        """Weights of LQR and MPC at a design (np,)."""
        return self.objective.weights(p, self.model.nx, self.model.nu)

    def made_by_control(self, value: Any, p: Any) -> Any:
        """Size of an episode's return, without the design cost."""
        return abs(value + self.cost_of_design(p))

    def cost_of_design(self, p: Any) -> Any:
        """Cost of the design that an episode pays."""
        return self.objective.cost_of_design(p, self.steps - self.warm_up)

    def kept_by_mpc(self, p: Array) -> Polytope:
        """States that MPC keeps: X, and linear output limits of states."""
        X = self.state_limits(p)
        return X if self.output_limits is None else self.output_limits.within(X, self.model.nu, p)

    def state_limits(self, p: Array) -> Polytope:
        """X at a design (np,)."""
        return limits_at(self.X, p)

    def input_limits(self, p: Array) -> Polytope:
        """U at a design (np,)."""
        return limits_at(self.U, p)

    def input_bounds_at(self, p: Any) -> tuple[Any, Any]:
        """Input bounds (nu,) or of U(p) (..., nu), at designs (..., np)."""
        return self.U.bounds(p) if isinstance(self.U, DesignLimits) else self.input_bounds

    @property
    def input_bounds(self) -> tuple[Array, Array]:
        """Lower and upper input bounds (nu,), widest of a U(p)."""
        lower, upper = self._boxes[1]
        return lower.copy(), upper.copy()

    @property
    def action_bounds(self) -> tuple[Array, Array] | DesignLimits:
        """Action bounds for `fit_actor_critic`: U, or its function of designs."""
        return self.U if isinstance(self.U, DesignLimits) else self.input_bounds

    @property
    def state_scale(self) -> Array:
        """Largest |x| within X, at any design, (nx,)."""
        return np.asarray(np.max(np.abs(self._boxes[0]), axis=0))

    @cached_property
    def _boxes(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Bounding boxes of X and U, widest of those that depend on the design."""
        return widest(self.X).bounding_box(), widest(self.U).bounding_box()

    @cached_property
    def state_rows(self) -> OutputLimits:
        """Rows of X or X(p), in half-widths."""
        return limits_of(self.X, self.state_names)

    @cached_property
    def violations(self) -> SymbolicFunction:
        """(x⁺, u, x, p) → violation of each limit (m,), in half-widths.

        Of the rows of X by x⁺, the state after a step, and of the limits of outputs by x and u.
        """

        def beyond(x_next: ca.SX, u: ca.SX, x: ca.SX, p: ca.SX) -> ca.SX:
            """Rows, each ≤ 0 where the limit is kept."""
            sizes = (x.numel(), u.numel(), p.numel())
            outputs = [] if self.output_limits is None else [self.output_limits.scaled.function(*sizes)(x, u, p)]
            return ca.vertcat(self.state_rows.scaled.function(*sizes)(x_next, u, p), *outputs)

        return SymbolicFunction("limits", beyond, ("x_next", "u", "x", "p"))

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the plant's states, else x1, x2, …."""
        return self._names("state_names", "x", self.model.nx)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the plant's inputs, else u1, u2, …."""
        return self._names("input_names", "u", self.model.nu)

    def _names(self, which: str, letter: str, size: int) -> tuple[str, ...]:
        """Names of the plant, or a letter with numbers."""
        return getattr(self.model, which, None) or as_names(which, (), size, letter)

    @property
    def limit(self) -> Array:
        """Divergence limit on |x|, (nx,)."""
        return self.divergence * self.state_scale

    @property
    def observation_bounds(self) -> tuple[Array, Array]:
        """Range of the observation (x, p), each (nx − hidden + np,), with room at fixed entries."""
        scale = self.state_scale[self.hidden :]
        lower, upper = self.design.lower, self.design.upper
        room = np.where(self.design.free, 0.0, np.where(lower == 0, 1.0, 0.5 * np.abs(lower)))
        return np.r_[-scale, lower - room], np.r_[scale, upper + room]


def as_seen_problem(value: Any) -> CoDesignProblem:
    """`value`, if it is a problem whose states are seen; else an `InputError`."""
    problem: CoDesignProblem = as_instance("problem", value, CoDesignProblem, "a CoDesignProblem")
    if problem.measurement is not None or problem.hidden:
        cure = "Errors along estimates are those of the filter, too: redesign on what `fit_plant` tells."
        raise InputError("problem", "one with sensors, or hidden states", "one whose states are seen", cure)
    return problem
