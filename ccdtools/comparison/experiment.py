"""Controllers by designs, scenarios, plants and seeds, each task computed once."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from ccdtools.arrays import Array
from ccdtools.co_design.objective import Objective, as_objective
from ccdtools.comparison.c_step_time import NONE, c_step_time
from ccdtools.comparison.comparison import step_times
from ccdtools.comparison.experiment_header import conditions_in_words, described
from ccdtools.comparison.experiment_record import Cell, Record, read_record, write_record
from ccdtools.comparison.experiment_table import Experiment
from ccdtools.comparison.metrics import Metrics, as_metrics, metrics_of
from ccdtools.comparison.pid_tuning import REFERENCE
from ccdtools.comparison.stopped_runs import Runs, joined, stopped_runs
from ccdtools.controllers.controllers import Passive
from ccdtools.controllers.signals import as_controller, needs_of
from ccdtools.design_limits import Limits, set_at
from ccdtools.exceptions import CCDError, InputError, SimulatorError
from ccdtools.jobs import as_jobs, as_they_end
from ccdtools.limits import Excursions, divergence_limit, limits_in_words
from ccdtools.output_limits import OutputLimits
from ccdtools.plants.models import Simulable, as_simulable
from ccdtools.scenario import Scenario
from ccdtools.trajectory import Trajectory
from ccdtools_ground.content import content_of
from ccdtools_ground.door import as_choice, as_count, as_flag, as_instance, as_mapping, as_vector, shown, writable_path
from ccdtools_ground.user_functions import stopped
from invariant_sets import Polytope

Maker = Callable[[Array, np.random.Generator], Any]
Drawn = Callable[[np.random.Generator], Scenario]
Task = tuple[str, str, int]  # names of a controller and of a design, and a seed
Place = tuple[str, str]  # names of a scenario and of a plant


@dataclass(frozen=True, eq=False)
class Plan:
    """What all tasks of an experiment have in common."""

    controllers: Mapping[str, Maker]
    scenarios: Mapping[str, Scenario | Drawn]
    designs: Mapping[str, Array]
    plants: Mapping[str, Simulable | None]
    objective: Objective
    X: Any
    U: Any
    limit: ArrayLike | None
    output_limits: OutputLimits | None
    metrics: Metrics | None
    compiled: bool

    def record(self, asked: tuple[Task, Path | None]) -> Record:
        """Record of a task, from its file where it is finished."""
        task, file = asked
        if file is None:
            return self._computed(task)
        stopped_file = file.with_suffix(f".stopped{file.suffix}")
        for kept in (file, stopped_file):
            if kept.exists():
                return read_record(kept)
        record = self._computed(task)
        if record.made:
            write_record(stopped_file if any(cell.stopped for cell in record.cells) else file, record)
        return record

    def conditions(self, seed: int) -> dict[Place, Scenario]:
        """Scenarios of a seed, by their names and those of the plants."""
        found = {}
        for name, given in self.scenarios.items():
            scenario = given if isinstance(given, Scenario) else _drawn(name, given, _generator(seed, "scenario", name))
            as_instance(_named("scenarios", name), scenario, Scenario, "a Scenario, or a function rng -> Scenario")
            for of_plant, plant in self.plants.items():
                found[name, of_plant] = scenario if plant is None else replace(scenario, plant=plant)
        return found

    def files(self, folder: Path, tasks: Sequence[Task]) -> list[Path]:
        """Files of tasks, named after all that was given for them."""
        makers = {name: content_of(maker) for name, maker in self.controllers.items()}
        seeds = {seed: content_of(self.conditions(seed)) for seed in dict.fromkeys(seed for *_, seed in tasks)}
        common = content_of(
            (self.objective, self.X, self.U, self.limit, self.output_limits, self.metrics, self.compiled)
        )
        return [
            folder / f"{content_of((task, makers[task[0]], self.designs[task[1]], seeds[task[2]], common))}.npz"
            for task in tasks
        ]

    def _computed(self, task: Task) -> Record:
        """Record of a task; errors of the controller are told, all others are raised."""
        name, of_design, seed = task
        p, scenarios = self.designs[of_design], self.conditions(seed)
        with one_thread():
            start = time.perf_counter()
            try:
                made = self.controllers[name](p, _generator(seed, "controller", name, of_design))
                seconds = time.perf_counter() - start
                given, steps = made if isinstance(made, tuple) and len(made) == 2 else (made, 0)
                steps = as_count("steps", steps, least=0)
                controller = as_controller(given)
                needs_of(controller)
            except Exception as error:  # a controller that fails must not lose what the others found
                why = _reason(error)
                return Record(*task, tuple(
                    self._cell(at, scenario, stopped_runs(scenario, p, why), why) for at, scenario in scenarios.items()
                ))  # fmt: skip
            met = {at: self._met(scenario, controller, p) for at, scenario in scenarios.items()}
            timed = next((runs.run for runs in met.values() if not runs.stopped.all()), None)
            median, most = c_step_time(controller, timed) if self.compiled and timed is not None else NONE
            return Record(
                *task,
                tuple(self._cell(at, scenarios[at], runs, _where(runs, at)) for at, runs in met.items()),
                seconds,
                steps,
                remark=str(getattr(controller, "remark", "")),
                about=described(given),
                c_step_time=median,
                c_step_time_99=most,
            )

    def _met(self, scenario: Scenario, controller: Any, p: Array, left: list[int] | None = None) -> Runs:
        """Runs of a controller; where one stops, its half of them is tried again, so that the others are kept.

        So it is while failures are `left`: four runs of all are found so.
        """
        runs = len(scenario.x0)
        left = [4 * runs.bit_length()] if left is None else left
        try:
            run = self.simulated(scenario, controller, p)
            return Runs(run, np.zeros(runs, dtype=bool), step_times(controller, run.states[0], scenario, p))
        except Exception as error:
            left[0] -= 1
            if runs == 1 or left[0] <= 0:
                return stopped_runs(scenario, p, _reason(error))
        return joined(*(
            self._met(scenario.part(half), controller, p, left) for half in (slice(runs // 2), slice(runs // 2, None))
        ))  # fmt: skip

    def _cell(self, names: Place, scenario: Scenario, runs: Runs, why: str) -> Cell:
        run, stopped = runs.run, runs.stopped
        outside = self.outside(run, scenario)
        rewards = run.rewards(self.objective)
        single = len(rewards) == 1
        by_chance = scenario.disturbance.any() or np.any(getattr(scenario.output, "noise", None))
        return Cell(
            *names, returns=np.where(stopped, np.nan, rewards.sum(axis=1)), lost=run.diverged,
            fractions=np.array([one.fraction for one in outside]), peaks=np.array([one.peak for one in outside]),
            rows=np.array([one.rows for one in outside]),
            texts=[one.texts for one in outside], single=single, times=runs.times,
            series=rewards[0] if single and by_chance and not stopped.any() else np.zeros(0),
            design_cost=float(self.objective.cost_of_design(run.design, scenario.steps)),
            metrics={} if self.metrics is None or stopped.all() else metrics_of(self.metrics, run),
            stopped=why, idle=not (stopped.all() or run.inputs.any()),
        )  # fmt: skip

    def simulated(self, scenario: Scenario, controller: Any, p: Array) -> Trajectory:
        """Runs of a scenario at a design (np,) or none."""
        limit = divergence_limit(self.states_at(scenario, p)) if self.limit is None else self.limit
        return scenario.run(controller, design=p if len(p) else None, limit=limit)

    def states_at(self, scenario: Scenario, p: Array) -> Polytope:
        """Set X at a design."""
        return set_at(self.X, p, "X", scenario.plant.nx)

    def outside(self, run: Trajectory, scenario: Scenario) -> tuple[Excursions, ...]:
        """Violations of all limits, and of each kind, by all runs or by stretches of a single one."""
        X, plant = self.states_at(scenario, run.design), scenario.plant
        U = None if self.U is None else set_at(self.U, run.design, "U", plant.nu)
        return Excursions.from_trajectory(run, X, plant, self.output_limits, U)[1]


def _reason(error: Exception) -> str:
    """What an error says."""
    said = " ".join(str(error).split())
    return said if isinstance(error, CCDError) else f"stopped with {type(error).__name__}: {said}"


def _where(runs: Runs, at: Place) -> str:
    """Why runs stopped, where, and how many; empty if none did."""
    if not runs.why:
        return ""
    said = f"{runs.why} ({runs.stopped.sum()} of {len(runs.stopped)} runs)"
    return ": ".join(filter(None, (", ".join(filter(None, at)), said)))


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


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute with one thread: sums do not depend on free cores."""
    import torch  # before the limit, which does not reach what is loaded later

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(threads)


def _generator(seed: int, *names: str) -> np.random.Generator:
    """Generator of its own for names and a seed."""
    return np.random.default_rng([seed, *"\0".join(names).encode()])


def _drawn(name: str, given: Drawn, rng: np.random.Generator) -> Any:
    """What a function makes of a generator, or an `InputError` that names it."""
    try:
        return given(rng)
    except CCDError:
        raise
    except Exception as error:
        raise stopped(_named("scenarios", name), given, error, "a function rng -> Scenario") from error


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


def _named(argument: str, name: str) -> str:
    """Argument of a name; one given alone has none."""
    return f"{argument}[{name!r}]" if name else argument


def _as_scenarios(given: Any) -> dict[str, Any]:
    """Scenarios by name; one alone has none."""
    expected = "a Scenario, a function rng -> Scenario, or a mapping of names to such"
    found = as_mapping("scenarios", given, expected) if isinstance(given, Mapping) else {"": given}
    for name, one in found.items():
        if not isinstance(one, Scenario) and not callable(one):
            raise InputError(_named("scenarios", name), shown(one), "a Scenario, or a function rng -> Scenario")
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
