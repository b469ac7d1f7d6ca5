"""Controllers by designs, scenarios, plants and seeds, each task computed once."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.co_design.objective import Objective, as_objective
from ccdtools.comparison.experiment_header import conditions_in_words
from ccdtools.comparison.experiment_plan import Drawn, Maker, Plan, named
from ccdtools.comparison.experiment_table import Experiment
from ccdtools.comparison.metrics import Metrics, as_metrics, metrics_of
from ccdtools.comparison.pid_tuning import REFERENCE
from ccdtools.comparison.stopped_runs import stopped_runs
from ccdtools.controllers.controllers import Passive
from ccdtools.design_limits import Limits, set_at
from ccdtools.exceptions import InputError, SimulatorError
from ccdtools.jobs import as_jobs, as_they_end
from ccdtools.limits import limits_in_words
from ccdtools.output_limits import OutputLimits
from ccdtools.plants.models import Simulable, as_simulable
from ccdtools.scenario import Scenario
from ccdtools.trajectory import Trajectory
from ccdtools_ground.door import as_choice, as_count, as_flag, as_instance, as_mapping, as_vector, shown, writable_path


def experiment(
    controllers: Mapping[str, Maker],
    scenarios: Scenario | Drawn | Mapping[str, Scenario | Drawn],
    *,
    objective: Objective,
    X: Limits | tuple[ArrayLike, ArrayLike],
    U: Limits | tuple[ArrayLike, ArrayLike] | None = None,
    designs: ArrayLike | Mapping[str, ArrayLike] | None = None,
    plants: Mapping[str, Any] | None = None,
    seeds: int | Sequence[int] = 10,
    baseline: str | None = None,
    limit: ArrayLike | None = None,
    output_limits: OutputLimits | None = None,
    metrics: Metrics | None = None,
    folder: str | Path | None = None,
    jobs: int = 1,
    progress: bool = False,
    compiled: bool = False,
) -> Experiment:
    """Controllers × designs × scenarios × plants × seeds, compared in pairs.

    Every controller is made anew for each design and seed, so what is learned is learned as often as there are seeds.
    A task (controller, design, seed) has generators of its own: its numbers are the same in whatever order and process
    it runs, and are computed by one thread.

    Parameters
    ----------
    controllers : mapping of name to function
        (design (np,), rng) → controller, see `ccdtools.controllers.controllers`, or (controller, samples that it was
        trained on). One that stops with an error is a row that says why.
    scenarios : Scenario, function, or mapping of name to either
        A `Scenario` is met with every seed. A function rng → Scenario draws runs of its own for each seed, the same
        for all controllers.
    objective : QuadraticObjective or CustomObjective
    X : Polytope, bounds (lower, upper), or the X(p) of a problem
    U : the same of inputs, optional
        Its violations count with those of X. Nothing is clipped: without U any input counts as what the plant can do.
    designs : (np,) array_like, or mapping of name to (np,), optional
    plants : mapping of name to plant, optional
        Each takes the place of the scenarios' own, such as one with a heavier mass.
    seeds : int or sequence of int
        How many, from 0 on, or which.
    baseline : str, optional
        The controller that the others are paired to, at the same design: "LQR" by default, or the first.
    limit : (nx,) array_like, optional
        Divergence limit on |x|, see `simulate`; a thousand times the largest |x| within X by default.
    output_limits : OutputLimits, optional
    metrics : function, optional
        `Trajectory` → mapping of names, with units, to numbers.
    folder : path, optional
        Where every finished task is kept and found again, after an interruption or with more seeds or controllers. A
        controller is known by its name and by what its function does, holds and calls of your own code: one that was
        changed runs anew, and its old numbers stay for when it is changed back. A list or memory of your module that it
        changes is part of that: it runs anew each time. So are plants, scenarios, objectives, sensors, limits and
        metrics: what does not say what it holds counts as another each time. A controller that was made is not made
        again where a run stopped: what it found is kept, as if such a run would always stop. Where it would not, as
        without a licence, delete the files ``*.stopped.npz``.
    jobs : int
        Processes, −1 for all cores; joblib's backend is taken, such as Dask's.
    progress : bool
    compiled : bool
        Whether exported C is timed, too, as by `compare`.

    Returns
    -------
    Experiment
        It prints as a table, and has `rows()`, `to_frame()`, `save("….csv", ".parquet" or ".html")`, `plot()` and
        `verdicts`; iterated, a `Compared` per controller, design, scenario and plant.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or size, seeds repeat, no controller has the name of the baseline, no plant
        works for one sample from any start at any design, or the folder cannot be written or read.
    """
    made = as_mapping("controllers", controllers, "a mapping of names to functions (design, rng) -> controller")
    for name, maker in made.items():
        _check_maker(f"controllers[{name!r}]", maker)
    if not made:
        raise InputError("controllers", "none", "at least one")
    base = (REFERENCE if REFERENCE in made else next(iter(made))) if baseline is None else baseline
    as_choice("baseline", base, list(made))
    as_objective("objective", objective)
    if output_limits is not None:
        as_instance("output_limits", output_limits, OutputLimits, "OutputLimits(h, lower, upper) or None")
    as_metrics(metrics)
    plan = Plan(
        made, _as_scenarios(scenarios), _as_designs(designs), _as_plants(plants), objective, X, U, limit,
        output_limits, metrics, as_flag("compiled", compiled),
    )  # fmt: skip
    numbers = as_seeds(seeds)
    kept_in = None if folder is None else _as_folder(folder)
    _check(plan, numbers[0])
    tasks = [(name, design, seed) for seed in numbers for design in plan.designs for name in made]
    names = [", ".join(filter(None, (name, design, f"seed {seed}"))) for name, design, seed in tasks]
    files = [None] * len(tasks) if kept_in is None else plan.files(kept_in, tasks)
    found = as_they_end(
        plan.record, list(zip(tasks, files)), jobs=as_jobs(jobs), label="tasks", names=names, progress=progress
    )
    records = tuple(found)
    first = plan.conditions(numbers[0])
    sets = {
        kind: {name: [set_at(limits, p, kind, getattr(scenario.plant, size)) for scenario in first.values()]
               for name, p in plan.designs.items()}
        for kind, limits, size in (("X", X, "nx"), ("U", U, "nu")) if limits is not None
    }  # fmt: skip
    told = conditions_in_words(first, plan.designs, objective, sets, numbers)
    return Experiment(records, base, _fresh(plan, numbers), limits_in_words(output_limits, U), told)


def _fresh(plan: Plan, seeds: Sequence[int]) -> frozenset[str]:
    """Scenarios that are others with another seed."""
    first, other = (plan.conditions(seed) for seed in (seeds[0], seeds[-1]))
    return frozenset(
        name for (name, plant), one in first.items()
        if not isinstance(plan.scenarios[name], Scenario) and (len(seeds) == 1 or not _alike(one, other[name, plant]))
    )  # fmt: skip


def _alike(one: Scenario, other: Scenario) -> bool:
    """Whether two scenarios are the same runs."""
    noise = (getattr(scenario.output, "noise", None) for scenario in (one, other))
    pairs = ((one.x0, other.x0), (one.disturbance, other.disturbance), tuple(map(np.array, noise)))
    return all(np.array_equal(*pair) for pair in pairs)


def as_seeds(seeds: Any) -> tuple[int, ...]:
    """Different seeds: as many from 0 on, or those given."""
    if not isinstance(seeds, Sequence | np.ndarray):
        return tuple(range(as_count("seeds", seeds)))
    found = tuple(as_count("seeds", seed, least=0) for seed in seeds)
    if not found or len(set(found)) < len(found):
        raise InputError("seeds", shown(list(seeds)), "a number of seeds, or different ones")
    return found


def _check_maker(argument: str, maker: Any) -> None:
    """Raise an `InputError` unless it takes a design and a generator."""
    cure = "lambda design, rng: controller makes one of a controller."
    expected = "a function (design, rng) -> controller"
    if not callable(maker):
        raise InputError(argument, shown(maker), expected, cure)
    try:
        inspect.signature(maker).bind(None, None)
    except (TypeError, ValueError):
        raise InputError(argument, f"a {type(maker).__name__} that takes no (design, rng)", expected, cure) from None


def _as_scenarios(given: Any) -> dict[str, Any]:
    """Scenarios by name; one alone has none."""
    expected = "a Scenario, a function rng -> Scenario, or a mapping of names to such"
    found = as_mapping("scenarios", given, expected) if isinstance(given, Mapping) else {"": given}
    for name, one in found.items():
        if not isinstance(one, Scenario) and not callable(one):
            raise InputError(named("scenarios", name), shown(one), "a Scenario, or a function rng -> Scenario")
    if not found:
        raise InputError("scenarios", "none", "at least one")
    return found


def _as_designs(designs: Any) -> dict[str, Array]:
    """Designs (np,) by name; one alone has none."""
    if designs is None:
        return {"": np.zeros(0)}
    if not isinstance(designs, Mapping):
        return {"": as_vector("designs", designs)}
    named = as_mapping("designs", designs, "a mapping of names to designs")
    found = {name: as_vector(f"designs[{name!r}]", p) for name, p in named.items()}
    if not found:
        raise InputError("designs", "none", "at least one, or None for a plant without design parameters")
    return found


def _as_plants(plants: Any) -> dict[str, Simulable | None]:
    """Plants by name; None stands for that of the scenario."""
    if plants is None:
        return {"": None}
    found = as_mapping("plants", plants, "a mapping of names to plants")
    if not found:
        raise InputError("plants", "none", "at least one, or None for the plants of the scenarios")
    return {name: as_simulable(plant, f"plants[{name!r}]") for name, plant in found.items()}


def _as_folder(folder: str | Path) -> Path:
    """Folder for records, made if there is none."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("folder", f"{path} ({error.strerror or error})", "a folder that can be written") from None
    writable_path("folder", path / "record.npz")
    return path


