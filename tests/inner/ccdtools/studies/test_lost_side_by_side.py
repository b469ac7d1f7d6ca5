"""Runs that are lost where designs stand side by side."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant
from ccdtools.co_design import EpisodeEnv
from ccdtools.studies import RunFolder, SideBySide, configuration
from ccdtools.studies.report.side_by_side_page import write_side_by_side
from ccdtools.studies.side_by_side_run import SideBySideRun
from ccdtools.studies.stage_storage import Stage


def falling():
    """Unstable plant whose input holds it in a calm, and loses it in a storm."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, ca.vertcat(x[1], 9 * x[0] - p * x[1] + u + w), DesignSpace(["c"], [0.1], [2.0]), dt=0.1,
                  outputs=x)  # fmt: skip
    uses = {"calm": Gaussian([0.01]), "storm": Gaussian([1e6])}
    return SideBySide(
        name="falling", title="Falling", plant=plant, X=(-1, 1), U=(-3, 3), disturbance=uses["calm"], x0=[0.01, 0.0],
        objective=QuadraticObjective(np.eye(2), [[0.1]]), steps=30, p0=[1.0], uses=uses, noise=[1e-3, 1e-3], history=2,
        real=RealPlant(plant, uses["calm"], [0.01, 0.0], 10, 60, held_out=uses), limit_tolerance="off",
        metrics=lambda run: {"square": float(np.mean(run.states**2))},
    )  # fmt: skip


class Undesigned(SideBySideRun):
    """Run whose designs are given and whose policies are new."""

    def _designed(self, use):
        problem = self.study.problems[use]
        env = EpisodeEnv(problem, [1.5], rng=np.random.default_rng(0), output=problem.measurement, history=2)
        return Stage({"report": [f"{use}: c < 2"]}, {"design": np.array([1.5])}, {"agent": env.agent()})


@pytest.mark.check
def test_lost_runs_stand_beside_the_metrics_of_the_others(tmp_path):
    study = falling()
    folder = RunFolder.create(tmp_path / "run")
    short = replace(configuration(study, quick=True), held_out_steps=5)
    run = Undesigned(study, short, folder, seed=0, echo=lambda line: None)
    found = run.run()
    text, page = write_side_by_side(study, *found, folder, quick=True)
    head, *lines = text.split("\n\n")[2].splitlines()
    assert head.endswith("lost runs")
    lost = {tuple(line.split()[:3]): int(line.split()[-1]) for line in lines}
    assert lost["calm", "start", "LQG"] == 0
    assert lost["storm", "start", "LQG"] > 20
    assert "c &lt; 2" in page.read_text()
