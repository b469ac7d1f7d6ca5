"""What `import ccdtools` gives, and what it costs."""

import subprocess
import sys

import pytest

import ccdtools
import invariant_sets
import learning
import mpc
from ccdtools import studies


@pytest.mark.parametrize("package", [ccdtools, learning])
def test_every_public_name_exists(package):
    for name in package.__all__:
        assert getattr(package, name) is not None
    assert len(set(package.__all__)) == len(package.__all__)


def test_unknown_names_are_refused_as_in_any_module():
    with pytest.raises(AttributeError, match="module 'ccdtools' has no attribute 'magic'"):
        ccdtools.magic  # noqa: B018


def test_a_misspelt_name_is_told_the_one_that_was_meant():
    run = subprocess.run([sys.executable, "-c", "import mpc; mpc.LinearMPc"], capture_output=True, text=True)
    assert run.stderr.rstrip().endswith("Did you mean: 'LinearMPC'?")


def test_public_names_are_listed():
    assert dir(ccdtools) == sorted([*ccdtools.__all__, *ccdtools.GROUPS])


def test_importing_ccdtools_loads_neither_torch_nor_casadi():
    code = "import sys, ccdtools; print(sorted({'torch', 'casadi', 'matplotlib'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


@pytest.mark.long
def test_stating_a_problem_loads_no_torch():
    code = (
        "import sys, ccdtools; ccdtools.CoDesignProblem, ccdtools.FixedStart, ccdtools.simulate, ccdtools.discretise; "
        "print(sorted({'torch', 'matplotlib', 'ccdtools.twin.twin'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


def test_every_error_of_the_packages_has_one_base():
    assert issubclass(ccdtools.InputError, ccdtools.CCDError)
    assert issubclass(learning.exceptions.InputError, learning.LearningError)
    assert issubclass(learning.exceptions.CheckpointError, learning.LearningError)


@pytest.mark.parametrize("group", ccdtools.GROUPS)
def test_a_group_has_its_names_and_they_are_found_in_ccdtools_too(group):
    there = getattr(ccdtools, group)
    for name in there.__all__:
        assert getattr(ccdtools, name) is getattr(there, name)


def test_what_everybody_needs_is_where_everybody_looks():
    assert ccdtools.Polytope is invariant_sets.Polytope
    assert ccdtools.LinearMPC is mpc.LinearMPC
    assert ccdtools.StudyConfig is studies.StudyConfig
    assert len(ccdtools.__all__) <= 70
