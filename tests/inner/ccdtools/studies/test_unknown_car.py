"""The semi-active car with unknown entries."""

import numpy as np

from ccdtools.studies import load_study
from ccdtools.studies.cases.semi_active_damper import unknown_car

DESIGN = np.array([20000.0, 3000.0])


def test_the_car_with_unknown_entries_is_the_real_one_at_its_values_and_senses_what_moves_it():
    real, rng = load_study("semi_active_damper").real.plant, np.random.default_rng(0)
    unknown = unknown_car()
    for _ in range(5):
        x, u, w = rng.normal(size=6) * [0.01, 1, 0.08, 1, 1, 30], rng.uniform(-1, 1, 1), rng.normal(size=1)
        rates = np.array(real.right_hand_side(x, u, w, DESIGN)).ravel()
        entries = np.array([*DESIGN, 100.0, 0.4, 40.0, 4e5])
        np.testing.assert_allclose(np.array(unknown.right_hand_side(x, u, w, entries)).ravel(), rates, rtol=1e-9)
        for plant, p in ((real, DESIGN), (unknown, entries)):
            np.testing.assert_allclose(plant.observe(x, u, p), [rates[3], rates[1], x[2]], rtol=1e-9)
