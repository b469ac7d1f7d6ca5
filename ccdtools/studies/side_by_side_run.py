"""Run of one design per use: co-designs, then trials of all designs in all uses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.design_controllers import linear_mpc, saturated_lqr
from ccdtools.co_design.measured import observed
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.methods.nested import Nested
from ccdtools.comparison.metrics import MetricChange, metric_changes, metrics_of
from ccdtools.controllers.history import History
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.estimation.measurement import Measurement
from ccdtools.scenario import Scenario
from ccdtools.studies.budgets import TRIAL_RUNS
from ccdtools.studies.presets import StudyConfig
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.side_by_side import START, SideBySide
from ccdtools.studies.stage_storage import Stage
from ccdtools.trajectory import Trajectory

Place = tuple[str, str]  # names of a design and of a controller
# Metrics in one use and lost runs, by design and controller, and changes by what changes.
Trial = tuple[dict[Place, tuple[dict[str, float], int]], dict[str, tuple[MetricChange, ...]]]


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
        for use in self.study.uses:
            if not self.folder.has(f"design-{use}"):
                self.echo(f"Design for {use}")
                self.folder.keep_stage(f"design-{use}", self._designed(use))
        found = {use: self.folder.read_stage(f"design-{use}") for use in self.study.uses}
        return found, {use: self._tried(use, found) for use in self.study.uses}

    def _designed(self, use: str) -> Stage:
        """Co-design of LQG, and from there of a policy of outputs."""
        problem = self.study.problems[use]
        rng = np.random.default_rng([self.seed, *use.encode()])
        lqg = codesign(problem, method=Nested("lqg", starts=1), design=self.study.p0, rng=rng, progress=self.progress)
        method = Learned(config=replace(self.config.codesign, starts=1), history=self.study.history)
        found: Any = codesign(problem, method=method, design=lqg.design, rng=rng, progress=self.progress)
        report = [f"{use}, {one.method}: {one.described}; {one.status.value}" for one in (lqg, found)]
        return Stage({"report": report}, {"design": found.design}, {"agent": found.agent})

    def _tried(self, use: str, found: Mapping[str, Stage]) -> Trial:
        """All designs in one use, under disturbances that no co-design met."""
        self.echo(f"Trial of all designs by {use}")
        study = self.study
        problem = study.problems[use]
        agent = found[use].networks["agent"]
        own = (use, "LQG")
        rng = np.random.default_rng([self.seed, 1, *use.encode()])
        runs = TRIAL_RUNS // 5 if self.config.quick else TRIAL_RUNS
        scenario = Scenario(
            study.real.plant, np.tile(study.real.x0, (runs, 1)),
            study.real.fresh[use].sample(runs, self.config.held_out_steps, rng),
            output=Measurement(study.real.plant, noise=study.noise), seed=int(rng.integers(2**31)),
        )  # fmt: skip
        driven: dict[Place, Trajectory] = {}
        for name, p in {START: study.p0, **{one: stage.arrays["design"] for one, stage in found.items()}}.items():
            controllers = {"LQG": observed(problem, saturated_lqr(problem, p), p),
                           "MPC": observed(problem, linear_mpc(problem, p), p),
                           "learned": History(LearnedPolicy(agent, p), study.history)}  # fmt: skip
            for kind, one in controllers.items():
                driven[name, kind] = scenario.run(one, design=p, limit=problem.limit)
        pairs: dict[str, tuple[Place, Place]] = {
            "design": ((START, "LQG"), own), "policy, for LQG": (own, (use, "learned")),
            "design and policy": ((START, "LQG"), (use, "learned")), "MPC, for LQG": (own, (use, "MPC")),
        } | {f"design, for that of {other}": ((other, "LQG"), own) for other in found if other != use}  # fmt: skip
        assert study.metrics is not None
        changes = {what: metric_changes(study.metrics, driven[one], driven[two]) for what, (one, two) in pairs.items()}
        values = {at: (metrics_of(study.metrics, run), int(run.diverged.sum())) for at, run in driven.items()}
        return values, changes
