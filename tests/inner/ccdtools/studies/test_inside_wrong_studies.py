"""What test_wrong_studies.py claims, seen from inside."""

import pytest

from ccdtools import InputError
from ccdtools.studies import load_study
from ccdtools.studies.loading import load_with_sources

HEAD = """
import casadi as ca
import numpy as np
from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, Recorded
from ccdtools.studies import RealPlant, Study
from invariant_sets import Polytope

def spring(dt=0.1, names=("k",), nx=2, nu=1, upper=4.0, **labels):
    x, u, w, p = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("w"), ca.SX.sym("p")
    rate = -p * x[0] + ca.sum1(u) + w
    return Plant(x, u, w, p, ca.vertcat(x[1:], rate), DesignSpace(names, [1], [upper]), dt=dt, **labels)

class Silent:
    def sample(self):
        return 0

class Flat:
    def sample(self, runs, steps, rng):
        return np.zeros(steps)

def study_with(**changes):
    fields = dict(
        name="spring", title="Spring", plant=spring(), X=Polytope.from_bounds([-1, -2], [1, 2]),
        U=Polytope.from_bounds([-1], [1]), objective=QuadraticObjective(np.eye(2), [[0.1]]),
        disturbance=Gaussian([0.1]), x0=[0.5, 0], p0=[2],
    )
    return Study(**(fields | changes))

def real_with(**changes):
    fields = dict(plant=spring(), disturbance=Gaussian([0.1]), x0=[0, 0], runs=10, steps=60)
    return RealPlant(**(fields | changes))
"""


def test_a_study_imports_its_neighbour_and_names_its_line(tmp_path):
    (tmp_path / "helper_beside.py").write_text("VALUE = 2\n")
    path = tmp_path / "mine.py"
    path.write_text(HEAD + "\nimport helper_beside\nstudy = study_with(p0=[helper_beside.VALUE])\n")
    study, sources = load_with_sources(str(path))
    assert study.p0.tolist() == [2.0]
    assert set(sources) == {"mine.py", "helper_beside.py"}
    (tmp_path / "helper_beside.py").write_text("VALUE = 3\n")
    changed, sources_then = load_with_sources(str(path))  # read again: nothing of the first loading is left behind
    assert changed.p0.tolist() == [3.0]
    assert sources_then["helper_beside.py"] != sources["helper_beside.py"]
    (tmp_path / "helper_beside.py").write_text("\n\nVALUE = 1 / 0\n")
    with pytest.raises(InputError, match=r"helper_beside.py:3, which stops with ZeroDivisionError"):
        load_study(str(path))
