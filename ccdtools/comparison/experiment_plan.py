"""Plan of an experiment."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from ccdtools.arrays import Array
from ccdtools.co_design.objective import Objective
from ccdtools.comparison.c_step_time import NONE, c_step_time
from ccdtools.comparison.comparison import step_times
from ccdtools.comparison.experiment_header import described
from ccdtools.comparison.experiment_record import Cell, Record, read_record, write_record
from ccdtools.comparison.metrics import Metrics, metrics_of
from ccdtools.comparison.stopped_runs import Runs, joined, stopped_runs
from ccdtools.controllers.signals import as_controller, needs_of
from ccdtools.design_limits import set_at
from ccdtools.exceptions import CCDError
from ccdtools.limits import Excursions, divergence_limit
from ccdtools.output_limits import OutputLimits
from ccdtools.plants.models import Simulable
from ccdtools.scenario import Scenario
from ccdtools.trajectory import Trajectory
from ccdtools_ground.content import content_of
from ccdtools_ground.door import as_count, as_instance
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
            as_instance(named("scenarios", name), scenario, Scenario, "a Scenario, or a function rng -> Scenario")
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
        raise stopped(named("scenarios", name), given, error, "a function rng -> Scenario") from error


def named(argument: str, name: str) -> str:
    """Argument of a name; one given alone has none."""
    return f"{argument}[{name!r}]" if name else argument
