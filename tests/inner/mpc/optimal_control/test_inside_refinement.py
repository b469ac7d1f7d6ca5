"""What test_refinement.py claims, seen from inside."""

from itertools import count
from types import SimpleNamespace

import pytest
from classical_problems import CLASSICAL

from mpc.optimal_control import OptimalControlStatus, Radau, build, refine, refinement, solve


@pytest.mark.long
def test_time_limit_is_of_all_meshes_together_and_the_best_is_kept(monkeypatch):
    phase = CLASSICAL["catalyst mixing"].phase
    seconds = count()
    monkeypatch.setattr(refinement, "time", SimpleNamespace(perf_counter=lambda: 100.0 * next(seconds)))
    late = refine(phase, tolerance=1e-7, time_limit=850)  # of a clock that goes on by 100 s whenever it is read
    assert late.status is OptimalControlStatus.STOPPED
    assert "the time was up" in late.advice
    first = solve(build(phase, Radau(3), 10))
    assert len(late.times) > len(first.times)
    assert 1e-7 < late.errors[0].max() < first.errors[0].max()
    assert late.residuals.worst < 1e-5
