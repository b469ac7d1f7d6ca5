"""What test_refinement.py claims, seen from inside."""

from itertools import count

import pytest
from classical_problems import CLASSICAL

from mpc.optimal_control import OptimalControlStatus, Radau, build, refine, refinement, solve

MESHES = 3


@pytest.mark.long
def test_time_limit_is_of_all_meshes_together_and_the_best_is_kept(monkeypatch):
    phase = CLASSICAL["catalyst mixing"].phase
    asked = count()
    over = type("Over", (refinement.Clock,), {"late": property(lambda clock: next(asked) >= MESHES)})
    monkeypatch.setattr(refinement, "Clock", over)
    late = refine(phase, tolerance=1e-7, time_limit=850)
    assert late.status is OptimalControlStatus.STOPPED
    assert "the time was up" in late.advice
    first = solve(build(phase, Radau(3), 10))
    assert len(late.times) > len(first.times)
    assert 1e-7 < late.errors[0].max() < first.errors[0].max()
    assert late.residuals.worst < 1e-5
