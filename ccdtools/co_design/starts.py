"""Where a co-design starts from, and the race of the starts."""

from __future__ import annotations

import copy

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.ascent import Ascent
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.episodes import fewer_runs
from ccdtools.co_design.landscape import COMBINATIONS, combinations, valleys
from ccdtools.co_design.result import Valley
from ccdtools.co_design.task import Task
from ccdtools.plants.design_space import DesignSpace
from ccdtools.progress import bar
from ccdtools.statistics import paired_difference
from learning.networks import ActorCritic

SAME_PLACE = 0.02  # of the box: two starts this close are one
HOPEFUL = 0.2  # of the best valley's return, without the cost of its design: one worse by more is not climbed from
FEW = 4  # starts with the best of many combinations of whole numbers
MAPPED = 3  # parameters, up to which a second valley of the landscape is climbed from by default


def chosen_valleys(task: Task, design: Array, rng: np.random.Generator) -> tuple[Valley, ...]:
    """The valleys of the landscape; none where the design is frozen or one start is asked for."""
    if not task.designing or task.config.starts == 1:
        return ()
    return valleys(task.problem, design, rng=rng)


def start_designs(task: Task, design: Array, found: tuple[Valley, ...]) -> list[Array]:
    """The given design, and the bottoms of the best valleys that lie elsewhere."""
    space = task.problem.design
    most = task.config.starts or _by_default(space)
    starts = [np.asarray(design, dtype=float)]
    for valley in found:
        best = found[0].lqr_return
        hopeful = valley.lqr_return >= best - HOPEFUL * task.problem.made_by_control(best, found[0].design)
        elsewhere = all(_apart(space, space.to_unit(valley.design), space.to_unit(one)) for one in starts)
        if len(starts) < most and hopeful and elsewhere:
            starts.append(valley.design)
    return starts


def _by_default(space: DesignSpace) -> int:
    """Starts, unless a number is asked for: of a few combinations of whole numbers all."""
    if space.integer:
        number = combinations(space)
        return 1 + int(number) if number <= COMBINATIONS else FEW
    return 3 if space.free.sum() <= MAPPED else 2


def race(
    task: Task, agents: list[ActorCritic], starts: list[Array], rng: np.random.Generator, *, progress: bool
) -> list[Ascent]:
    """The ascents of every agent from every start, the best first.

    They climb a block at a time. One is given up when it has come to the place of a better one, loses runs that a
    better one keeps, or is behind it by more than its last block gained and than chance explains. Each draws from a
    generator of its own, and all are scored on the same scenarios.
    """
    config = task.config
    evaluation = scenario_tensors(task.judge, fewer_runs(config.evaluation_runs, task.judge.steps), rng)
    ascents = [
        Ascent(task, copy.deepcopy(agent), design, np.random.default_rng(rng.integers(2**63, size=4)), evaluation)
        for agent in agents
        for design in starts
    ]
    climbing = list(ascents)
    with bar(label="co-design", total=config.iterations, progress=progress) as shown:
        while climbing:
            for ascent in climbing:
                ascent.block(shown)
            first = leader(ascents)
            climbing = [one for one in climbing if not one.ended and (one is first or _hopeful(one, first))]
    first = leader(ascents)
    return [first, *(one for one in ascents if one is not first)]


def leader(ascents: list[Ascent]) -> Ascent:
    """The ascent with the best iterate."""
    first = ascents[0]
    for one in ascents[1:]:
        first = one if one.best.beats(first.best) else first
    return first


def _hopeful(one: Ascent, first: Ascent) -> bool:
    """Whether an ascent may still overtake the first one from elsewhere, and loses no run that that one keeps."""
    if one.best.lost > first.best.lost:
        return False
    if not _apart(one.task.problem.design, one.best.v.numpy(), first.best.v.numpy()):
        return False
    behind = paired_difference(first.best.returns, one.best.returns)
    gained = one.gain.mean if np.isfinite(one.gain.mean) else 0.0
    return not (behind.ci95[0] > 0 and behind.mean > gained)


def _apart(space: DesignSpace, v: Array, other: Array) -> bool:
    """Whether two points of the unit box are different places, as other whole numbers always are."""
    away = np.abs(v - other)
    return bool(away.max() > SAME_PLACE or (away * space.allowed.width)[space.whole].max(initial=0.0) > 0.5)
