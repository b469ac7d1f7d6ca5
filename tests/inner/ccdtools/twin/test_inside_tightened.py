"""The price of a guarantee where sets were not found in time."""

import numpy as np

from ccdtools import deploy, load_study, saturated_lqr
from ccdtools.twin import robust_mpc, tightened


def test_sets_that_were_not_found_in_time_are_not_said_to_be_empty(monkeypatch):
    study, p = load_study("illustrative"), np.array([3.0])
    problem, real, rng = study.problem(), study.real, np.random.default_rng(0)
    log = deploy(real.plant, saturated_lqr(problem, p), p, real.disturbance.sample(60, 100, rng), x0=study.x0)
    monkeypatch.setattr(tightened, "SET_SECONDS", 1e-6)
    found = robust_mpc(problem, p, log, rng=rng, level=0.9, runs=5)
    assert "volume left of X_fea as far as it was found (TIME_LIMIT): " in str(found)
    assert 0 < found.volume_left <= 1
    (state,) = found.robust_set.set.sample(1, rng=rng)
    assert found.controller.solve(state).status.name == "SOLVED"