def _check(plan: Plan, seed: int) -> None:
    """Raise an `InputError` unless designs, limits and objective fit the plants, one of which works."""
    works, dead = False, None
    for scenario in plan.conditions(seed).values():
        for p in plan.designs.values():
            first = scenario.first(1)
            try:
                run = plan.simulated(first, Passive(scenario.plant.nu), p)
                if plan.metrics is not None:
                    metrics_of(plan.metrics, run)
                works = True
            except SimulatorError as error:  # each controller is told of it
                run = error.kept if isinstance(error.kept, Trajectory) else stopped_runs(first, p, "").run
                # one that hangs or ends its process may work under other inputs
                works, dead = works or run is error.kept or isinstance(error.__cause__, SimulatorError), error
            run.rewards(plan.objective)
            plan.outside(run, scenario)
    if dead is not None and not (works or any(_steps(plan, seed))):
        raise dead  # of a function that never worked


def _steps(plan: Plan, seed: int) -> Iterator[bool]:
    """Whether a first sample can be simulated, of each start at each design."""
    for scenario in plan.conditions(seed).values():
        for i, p in product(range(len(scenario.x0)), plan.designs.values()):
            try:
                plan.simulated(scenario.part(slice(i, i + 1), 1), Passive(scenario.plant.nu), p)
            except SimulatorError:
                yield False
            else:
                yield True
