"""Declaration of a case study."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.co_design.method_names import STUDY_EXPERTS
from ccdtools.co_design.objective import Objective, Weights, as_objective
from ccdtools.co_design.problem import CoDesignProblem, FixedStart
from ccdtools.co_design.random_starts import RandomStarts
from ccdtools.co_design.risk import MEAN, Risk, of_logged_runs
from ccdtools.comparison.metrics import Metrics, as_metrics, try_metrics
from ccdtools.controllers.controllers import Controller
from ccdtools.design_limits import Limits, as_limits_over, widest
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.exceptions import CCDError, InputError
from ccdtools.limit_tolerance import as_limit_tolerance
from ccdtools.output_limits import OutputLimits
from ccdtools.plants.discretisation import discretise
from ccdtools.plants.models import Model, as_regulated_model
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import METHODS, SampledModel
from ccdtools.plants.tolerances import ACCURACY
from ccdtools.studies.budgets import MODEL_RUNS
from ccdtools.studies.names import TAKEN
from ccdtools.studies.options import CHOICES
from ccdtools.studies.plant_checks import check_finite, check_real_step, check_same_plant, extent_of
from ccdtools.studies.price import ACCEPTED_LOSS, DEFAULT_PRICE, RedesignPrice, accepted_loss
from ccdtools.studies.real_plant import RealPlant, check_disturbance
from ccdtools.studies.redesign_cost import RedesignCost
from ccdtools.twin.transport import check_disturbance_enters
from ccdtools_ground.door import as_choice, as_count, as_instance, as_mapping, as_positive, as_vector, as_weight, shown
from ccdtools_ground.user_functions import stopped
from mpc import MPCError, lqr


@dataclass(frozen=True, eq=False, repr=False)
class Study(Immutable):
    """Case study, checked when it is made.

    Attributes
    ----------
    name, title : str
    plant : Plant
        Linear in x, u, w or not; its design space, its sampling time and the limits of its outputs come with it.
    X, U : Polytope, bounds (lower, upper), or function of p
        State and input limits; both bounded and around the origin, U a box. Each bound is a number for all
        coordinates, or one number each. A function of the design returns bounds, see `CoDesignProblem`.
    objective : QuadraticObjective or CustomObjective
    disturbance : Disturbance
        What the nominal model assumes.
    x0 : (nx,) array
        Start of every evaluation, within X.
    p0 : (np,) array
        First design.
    real : RealPlant, optional
        The model itself by default: its disturbance, 200 runs of an evaluation. Of a plant that is not linear the steps
        are those of the model, too.
    steps : int
        Length of an evaluation.
    quantile_weight : (nx, nx) array, optional
        Q_q of the penalty on the quantile width; 0.1 Q by default.
    paper_networks : tuple of int
        Hidden layers of the preset ``paper``.
    samples : int
        Latin hypercube samples of the initialisation.
    sets : {"auto", "lqr", "none"}
        Sets that the samples are taken from: X_fea(p) as far as the time goes; what saturated LQR keeps within X; X.
    sets_time_limit : float
        Budget for these sets [s]: the work of a usual processor, counted alike on every machine.
    limit_tolerance : "mpc", "off" or (fraction, depth)
        How often and how far the co-designed policy may leave X, see `CoDesignProblem`; a redesign or an update that
        leaves it further, and further than what is deployed, is refused.
    filter : {"none", "admissible"}
        What stands behind the deployed policy on the real plant: nothing, or a filter that keeps the next state of
        the nominal model in X_fea(p).
    redesign_price : str
        The predicted gain that a redesign needs: "0.5 %" of the deployed return without the cost of the design, or
        "12 return", in units of the return of an evaluation.
    unknown : Plant, optional
        The plant with unknown entries in its design besides, such as a mass, within their bounds: after each deployment
        the model is the plant that all logs tell, see `fit_plant`. By default the model stays as it is.
    redesign_cost : RedesignCost, optional
        What a redesign costs and how long it serves, in money or in return. It takes the place of `redesign_price`: a
        run redesigns, logs longer or stops as `decide_redesign` says.
    accept_loss : str
        What a redesign or an update may lose, on any distribution that it will serve, for a gain where it was made for:
        "0.5 %" of the return there by default.
    sampling_guard : {"warn", "ignore"}
        Whether a sampling time that does not resolve the plant is warned of, see `discretise`, and steps of the real
        plant that may be wrong by a tenth of X.
    risk : Mean, MeanSpread, CVaR or WorstCase
        What of the returns a co-design optimises, and by which redesigns, updates and deployments are judged. Of a
        worst case, whose cases a log does not tell, these are judged by the mean.
    accuracy : float
        Of the model of a plant that is not linear: largest error of a sample, relative to half the range of each state
        in X, see `discretise`.
    method : {"auto", "rk4", "collocation"}
        Of the same model: explicit Runge–Kutta, or collocation for stiff plants.
    starts : Polytope, distribution or (n, nx) array, optional
        Where episodes and evaluations on the model start, see `RandomStarts`; at `x0` by default. The real plant starts
        at its own x0.
    expert : str
        What the first policy imitates: "lqr", "mpc", "explicit", or the name of one of `laws`. "auto" is "lqr", or MPC
        of the model where LQR brings nothing to rest, as in a swing-up.
    laws : mapping of names to functions, optional
        Control laws of the field that every comparison shows beside LQR, PID and MPC: (problem, design) → controller.
    settings : mapping, optional
        Fields of `StudyConfig` by name, in the place of the defaults: how thoroughly this study runs.
    metrics : function, optional
        `Trajectory` → mapping of names, with units, to numbers, such as a `Ride`: what every comparison shows beside
        the returns.

    Raises
    ------
    InputError
        If a field is of another kind or size, the model is not finite over the design box or cannot be stabilised
        at `p0`, its accuracy is not reached, `x0` lies outside X or breaks a limit of an output, or the real plant is
        another one than the model describes, or its steps are too long for it.
    """

    options_taken: ClassVar[tuple[str, ...]] = ()  # of `ccdtools run`; empty: all
    runs_so: ClassVar[str] = ""  # why it takes no others
    name: str
    title: str
    plant: Plant
    X: Limits
    U: Limits
    objective: Objective
    disturbance: Disturbance
    x0: ArrayField
    p0: ArrayField
    real: RealPlant = None  # type: ignore[assignment]  # a RealPlant once the object exists
    steps: int = 100
    quantile_weight: ArrayField = None
    paper_networks: tuple[int, ...] = (32, 32, 16, 16)
    samples: int = 1000
    redesign_price: str = DEFAULT_PRICE
    accept_loss: str = ACCEPTED_LOSS
    limit_tolerance: str | tuple[float, float] = "mpc"
    filter: str = "none"
    sampling_guard: str = "warn"
    sets: str = "auto"
    sets_time_limit: float = 20.0
    risk: Risk = MEAN
    accuracy: float = ACCURACY
    method: str = "auto"
    starts: Any = None
    metrics: Metrics | None = None
    expert: str = "auto"
    laws: Mapping[str, Callable[[CoDesignProblem, Array], Controller]] = field(default_factory=dict)
    redesign_cost: RedesignCost | None = None
    unknown: Plant | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Study({self.name!r}, {self.plant!r}, {self.steps} steps, start {self.plant.design.describe(self.p0)})"

    def __post_init__(self) -> None:
        self._check_kinds()
        check_finite(self.plant)
        check_disturbance("disturbance", self.disturbance, self.plant)
        self._set(x0=as_vector("x0", self.x0, self.plant.nx, of="one per state"))
        p0 = as_vector("p0", self.p0, self.plant.design.dim, of="one per design parameter")
        self._set(p0=self.plant.design.check_feasible(p0, argument="p0"))
        if self.quantile_weight is not None:
            self._set(quantile_weight=as_weight("quantile_weight", self.quantile_weight, self.plant.nx))
        self._check_limits()
        self._check_stabilisable()
        check_disturbance_enters(self.model)
        if self.real is None:
            plant = self.model if isinstance(self.model, SampledModel) else self.plant
            self._set(real=RealPlant(plant, self.disturbance, self.x0, MODEL_RUNS, max(self.steps, 3)))
        if self.unknown is not None:
            from ccdtools.twin.unknown_plant import stated_plant  # estimation is loaded where it is asked for

            stated_plant(self.problem(), self.unknown)
            kinds = [(one.dt, one.continuous) for one in (self.unknown, self.plant)]
            if kinds[0] != kinds[1]:
                got, expected = (f"{'continuous' if kind else 'discrete'}, dt = {dt:g} s" for dt, kind in kinds)
                raise InputError("unknown", got, f"{expected}, as the plant")
        for real in (as_instance("real", self.real, RealPlant, "a RealPlant, or None for the model"), *self.real.later):
            self._check_real(real)

    def _check_kinds(self) -> None:
        for argument in ("name", "title"):
            value = getattr(self, argument)
            if not isinstance(value, str) or not value.strip() or len(value.splitlines()) > 1:
                raise InputError(argument, shown(value), "one line of text")
        as_instance("plant", self.plant, Plant, "a ccdtools.Plant")
        space = self.plant.design
        self._set(X=as_limits_over("X", self.X, self.plant.nx, "one per state", space))
        self._set(U=as_limits_over("U", self.U, self.plant.nu, "one per input", space))
        self._set(steps=as_count("steps", self.steps))
        self._set(objective=as_objective("objective", self.objective).over(self.steps))
        self._set(samples=as_count("samples", self.samples))
        as_choice("sets", self.sets, CHOICES["sets"])
        self._set(sets_time_limit=as_positive("sets_time_limit", self.sets_time_limit, unit="s"))
        if not isinstance(self.paper_networks, list | tuple):
            raise InputError("paper_networks", shown(self.paper_networks), "the widths of the hidden layers")
        self._set(paper_networks=tuple(as_count("paper_networks", width) for width in self.paper_networks))
        RedesignPrice.parse(self.redesign_price)
        accepted_loss(self.accept_loss)
        if self.redesign_cost is not None:
            as_instance("redesign_cost", self.redesign_cost, RedesignCost, "a RedesignCost or None")
            if self.redesign_price != DEFAULT_PRICE:
                raise InputError("redesign_price", shown(self.redesign_price), "it or redesign_cost, not both")
        self._set(limit_tolerance=as_limit_tolerance("limit_tolerance", self.limit_tolerance))
        as_choice("filter", self.filter, CHOICES["filter"])
        self._set(accuracy=as_positive("accuracy", self.accuracy))
        as_choice("method", self.method, ("auto", *METHODS))
        metrics = as_metrics(self.metrics)
        if metrics is not None:
            try_metrics(metrics, self.plant)
        for name, law in as_mapping("laws", self.laws, "a mapping of names to functions of (problem, design)").items():
            if not isinstance(name, str) or name in TAKEN or not callable(law):
                expected = f"a function of (problem, design), by a name other than {', '.join(TAKEN)}"
                raise InputError("laws", f"{shown(law)} by the name {shown(name)}", expected)
        as_choice("expert", self.expert, (*STUDY_EXPERTS, *self.laws))
        self._set(settings=as_mapping("settings", self.settings, "a mapping of fields of StudyConfig to values"))

    def _check_limits(self) -> None:
        """Raise unless the problem can be stated, and X holds the start."""
        if self.starts is not None:
            self._check_starts()
        try:
            self.problem()  # checks limits, their dimensions, and the sizes of Q and R
            FixedStart(self.x0, self.disturbance).check_within(widest(self.X))
        except InputError as error:
            raise InputError(error.argument.removeprefix("scenarios."), error.got, error.expected, error.cure) from None

    def _check_stabilisable(self) -> None:
        A, B, _ = self.model.matrices(self.p0)
        try:
            lqr(A, B, **self.weights.keywords())
        except MPCError as error:
            got = f"{self.plant.design.describe(self.p0)}, where LQR fails ({error})"
            raise InputError("p0", got, "a design at which the model can be stabilised") from None

    def _check_starts(self) -> None:
        try:
            scenarios = RandomStarts(self.starts, self.disturbance)
            drawn = np.shape(scenarios.states(1, np.random.default_rng(0)))
            if drawn != (1, self.plant.nx):
                raise InputError("x0", f"states of shape {drawn[1:]}", f"({self.plant.nx},), one per state")
            scenarios.check_within(widest(self.X))
        except InputError as error:
            raise InputError("starts", error.got, error.expected, error.cure) from None

    def _check_real(self, real: RealPlant) -> None:
        check_same_plant(self.plant, real)
        if isinstance(real.plant, Plant):
            X, U = widest(self.X), widest(self.U)
            check_real_step(real.plant, X, U, extent_of(real.disturbance), guard=self.sampling_guard)

    @cached_property
    def model(self) -> Model:
        """Discrete model, exact or integrated to an accuracy within X, U and W.

        W are the bounds of a thousand samples of the disturbance, and of 200 runs of it.
        """
        if self.plant.linear:
            return as_regulated_model("plant", discretise(self.plant, sampling_guard=self.sampling_guard))
        W = extent_of(self.disturbance)
        model = discretise(
            self.plant, X=self.X, U=self.U, W=W if np.any(W) else None, accuracy=self.accuracy,
            method=self.method, sampling_guard=self.sampling_guard, compiled=True,
        )  # fmt: skip
        return as_regulated_model("plant", model)

    def law(self, name: str, problem: CoDesignProblem, p: Array) -> Controller:
        """Law of a name at a design (np,)."""
        try:
            return self.laws[name](problem, p)
        except (CCDError, MPCError):
            raise
        except Exception as error:
            expected, at = "a function of (problem, design)", f" at the design {p.tolist()}"
            raise stopped(f"laws[{name!r}]", self.laws[name], error, expected, at=at) from error

    @property
    def real_is_model(self) -> bool:
        """Whether the real plant, whenever it is met, is the model itself."""
        met = (one.plant for one in (self.real, *self.real.later))
        own = (self.plant, self.plant.for_many_runs)
        return all((real.plant if isinstance(real, SampledModel) else real) in own for real in met)

    @property
    def price(self) -> RedesignPrice:
        """Predicted gain that a redesign must exceed."""
        if self.redesign_cost is not None:
            return RedesignPrice(self.redesign_cost.needed, relative=False)
        return RedesignPrice.parse(self.redesign_price)

    @property
    def accepted_loss(self) -> float:
        """Accepted loss on any distribution, as a part of the return."""
        return accepted_loss(self.accept_loss)

    @property
    def weight(self) -> Array:
        """Weight Q_q of the penalty on the quantile width."""
        return 0.1 * self.weights.Q if self.quantile_weight is None else self.quantile_weight

    @property
    def weights(self) -> Weights:
        """Weights of LQR and MPC at the first design."""
        return self.objective.weights(self.p0, self.plant.nx, self.plant.nu)

    @property
    def judged_in(self) -> Risk:
        """Risk by which redesigns, updates and deployments are judged."""
        return of_logged_runs(self.risk)

    def problem(self) -> CoDesignProblem:
        """Co-design problem on the nominal model."""
        return CoDesignProblem(
            self.model, self.X, self.U, self.objective, self.scenarios, self.steps,
            limit_tolerance=self.limit_tolerance, output_limits=OutputLimits.of(self.plant), risk=self.risk,
        )  # fmt: skip

    @cached_property  # so that moments of its disturbance are found once
    def scenarios(self) -> FixedStart | RandomStarts:
        """Starts and disturbances of episodes and evaluations on the model."""
        if self.starts is None:
            return FixedStart(self.x0, self.disturbance)
        return RandomStarts(self.starts, self.disturbance)

    def model_starts(self, runs: int, rng: np.random.Generator) -> Array:
        """Initial states (runs, nx) of evaluations on the model."""
        scenarios = self.scenarios
        return scenarios.states(runs, rng) if isinstance(scenarios, RandomStarts) else np.tile(self.x0, (runs, 1))

    def started(self, *, x0: ArrayLike | None = None, p0: ArrayLike | None = None) -> Study:
        """This study from another state or design."""
        if x0 is None:
            return self if p0 is None else replace(self, p0=p0)
        x0 = as_vector("x0", x0, self.plant.nx, of="one per state")
        real = self.real.each(x0=x0) if np.array_equal(self.real.x0, self.x0) else self.real
        return replace(self, x0=x0, real=real, p0=self.p0 if p0 is None else p0, starts=None)
