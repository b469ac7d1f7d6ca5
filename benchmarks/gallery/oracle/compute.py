"""The optima of every study, computed and written: ``python -m gallery.oracle.compute [STUDY ...]``."""

from __future__ import annotations

import json
import sys
from functools import cache
from typing import Any

import numpy as np

from gallery.oracle.cost import highest_linear_return, linear_return, saturated_return
from gallery.oracle.dynamic_programming import clipped_optimum
from gallery.oracle.optimum import Landscape, landscape
from gallery.oracle.receding_horizon import limited_return
from gallery.oracle.statement import Array, Statement
from gallery.oracle.truth import truth
from gallery.reference import CLIPPED, LIMITED, OPTIMA, STUDIES, statement

CLIPPED_RUNS = 8000
SEARCH_RUNS = 1500
LIMITED_RUNS = 100
LIMITED_POINTS = 11
CLIPPED_POINTS = 9
SEED = 5


def computed(study: str) -> dict[str, Any]:
    """Everything that is kept of one study."""
    s = statement(study)
    if study in CLIPPED:
        method = "dynamic programming on a grid, 8000 runs"
        found = _by_dynamic_programming(s)
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


def _by_dynamic_programming(s: Statement) -> Landscape:
    """The landscape of the best policy where inputs saturate; its worst corner is that of the clipped LQR."""
    w = s.disturbance(CLIPPED_RUNS, SEED)
    few = w[:SEARCH_RUNS]

    @cache
    def value(*p: float) -> float:
        return float(clipped_optimum(s, np.array(p)).returns(few).mean())

    found = landscape(s, lambda p: value(*np.round(p, 3)), points=CLIPPED_POINTS)
    best = found.designs[:1]  # where runs are lost, the cost beyond the grid is not known, and no other optimum is one
    returns = clipped_optimum(s, best[0]).returns(w).mean(keepdims=True)
    corners = [saturated_return(s, p, few) for p in s.corners()]
    worst = int(np.argmin(corners))
    return Landscape(best, returns, s.corners()[worst], corners[worst])


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
