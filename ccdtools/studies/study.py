"""What a case study declares: one object, in one short file."""

from __future__ import annotations

import importlib.util
import pkgutil
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path

import numpy as np

from ccdtools.arrays import Array, ArrayField
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.co_design.problem import CoDesignProblem, FixedStart
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.exceptions import InputError
from ccdtools.plants.discretisation import LinearModel, discretise
from ccdtools.plants.plant import Plant
from invariant_sets import Polytope


@dataclass(frozen=True, eq=False)
class RealPlant:
    """The plant as it really is, and how it is driven.

    Attributes
    ----------
    plant : Plant
        Nonlinear or linear, with the states, inputs and design of the model.
    disturbance : Disturbance
    x0 : (nx,) array
        Start of every run.
    runs : int
        Runs logged in a deployment.
    steps : int
        Length of a run.
    """

    plant: Plant
    disturbance: Disturbance
    x0: ArrayField
    runs: int
    steps: int


@dataclass(frozen=True, eq=False)
class Study:
    """A case study.

    Attributes
    ----------
    name, title : str
    plant : Plant
        Linear in x, u, w; its design space and sampling time come with it.
    X, U : Polytope
        State and input limits.
    objective : QuadraticObjective
    disturbance : Disturbance
        What the nominal model assumes.
    x0 : (nx,) array
        Start of every evaluation.
    p0 : (np,) array
        First design.
    real : RealPlant
    steps : int
        Length of an evaluation.
    disturbance_unit : str
        For figures.
    quantile_weight : (nx, nx) array, optional
        Q_q of the penalty on the quantile width; 0.1 Q by default.
    paper_networks : tuple of int
        Hidden layers of the preset ``paper``.
    samples : int
        Latin hypercube samples of the initialisation.
    sampling_guard : {"warn", "ignore"}
        Whether a sampling time that does not resolve the plant is warned of, see `discretise`.
    """

    name: str
    title: str
    plant: Plant
    X: Polytope
    U: Polytope
    objective: QuadraticObjective
    disturbance: Disturbance
    x0: ArrayField
    p0: ArrayField
    real: RealPlant
    steps: int = 100
    disturbance_unit: str = "-"
    quantile_weight: ArrayField = None
    paper_networks: tuple[int, ...] = (32, 32, 16, 16)
    samples: int = 1000
    sampling_guard: str = "warn"

    def __post_init__(self) -> None:
        x0 = np.array(self.x0, dtype=float).reshape(-1)
        if len(x0) != self.plant.nx or not np.isfinite(x0).all():
            raise InputError(f"x0: got {x0.tolist()}, expected {self.plant.nx} finite values.")
        object.__setattr__(self, "x0", x0)
        object.__setattr__(self, "p0", self.plant.design.check(self.p0, argument="p0"))

    @cached_property
    def model(self) -> LinearModel:
        """The exact discrete model, symbolic in the design."""
        return discretise(self.plant, sampling_guard=self.sampling_guard)

    @property
    def weight(self) -> Array:
        """Q_q of the penalty on the quantile width."""
        return 0.1 * self.objective.Q if self.quantile_weight is None else np.asarray(self.quantile_weight, float)

    def problem(self) -> CoDesignProblem:
        """The co-design problem on the nominal model, from the evaluation's start."""
        scenarios = FixedStart(self.x0, self.disturbance)
        return CoDesignProblem(self.model, self.X, self.U, self.objective, scenarios, self.steps)

    def started(self, *, x0: Array | None = None, p0: Array | None = None) -> Study:
        """The same study from another state or design; a real start equal to the old x0 moves along."""
        if x0 is not None:
            x0 = np.array(x0, dtype=float).reshape(-1)
            if x0.shape != self.x0.shape:
                raise InputError(f"x0: got {len(x0)} values, expected {len(self.x0)}.")
            real = replace(self.real, x0=x0) if np.array_equal(self.real.x0, self.x0) else self.real
            return replace(self, x0=x0, real=real).started(p0=p0)
        return self if p0 is None else replace(self, p0=p0)


def load_study(name: str) -> Study:
    """The study of a name, or the one that a Python file declares as ``study``.

    Any module of `ccdtools.studies.cases` with a ``study`` is found by its file name.

    Raises
    ------
    InputError
        If there is no such study, or the file declares none.
    """
    if name.endswith(".py"):
        path = Path(name)
        if not path.is_file():
            raise InputError(f"study: got {name}, which is not a file, expected a Python file that declares `study`.")
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except (Exception, SystemExit) as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"study: got {name}, which stops with {type(error).__name__}: {reason}; expected a file that runs."
            ) from error
    elif name in study_names():
        module = import_module(f"ccdtools.studies.cases.{name}")
    else:
        raise InputError(f"study: got {name!r}, expected one of {', '.join(study_names())}, or a Python file.")
    study = getattr(module, "study", None)
    if not isinstance(study, Study):
        raise InputError(f"study: got {name}, which declares no `study`, expected a ccdtools.studies.Study.")
    return study


def study_names() -> list[str]:
    """Names of the studies that come with the package."""
    from ccdtools.studies import cases

    return sorted(module.name for module in pkgutil.iter_modules(cases.__path__))
