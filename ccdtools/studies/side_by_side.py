"""Studies of one design per use, on sensors, side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ccdtools.arrays import Array, ArrayField
from ccdtools.checks import as_count, as_mapping, as_vector, shown
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.design_controllers import linear_mpc, saturated_lqr
from ccdtools.co_design.measured import observed
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.methods.nested import Nested
from ccdtools.co_design.problem import CoDesignProblem, FixedStart
from ccdtools.comparison.metrics import MetricChange, metric_changes, metrics_of
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.history import History
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.estimation.measurement import Measurement
from ccdtools.exceptions import InputError
from ccdtools.scenario import Scenario
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.presets import StudyConfig
from ccdtools.studies.real_plant import check_disturbance
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.stage_storage import Stage
from ccdtools.studies.study import Study
from ccdtools.trajectory import Trajectory

START = "start"  # the first design of the study
Place = tuple[str, str]  # names of a design and of a controller


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SideBySide(Study):
    """Study of several uses, such as drivers, each with a design and a policy of its own.

    Loops are closed on sensors alone. A run co-designs LQG and a policy of outputs for every use, then tries all
    designs in all uses on the real plant, under the disturbances that `real.held_out` has by the names of the uses.

    Attributes
    ----------
    uses : mapping of str to Disturbance
        What each design is made for.
    noise : (ny,) array
        Standard deviations of the sensors, which measure the outputs of the plant, or of the real one.
    history : int
        Last outputs and inputs that the policy sees.

    Raises
    ------
    InputError
        As of a `Study`; if there are fewer than two uses, or a use without a held-out disturbance, or plants have other
        outputs than sensors.
    """

    uses: Mapping[str, Disturbance]
    noise: ArrayField
    history: int = 8

    def __post_init__(self) -> None:
        uses = as_mapping("uses", self.uses, "a mapping of names to disturbances")
        if len(uses) < 2:
            raise InputError("uses", shown(list(uses)), "two or more")
        for name, disturbance in uses.items():
            check_disturbance(f"uses[{name!r}]", disturbance, self.plant)
        object.__setattr__(self, "uses", uses)
        object.__setattr__(self, "history", as_count("history", self.history))
        object.__setattr__(self, "noise", as_vector("noise", self.noise, self.plant.ny, of="one per output"))
        super().__post_init__()
        if set(self.real.fresh) != set(uses):
            raise InputError("real.held_out", shown(list(self.real.fresh)), f"those of the uses: {', '.join(uses)}")
        if getattr(self.real.plant, "ny", 0) != self.plant.ny:
            raise InputError("real.plant", "other outputs", f"{self.plant.ny}, as the model has")

    @cached_property
    def problems(self) -> dict[str, CoDesignProblem]:
        """Co-design problem of every use, on the nominal model and its sensors."""
        own, sensors = self.problem(), Measurement(self.plant, noise=self.noise)
        return {
            use: replace(own, scenarios=FixedStart(self.x0, disturbance), measurement=sensors)
            for use, disturbance in self.uses.items()
        }

    def judged(self, run: Trajectory) -> Mapping[str, float]:
        """Cost of a step, and the metrics of the study."""
        cost = -float(run.returns(self.objective).mean()) / run.inputs.shape[1]
        return {"cost": cost} | dict({} if self.metrics is None else self.metrics(run))


@dataclass(frozen=True, eq=False)
class Trial:
    """What was measured in one use.

    Attributes
    ----------
    values : dict
        Metrics by name, of every design and controller.
    changes : dict
        Changes of the metrics by question: what the design brings, what the policy brings, and so on.
    """

    values: dict[Place, dict[str, float]]
    changes: dict[str, tuple[MetricChange, ...]]

    @property
    def names(self) -> list[str]:
        """Names of the metrics."""
        return list(next(iter(self.values.values())))


@dataclass(frozen=True, eq=False)
class SideBySideRun:
    """Run of such a study in a folder; what is finished there is read."""

    study: SideBySide
    config: StudyConfig
    folder: RunFolder
    seed: int
    echo: Callable[[str], None]
    progress: bool = False

    def run(self) -> tuple[dict[str, Stage], dict[str, Trial]]:
        """Co-designs and trials by use."""
        found = {use: self._kept(f"design-{use}", lambda use=use: self._designed(use)) for use in self.study.uses}
        return found, {use: self._tried(use, found) for use in self.study.uses}

    def _kept(self, name: str, make: Callable[[], Stage]) -> Stage:
        """Stage of a name, from the folder where it is finished."""
        if self.folder.has(name):
            return self.folder.read_stage(name)
        self.echo(name)
        stage = self.folder.keep_stage(name, make())
        for line in stage.values["report"]:
            self.echo(f"  {line}")
        return stage

    def _rng(self, name: str) -> np.random.Generator:
        return Evaluation(self.study, self.config, self.seed).rng(name)

    def _designed(self, use: str) -> Stage:
        """Co-design of LQG from the start of the study, and from there of a policy of outputs."""
        problem, rng = self.study.problems[use], self._rng(f"design {use}")
        lqg = codesign(problem, method=Nested("lqg", starts=1), design=self.study.p0, rng=rng, progress=self.progress)
        method = Learned(config=replace(self.config.codesign, starts=1), history=self.study.history)
        learned: Any = codesign(problem, method=method, design=lqg.design, rng=rng, progress=self.progress)
        report = [f"{one.method}: {one.described}, {one.status.value}" for one in (lqg, learned)]
        return Stage(
            {"report": report}, {"LQG": np.asarray(lqg.design), "design": learned.design}, {"agent": learned.agent}
        )

    def _controllers(self, use: str, p: Array, found: Stage) -> Iterator[tuple[str, Controller]]:
        """Controllers that a design has in a use, by name."""
        problem = self.study.problems[use]
        yield "LQG", observed(problem, saturated_lqr(problem, p), p)
        yield "MPC", observed(problem, linear_mpc(problem, p), p)
        yield "learned", History(LearnedPolicy(found.networks["agent"], p), self.study.history)

    def _tried(self, use: str, found: Mapping[str, Stage]) -> Trial:
        """All designs in one use, under disturbances that no co-design met."""
        study, own, rng = self.study, found[use], self._rng(f"trial {use}")
        self.echo(f"trial {use}")
        runs, steps = self.config.held_out_runs, self.config.held_out_steps
        w = study.real.fresh[use].sample(runs, steps, rng)
        output = Measurement(study.real.plant, noise=study.noise)
        x0 = np.tile(study.real.x0, (runs, 1))
        scenario = Scenario(study.real.plant, x0, w, output=output, seed=int(rng.integers(2**31)))
        designs = {START: study.p0} | {name: stage.arrays["design"] for name, stage in found.items()}
        driven = {
            (name, kind): scenario.run(controller, design=p)
            for name, p in designs.items() for kind, controller in self._controllers(use, p, own)
        }  # fmt: skip
        q = own.arrays["LQG"]
        driven["LQG's own", "LQG"] = scenario.run(dict(self._controllers(use, q, own))["LQG"], design=q)
        values = {place: metrics_of(study.judged, run) for place, run in driven.items()}
        pairs = questions(use, list(found))
        changes = {name: metric_changes(study.judged, *(driven[one] for one in pair)) for name, pair in pairs.items()}
        return Trial(values, changes)


def questions(use: str, uses: list[str]) -> dict[str, tuple[Place, Place]]:
    """Places to compare in a use, before and after, by what changes between them."""
    others = [name for name in uses if name != use]
    return {
        "design, with LQG": ((START, "LQG"), ("LQG's own", "LQG")),
        "policy for LQG": ((use, "LQG"), (use, "learned")),
        "design and policy": ((START, "LQG"), (use, "learned")),
        "MPC for LQG": ((use, "LQG"), (use, "MPC")),
        **{f"own design for {other}'s": ((other, "LQG"), (use, "LQG")) for other in others},
    }
