"""What test_plant.py claims, seen from inside."""

import numpy as np

from ccdtools.studies.cases.suspension import quarter_car

START = np.array([27692.0, 1906.5])


def test_the_nonlinear_quarter_car_without_hardening_is_the_linear_one(rng):
    x, u, w = rng.standard_normal((9, 4)), rng.standard_normal((9, 1)), rng.standard_normal((9, 1))
    soft = quarter_car(nonlinear=True, hardening=0.0).stepper(START, batch=9)(x, u, w)
    np.testing.assert_allclose(soft, quarter_car().stepper(START, batch=9)(x, u, w), rtol=1e-12)
