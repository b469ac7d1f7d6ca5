"""The optima of every study, computed and written: ``python -m gallery.oracle.compute [STUDY ...]``."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import Any

import numpy as np

from gallery.oracle.cost import highest_linear_return, linear_return, saturated_return
from gallery.oracle.dynamic_programming import clipped_optimum
from gallery.oracle.optimum import Landscape, landscape
from gallery.oracle.receding_horizon import limited_return
from gallery.oracle.statement import Array, Statement
from gallery.oracle.truth import affine, best_feedback, feedback_return, truth
from gallery.reference import CLIPPED, LIMITED, OPTIMA, STUDIES, statement

CLIPPED_RUNS = 20_000
SEARCH_RUNS = 1500
LIMITED_RUNS = 100
LIMITED_POINTS = 11
CLIPPED_POINTS = 17
STAGES = 10
SEED = 5


def computed(study: str) -> dict[str, Any]:
    """Everything that is kept of one study."""
    s = statement(study)
    if study in CLIPPED:
        method = "best clipped linear feedback by search, 20 000 runs"
        found, feedback = _by_policy_search(s)
    elif study in LIMITED:
        method = "MPC of 20 steps with OSQP, 100 runs"
        found = _by_receding_horizon(s)
    else:
        method = "exact second moments of the LQR loop"
        found = landscape(s, lambda p: linear_return(s, p))
    best = found.designs[0]
    kept: dict[str, Any] = {
        "method": method, "designs": found.designs.tolist(), "returns": found.returns.tolist(),
        "worst_corner": found.worst_corner.tolist(), "worst_return": found.worst_return,
        "lqr": _lqr(s, best, study), "unlimited_bound": highest_linear_return(s, best),
    }  # fmt: skip
    if study in CLIPPED:
        kept["feedback"] = feedback
        kept |= _by_dynamic_programming(s, best)
    if s.real is not None:
        real = truth(s, best)
        kept["truth"] = {
            "deployed": real.deployed, "policy_alone": real.policy_alone, "design": real.design.tolist(),
            "both": real.both, "worth_percent": 100 * (real.both - real.deployed) / abs(real.deployed),
        }  # fmt: skip
    return kept


def _lqr(s: Statement, p: Array, study: str) -> float:
    """Return of the clipped LQR at a design on the model."""
    if study in CLIPPED + LIMITED:
        return saturated_return(s, p, s.disturbance(CLIPPED_RUNS, SEED))
    return linear_return(s, p)


def _by_dynamic_programming(s: Statement, p: Array) -> dict[str, Any]:
    """Returns of the policy of dynamic programming, and of the best one that acts at all times as it does at one."""
    optimum = clipped_optimum(s, p)
    w = s.disturbance(CLIPPED_RUNS, SEED)
    held = [float(optimum.stationary_returns(w, step).mean()) for step in range(0, s.steps, STAGES)]
    return {"by_time": float(optimum.returns(w).mean()), "stationary": max(held)}


def _by_policy_search(s: Statement) -> tuple[Landscape, dict[str, Any]]:
    """The best clipped linear feedback with its design, where inputs saturate; the corner worst for clipped LQR."""
    model = replace(s, real=None)
    few = s.disturbance(SEARCH_RUNS, SEED + 1)
    grid = [s.from_unit(np.array([v])) for v in np.linspace(0, 1, CLIPPED_POINTS)]
    first = max(grid, key=lambda p: saturated_return(s, p, few))
    _, design, feedback = best_feedback(model, first, few)
    best = feedback_return(model, design, feedback, s.disturbance(CLIPPED_RUNS, SEED))
    corners = [saturated_return(s, p, few) for p in s.corners()]
    worst = int(np.argmin(corners))
    K, offset = affine(model, design, feedback)
    optimum = Landscape(design[None], np.array([best]), s.corners()[worst], corners[worst])
    return optimum, {"K": K.tolist(), "offset": offset.tolist()}


def _by_receding_horizon(s: Statement) -> Landscape:
    """The landscape of MPC where a state limit binds."""
    w = s.disturbance(LIMITED_RUNS, SEED)
    return landscape(s, lambda p: limited_return(s, p, w)[0], points=LIMITED_POINTS)


def main(studies: list[str]) -> None:
    """Compute and write the optima, study after study."""
    for study in studies:
        found = computed(study)
        kept = (json.loads(OPTIMA.read_text()) if OPTIMA.is_file() else {}) | {study: found}
        ordered = {name: kept[name] for name in STUDIES if name in kept}
        OPTIMA.write_text(json.dumps(ordered, indent=1) + "\n")
        print(study, json.dumps(kept[study]), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or list(STUDIES))
