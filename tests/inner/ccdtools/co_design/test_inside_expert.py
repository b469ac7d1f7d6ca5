"""What test_expert.py claims, seen from inside."""

import numpy as np

from ccdtools.co_design.budgets import CANDIDATES_PER_START, VISITS


def test_closed_loop_states_join_the_data_near_the_origin(study, expert_data):
    data, nx = expert_data(study), study.model.nx
    n = round(data.acceptance * 150)
    assert n < len(data.inputs) <= (n + 150 // CANDIDATES_PER_START + 1) * len(VISITS)
    size = np.abs(data.inputs[:, :nx] / study.problem().state_scale).max(axis=1)
    assert np.median(size[-n:]) < 0.5 * np.median(size[:n])
