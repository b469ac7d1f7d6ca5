"""What an experiment knows a controller by: its function, and what that holds and calls."""

import os
import subprocess
import sys
from types import ModuleType

import pytest

STUDY = """
import functools
import numpy as np
from ccdtools import (
    CustomObjective, LearnedPolicy, QuadraticObjective, Scenario, discretise, experiment, plant_from_matrices,
)
from learning import ActorCritic

SHARED = {"b": 2.0, "a": 0.5}
NAMES = {"x", "y", "longer", "words"}

def gain_of(K):
    return 2 * K

class Law:
    factor = 1.0

    def __init__(self, K):
        self.K = K

    @functools.cached_property
    def squared(self):
        return self.K**2

    def __call__(self, x):
        return -self.factor * x @ self.K

def closed(law, objective, policy):
    def maker(design, rng):
        made.append(len(NAMES) + gain_of(law.K) + SHARED["a"])
        return law if objective and policy else None
    return maker

made = MADE
agent = ActorCritic([-1.0], [1.0], [-1.0], [1.0], seed=1)
objective = CustomObjective(lambda x, u, p: 2 * x[0] ** 2 + u[0] ** 2)
law = Law(np.array([[0.5]]))
plant = plant_from_matrices([[0.9]], [[1.0]], [[1.0]], dt=1.0, continuous=False)

def go(folder):
    maker = closed(law, objective, LearnedPolicy(agent, []))
    experiment({"law": maker}, Scenario(discretise(plant), [[1.0]], np.ones((5, 1))), seeds=2, X=([-50], [50]),
               objective=QuadraticObjective([[1.0]], [[0.5]]), folder=folder)
"""


class Count(int):
    """A number of calls that a controller's function may add to without being another one."""

    calls = 0

    def append(self, value):
        type(self).calls += 1


def made(folder, *changes):
    """How many controllers are made by a study with some texts changed."""
    text = STUDY
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    study = ModuleType("study")
    study.MADE = Count()
    exec(compile(text, "study.py", "exec"), vars(study))
    before = Count.calls
    study.go(folder)
    return Count.calls - before


def test_what_is_used_in_between_and_where_it_stands_in_a_file_is_no_change(tmp_path):
    assert made(tmp_path) == 2
    assert made(tmp_path) == 0
    assert made(tmp_path, ("SHARED", "\n\n# a remark\nSHARED"), ("maker", "made_by")) == 0
    assert made(tmp_path, ("def go(folder):", "law.squared\nobjective.terms\n\ndef go(folder):")) == 0
    used = "objective.rewards(np.ones((1, 1)), np.ones((1, 1)), np.ones((1, 1)), np.zeros(0))\n\ndef go(folder):"
    assert made(tmp_path, ("def go(folder):", used)) == 0


@pytest.mark.parametrize("change", [
    ("[[0.5]]))\nplant", "[[0.6]]))\nplant"), ("return 2 * K", "return 3 * K"), ("factor = 1.0", "factor = 1.5"),
    ("-self.factor * x", "+self.factor * x"), ('"a": 0.5', '"a": 0.7'), ('"words"', '"sword"'), ("seed=1", "seed=2"),
    ("[[0.9]], [[1.0]]", "[[0.8]], [[1.0]]"),
    ("2 * x[0] ** 2", "3 * x[0] ** 2"), ("if objective and policy", "if policy and objective"),
])  # fmt: skip
def test_a_controller_that_was_changed_is_computed_anew_and_its_old_numbers_stay(tmp_path, change):
    made(tmp_path)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
    assert made(tmp_path, change) == 2
    assert made(tmp_path, change) == made(tmp_path) == 0
    assert before.items() <= {file: file.stat().st_mtime_ns for file in tmp_path.iterdir()}.items()


@pytest.mark.long
def test_every_process_knows_a_controller_again(tmp_path):
    kept = []
    for seed in ("1", "2"):
        folder, script = tmp_path / seed, tmp_path / f"study{seed}.py"
        script.write_text("MADE = 0\n" + STUDY.replace("made.append", "print") + f"\ngo({str(folder)!r})\n")
        environment = os.environ | {"PYTHONHASHSEED": seed}
        subprocess.run([sys.executable, script], env=environment, check=True, capture_output=True)
        kept.append({file.name for file in folder.iterdir()})
    assert len(kept[0]) == 2
    assert kept[0] == kept[1]
