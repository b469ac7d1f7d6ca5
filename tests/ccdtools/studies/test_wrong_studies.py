"""Wrong studies are refused when they are declared, in one line with the place, the field, got and expected."""

import numpy as np
import pytest

from ccdtools import DesignSpace, Gaussian, InputError, Plant, QuadraticObjective, Recorded
from ccdtools.studies import RealPlant, Study, load_study
from invariant_sets import Polytope

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

WRONG = [
    # Kinds
    ("study_with(name='')", "name: got ''"),
    ("study_with(name=3)", "name: got 3"),
    ("study_with(title='two\\nlines')", "title: got"),
    ("study_with(plant=None)", "plant: got nothing, expected a ccdtools.Plant"),
    ("study_with(plant=Plant)", "plant: got the class Plant"),
    ("study_with(X='box')", "X: got str, expected a Polytope or bounds (lower, upper)"),
    ("study_with(X=([-1, -2, -3], [1, 2, 3]))", "X[0]: got shape (3,), expected a number or 2 numbers"),
    ("study_with(U=(1, -1))", "U[0]: got 1 above upper, -1, at index 0, expected lower <= upper"),
    ("study_with(U=(False, True))", "U[0]: got False, expected an array of real numbers, not True or False"),
    ("study_with(objective=np.eye(2))", "objective: got"),
    ("study_with(disturbance=0.1)", "disturbance: got 0.1, expected an object with sample(runs, steps, rng)"),
    ("study_with(disturbance=Gaussian)", "disturbance: got"),
    ("study_with(real='nonlinear')", "real: got 'nonlinear'"),
    ("study_with(real=spring())", "real: got a Plant, expected a RealPlant"),
    ("study_with(metrics='comfort')", "metrics: got 'comfort', expected a function that takes a Trajectory"),
    ("study_with(metrics=lambda run: 1.0)", "metrics: got 1.0, expected a function"),
    ("study_with(metrics=lambda run: {'': 1.0})", "metrics: got the name '', expected names of one line"),
    ("study_with(metrics=lambda run: {'rms': run.states})", "for rms, expected a number each"),
    ("study_with(metrics=lambda run: {'rms': run.speeds})", "metrics: got a function that stops with AttributeError"),
    ("study_with(steps=0)", "steps: got 0, expected a whole number, at least 1"),
    ("study_with(steps=2.5)", "steps: got 2.5"),
    ("study_with(samples=0)", "samples: got 0"),
    ("study_with(samples=True)", "samples: got True"),
    ("study_with(paper_networks=32)", "paper_networks: got 32"),
    ("study_with(paper_networks=(0,))", "paper_networks: got 0"),
    ("study_with(quantile_weight=np.eye(3))", "quantile_weight: got shape (3, 3), expected (2, 2)"),
    ("study_with(quantile_weight=-np.eye(2))", "quantile_weight: got a negative direction (scaled eigenvalue -1)"),
    # Limits and starts
    ("study_with(X=Polytope.from_bounds([-1], [1]))", "X: got"),
    ("study_with(U=Polytope.from_bounds([-1, -1], [1, 1]))", "U: got"),
    ("study_with(X=Polytope([[1.0, 0.0]], [1.0]))", "X: got an unbounded set"),
    ("study_with(X=Polytope.from_bounds([0.1, -2], [1, 2]), x0=[0.5, 0])", "X: got a set without the origin"),
    ("study_with(U=Polytope.from_bounds([0.5], [1]))", "U: got a set without the origin"),
    ("study_with(X=Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, -2, 1, 1]))", "X: got an empty set"),
    ("study_with(objective=QuadraticObjective(np.eye(3), [[0.1]]))", "Q: got"),
    ("study_with(objective=QuadraticObjective(np.eye(2), np.eye(2)))", "R: got"),
    ("study_with(x0=[5, 0])", "x0: got [5.0, 0.0], which is outside X"),
    ("study_with(x0=[0.5])", "x0: got shape (1,)"),
    ("study_with(x0=['a', 'b'])", "x0: got ['a', 'b']"),
    ("study_with(p0=[9])", "p0: got k = 9, expected a value in [1, 4]"),
    ("study_with(p0=[[2]])", "p0: got shape (1, 1)"),
    ("study_with(p0=[np.nan])", "p0: got nan at index (0,)"),
    # Disturbances
    ("study_with(disturbance=Gaussian([0.1, 0.1]))", "disturbance: got 2 channels, expected 1"),
    ("real_with(disturbance=Gaussian([0.1, 0.1]))", "real.disturbance: got 2 channels, expected 1"),
    ("study_with(disturbance=Silent())", "disturbance: got a Silent whose sample(1, 2, rng) stops with TypeError"),
    ("study_with(disturbance=Flat())", "disturbance: got samples of shape (2,)"),
    # The real plant
    ("real_with(plant=None)", "real.plant: got nothing"),
    ("real_with(x0=[0])", "real.x0: got shape (1,)"),
    ("real_with(runs=0)", "real.runs: got 0"),
    ("real_with(steps=1.5)", "real.steps: got 1.5"),
    ("real_with(runs=1, steps=20)", "real.runs: got 1 of 20 steps, expected at least 500 samples"),
    ("study_with(real=real_with(plant=spring(dt=0.2)))", "real.plant: got dt = 0.2 s, expected 0.1 s"),
    ("study_with(real=real_with(plant=spring(nx=3), x0=[0, 0, 0]))", "real.plant: got 3 states, expected 2"),
    ("study_with(real=real_with(plant=spring(nu=2)))", "real.plant: got 2 inputs, expected 1"),
    ("study_with(real=real_with(plant=spring(names=('c',))))", "real.plant: got another design space"),
    ("study_with(real=real_with(plant=spring(upper=5.0)))", "real.plant: got another design space"),
    # The plant itself
    ("study_with(plant=spring(state_names=['q']))", "state_names: got"),
    ("study_with(plant=spring(input_names=['f', 'g']))", "input_names: got"),
    ("study_with(X=Polytope.from_bounds([-1, -2], [1, 2]), nonsense=1)", "TypeError"),
    # The file
    ("study_with(", "SyntaxError"),
    ("undefined_name", "NameError: name 'undefined_name' is not defined"),
    ("1 / 0", "ZeroDivisionError: division by zero"),
    ("__import__('not_a_module')", "ModuleNotFoundError"),
    ("exit(3)", "SystemExit"),
    ("3", "which declares no `study`"),
    ("Study", "which declares no `study`"),
]


