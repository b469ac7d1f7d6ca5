"""Figures of the paper, drawn from the first seed of a reproduction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.co_design.expert import feasible_sets
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.figure_style import Figure
from ccdtools.scenario import Scenario
from ccdtools.studies.report.finished_run import ReportFigure
from ccdtools.studies.reproduce.paper_figures import FIRST, SECOND, SETS_AT, SIGNALS, STARTS
from ccdtools.studies.reproduce.places import COMMON, STRETCHES
from ccdtools.studies.stage_storage import Stage
from ccdtools.twin.residuals import residuals
from invariant_sets import plot_polytope

if TYPE_CHECKING:
    from ccdtools.studies.reproduce.tasks import Task

PAPERS = "#7F7F7F"  # colour of what the paper prints
SHOWN = 150  # samples of the logged errors that are drawn


def drawn_figures(loops: dict[str, list[Task]], presets: dict[str, list[Task]], *, quick: bool) -> list[ReportFigure]:
    """Every figure, from the tasks of both case studies."""
    one, other = loops["illustrative"], loops["suspension"]
    with style.styled():
        drawn = {
            "sets": ("X_fea(p) of the illustrative example (figure Xfea).", _sets(one[0], quick)),
            "first": ("First co-designs of every seed: by default (colours), by the preset paper (grey), and the "
                      "paper's design (dotted).", _courses(loops, presets, FIRST, "first", quick)),
            "policy": ("Mean of the policy at the paper's p₁ and at our design (figure policy1_numerical), with "
                       "X_fea.", _policy(one[0], quick)),
            "trajectories": ("States before and after the first co-design, 95 % of the runs.",
                             _before_and_after([one[0], other[0]], quick)),
            "quantiles": ("One-step errors and learned quantiles at the end of the first deployment.",
                          _quantiles([one[0], other[0]], quick)),
            "second": ("Second co-designs of every seed, and the paper's design (dotted).",
                       _courses(loops, {}, SECOND, "second", quick)),
            "starts": ("Deployed generations from the three named starts on the real plant, on one typical stretch of "
                       "road (figure susp_traj_trial); σ_ss is of the shaded half.", _starts(other[0], quick)),
        }  # fmt: skip
    return [ReportFigure(name, name.capitalize(), *found) for name, found in drawn.items()]


def _law(stage: Stage, design: Array) -> Controller:
    return LearnedPolicy(stage.networks["agent"], design)


def _sets(task: Task, quick: bool) -> Figure:
    figure = style.blank(11, 3, quick=quick)
    family = feasible_sets(task.problem)
    for ax, p in zip(figure.subplots(1, len(SETS_AT), sharey=True), SETS_AT):
        found = family.at(np.array([p]))
        plot_polytope(task.problem.state_limits(np.array([p])), ax=ax, facecolor="none", edgecolor="k", lw=1)
        plot_polytope(found, ax=ax, facecolor="#F4C2D0", edgecolor="k", lw=1)
        ax.set(title=f"p = {p:g}, area {found.volume:.1f}", xlabel="x₁")
        ax.autoscale_view()
    figure.axes[0].set_ylabel("x₂")
    return figure


def _courses(
    loops: dict[str, list[Task]], presets: dict[str, list[Task]], papers: dict[str, tuple[float, ...]], part: str,
    quick: bool,
) -> Figure:  # fmt: skip
    figure = style.blank(11, 5.4, quick=quick)
    rows = figure.subplots(len(loops), 3, squeeze=False)
    for axes, (case, tasks) in zip(rows, loops.items()):
        names = tasks[0].problem.design.names
        for kept, colour in ((tasks, None), (presets.get(case, []), PAPERS)):
            for task in kept:
                arrays = task.finished()[part].arrays
                iterations = arrays["history_iteration"] / max(arrays["history_iteration"][-1], 1)
                own = colour or style.generation_colour(task.seed)
                for ax, values in zip(axes, (arrays["history_model_return"], *arrays["history_design"].T)):
                    ax.plot(iterations, values, color=own, lw=1.2)
        for ax, name, paper in zip(axes[1:], names, papers[case]):
            ax.axhline(paper, color=PAPERS, ls=":")
            ax.set_ylabel(name)
        axes[0].set(ylabel="return", title=case)
        for ax in axes[1 + len(names) :]:
            ax.set_axis_off()
        axes[0].set_xlabel("part of the iterations")
    return figure


def _policy(task: Task, quick: bool) -> Figure:
    figure = style.blank(8, 3.2, quick=quick)
    first = task.finished()["first"]
    family = feasible_sets(task.problem)
    for ax, p in zip(figure.subplots(1, 2, sharey=True), (np.array(FIRST["illustrative"]), first.arrays["design"])):
        X = task.problem.state_limits(p).bounding_box()
        x = np.linspace(*X, 101).T
        states = np.stack(np.meshgrid(*x), axis=-1).reshape(-1, 2)
        mesh = style.without_grid(ax).pcolormesh(*x, _law(first, p)(states).reshape(101, 101), cmap="RdBu_r")
        plot_polytope(family.at(p), ax=ax, facecolor="none", edgecolor="k", lw=1.2)
        ax.set(title=task.problem.design.describe(p), xlabel="x₁", xlim=x[0][[0, -1]], ylim=x[1][[0, -1]])
        figure.colorbar(mesh, ax=ax, label="u")
    figure.axes[0].set_ylabel("x₂")
    return figure


def _before_and_after(tasks: Sequence[Task], quick: bool) -> Figure:
    figure = style.blank(11, 7.5, quick=quick)
    columns = figure.subplots(4, len(tasks), squeeze=False).T
    for column, task in zip(columns, tasks):
        stages, study = task.finished(), task.study
        x0, w = task.problem.scenarios.sample(task.budget.runs, study.steps, np.random.default_rng(COMMON))
        scenario = Scenario(study.model, x0, w)
        laws = (("before", stages["start"], np.asarray(study.p0)), ("after", stages["first"], None))
        for generation, (label, stage, design) in enumerate(laws):
            p = stage.arrays["design"] if design is None else design
            run = scenario.run(_law(stage, p), design=p, limit=task.problem.limit)
            low, middle, high = np.quantile(run.states, (0.025, 0.5, 0.975), axis=0)
            colour = style.generation_colour(generation)
            for i, ax in enumerate(column[: study.plant.nx]):
                ax.fill_between(run.time, low[:, i], high[:, i], color=colour, alpha=0.2, lw=0)
                ax.plot(run.time, middle[:, i], color=colour, label=label)
                ax.set_ylabel(style.label(study.plant.state_names[i]))
        column[0].set_title(study.name)
        column[study.plant.nx - 1].set_xlabel("time [s]" if study.plant.continuous else "sample")
        for ax in column[study.plant.nx :]:
            ax.set_axis_off()
    columns[0][0].legend()
    return figure


def _quantiles(tasks: Sequence[Task], quick: bool) -> Figure:
    figure = style.blank(11, 7.5, quick=quick)
    columns = figure.subplots(4, len(tasks), squeeze=False).T
    for column, task in zip(columns, tasks):
        stages = task.finished()
        log = residuals(task.study.model, task.log(stages["deployment-1"]))
        end = log.part(slice(-1, None), slice(max(log.steps - SHOWN, 0), None))
        network: Any = stages["twin"].networks["quantiles"]
        predicted = network.predict(np.hstack([end.e[0], end.x[0], end.u[0]]))
        for i, ax in enumerate(column[: task.study.plant.nx]):
            time = np.arange(len(predicted))
            ax.fill_between(time, predicted[:, 0, i], predicted[:, -1, i], color="#D55E00", alpha=0.25, lw=0)
            ax.plot(time, predicted[:, predicted.shape[1] // 2, i], color="#D55E00", label="median, 10 to 90 %")
            ax.plot(time, end.e_next[0, :, i], "k.-", lw=0.4, ms=3, label="logged error")
            ax.set_ylabel(style.label(f"error of {task.study.plant.state_names[i]}"))
        column[0].set_title(task.case)
        for ax in column[task.study.plant.nx :]:
            ax.set_axis_off()
    columns[0][0].legend()
    return figure


def _starts(task: Task, quick: bool) -> Figure:
    figure = style.blank(11, 6, quick=quick)
    stages, study = task.finished(), task.study
    road = study.real.disturbance.sample(STRETCHES, study.steps, np.random.default_rng(COMMON))
    typical = np.argsort((road**2).sum(axis=(1, 2)))[STRETCHES // 2]
    w = road[[typical] * len(STARTS)]
    grid = figure.subplots(len(SIGNALS), len(STARTS), sharex=True, sharey="row")

    for generation in (1, 2):
        stage = stages[f"deployment-{generation}"]
        run = Scenario(study.real.plant, STARTS, w).run(
            _law(stage, stage.arrays["design"]), design=stage.arrays["design"]
        )
        signals = np.concatenate([run.states[:, 1:, 2:4], run.inputs], axis=2)
        for i, column in enumerate(grid.T):
            for k, ax in enumerate(column):
                colour = style.generation_colour(generation)
                ax.plot(run.time[1:], signals[i, :, k], color=colour, lw=1.3 if generation == 1 else 0.8,
                        ls="-" if generation == 1 else "--", label=f"generation {generation}")  # fmt: skip
    for i, column in enumerate(grid.T):
        column[0].set_title(f"start {i + 1}")
        column[-1].set_xlabel("time [s]")
        for ax in column:
            ax.axvspan(2.5, 5.0, color="#EEEEEE", zorder=0)
    for name, ax in zip(SIGNALS, grid[:, 0]):
        ax.set_ylabel(name)
    grid[0, 0].legend()
    return figure