@pytest.mark.parametrize(("expression", "message"), WRONG, ids=[expression for expression, _ in WRONG])
def test_a_wrong_study_file_is_refused_with_its_line(tmp_path, expression, message):
    path = tmp_path / "mine.py"
    path.write_text(HEAD + f"\nstudy = {expression}\n")
    with pytest.raises(InputError) as refused:
        load_study(str(path))
    text = str(refused.value)
    assert text.startswith("study: got ")
    assert message in text
    assert len(text.splitlines()) == 1
    assert text.count(", expected ") == 1
    if "declares no" not in message:
        line = HEAD.count("\n") + 2
        lines = [f"mine.py:{n}" for n in range(1, line + 2)]
        assert any(f"{place}, which stops with" in text for place in lines)


def test_there_are_at_least_42_of_them():
    assert len(WRONG) >= 42


def fields():
    """The fields of a study that is right."""
    import casadi as ca

    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, ca.vertcat(x[1], -p * x[0] + u + w), DesignSpace(["k"], [1], [4]), dt=0.1)
    return {
        "name": "spring", "title": "Spring", "plant": plant, "X": Polytope.from_bounds([-1, -2], [1, 2]),
        "U": Polytope.from_bounds([-1], [1]), "objective": QuadraticObjective(np.eye(2), [[0.1]]),
        "disturbance": Gaussian([0.1]), "x0": [0.5, 0], "p0": [2],
    }  # fmt: skip


def test_without_a_real_plant_the_model_is_the_real_plant():
    study = Study(**fields(), real=None)
    assert study.real.plant is study.plant
    assert study.real.disturbance is study.disturbance
    np.testing.assert_array_equal(study.real.x0, study.x0)
    assert study.started(x0=[0.1, 0.1]).real.x0.tolist() == [0.1, 0.1]


def test_the_right_field_names_the_real_plant():
    with pytest.raises(InputError) as refused:
        RealPlant(fields()["plant"], Recorded(np.zeros((600, 3))), [0, 0], 1, 600)
    assert refused.value.argument == "real.disturbance"
    assert refused.value.expected == "1, one per disturbance of the plant"


@pytest.mark.parametrize("dynamics", ["x[0] / (p - 1)", "x[0] * ca.log(p - 1)", "x[0] / (4 - p)"])
def test_a_model_that_is_infinite_at_a_bound_is_refused_with_the_design(tmp_path, dynamics):
    path = tmp_path / "mine.py"
    path.write_text(
        HEAD.replace("rate = -p * x[0] + ca.sum1(u) + w", f"rate = -{dynamics} + ca.sum1(u) + w")
        + "\nstudy = study_with()\n"
    )
    with pytest.raises(InputError, match=r"not finite at k = [14]"):
        load_study(str(path))


def test_a_model_that_cannot_be_stabilised_at_the_start_is_refused(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        HEAD.replace("rate = -p * x[0] + ca.sum1(u) + w", "rate = p * x[0] + 0 * ca.sum1(u) + w")
        + "\nstudy = study_with()\n"
    )
    with pytest.raises(InputError, match=r"p0: got k = 2, where LQR fails"):
        load_study(str(path))
