"""Plants exported as an FMU by another tool: here by a few lines of C."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from compiler import CC

from ccdtools import (
    DesignSpace,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    Scenario,
    compare,
    experiment,
    simulate,
)
from ccdtools.exceptions import SimulatorError
from ccdtools.plants import from_fmu

fmpy = pytest.importorskip("fmpy")
HERE = CC is not None and sys.platform.startswith("linux")
pytestmark = pytest.mark.skipif(not HERE, reason="needs a C compiler on Linux")
CASES = Path(__file__).parents[2] / "cases"
BOX = DesignSpace(["m", "c"], [0.5, 0.05], [2.0, 0.5], ["kg", "N·m·s"])


def packed(folder: Path, description: str | None = None, *, binary=True, changed=(), fmi="") -> Path:
    """FMU in a folder, of the source with some of its text changed."""
    library, path = folder / "pendulum.so", folder / "pendulum.fmu"
    if binary:
        text = (CASES / f"pendulum_fmu{fmi}.c").read_text(encoding="utf-8")
        for before, after in changed:
            assert before in text
            text = text.replace(before, after)
        source = str(folder / "pendulum.c")
        Path(source).write_text(text, encoding="utf-8")
        subprocess.run([CC, "-shared", "-fPIC", "-O1", f"-I{CASES}", source, "-o", str(library), "-lm"], check=True)
    with zipfile.ZipFile(path, "w") as archive:
        text = (CASES / f"pendulum_fmu{fmi}.xml").read_text(encoding="utf-8")
        archive.writestr("modelDescription.xml", text if description is None else description)
        if binary:
            archive.write(library, f"binaries/{fmpy.platform_tuple if fmi else fmpy.platform}/pendulum.so")
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """The pendulum."""
    return packed(tmp_path_factory.mktemp("fmu"))


def stated():
    """The same pendulum in CasADi."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    rate = (u + w - p[1] * x[1] - p[0] * 9.81 * ca.sin(x[0])) / p[0]
    return Plant(x, u, w, p, [x[1], rate], BOX, dt=0.05)


def test_events_and_inputs_that_are_left_out_are_told(tmp_path):
    known = (CASES / "pendulum_fmu.xml").read_text(encoding="utf-8")
    eventful = known.replace('numberOfEventIndicators="0"', 'numberOfEventIndicators="2"')
    with pytest.warns(UserWarning, match="path: the FMU has 2 event indicators, and no event is handled"):
        from_fmu(packed(tmp_path, eventful), dt=0.05, design=BOX)
    names = [v.name for v in fmpy.read_model_description(str(tmp_path / "pendulum.fmu")).modelVariables
             if v.causality == "input"]  # fmt: skip
    with pytest.warns(UserWarning, match=f"neither u nor w stay at their start: {names[1]}"):
        from_fmu(packed(tmp_path), dt=0.05, design=BOX, inputs=names[:1])


def test_an_fmu_is_simulated_as_the_plant_that_it_was_made_of(path):
    plant = from_fmu(path, dt=0.05, disturbances=["push"], design=BOX)
    assert (plant.nx, plant.nu, plant.nw) == (2, 1, 1)
    law, x0 = LinearFeedback([[2.0, 1.0]]), np.array([[1.0, 0.0], [-0.5, 2.0]])
    for design in ([1.0, 0.1], [1.7, 0.3], [1.0, 0.1]):
        given = {"x0": x0, "steps": 60, "design": design, "disturbance": Gaussian([0.3])}
        runs = [simulate(one, law, **given, rng=np.random.default_rng(0)) for one in (plant, stated())]
        np.testing.assert_allclose(runs[0].states, runs[1].states, rtol=1e-9, atol=1e-9)


def test_an_fmu_of_version_3_is_the_same_plant_as_that_of_version_2(path, tmp_path):
    given = {"dt": 0.05, "disturbances": ["push"], "design": BOX}
    plant = pickle.loads(pickle.dumps(from_fmu(packed(tmp_path, fmi="3"), **given)))
    for point in (([1.0, 0.3], [0.2], [-0.1], [1.7, 0.3]), ([-2.0, 0.0], [0.0], [0.5], [1.0, 0.1])):
        np.testing.assert_array_equal(plant.step(*point), from_fmu(path, **given).step(*point))
    with pytest.raises(InputError, match="path: got an FMU that stops"):
        plant.step([0.0, 2e3], [0.0], [0.0], [1.0, 0.1])
    text = (CASES / "pendulum_fmu3.xml").read_text(encoding="utf-8")
    arrays = text.replace('derivative="0"/>', 'derivative="0"><Dimension start="2"/></Float64>').replace(
        'initial="exact" start="0" d', 'initial="exact" start="0 0" d'
    )
    for change, words in ((text.replace('"3.0"', '"1.0"'), "path: got"),
                          (text.replace("<ModelExchange", "<CoSimulation"), "FMI 3.0 for co-simulation alone"),
                          (arrays, "whose states are arrays")):  # fmt: skip
        with pytest.raises(InputError, match=words):
            from_fmu(packed(tmp_path, change, binary=False), dt=0.05)
    with pytest.raises(InputError, match=f"does not load.*a binary for {fmpy.platform}; it has none"):
        from_fmu(packed(tmp_path, binary=False, fmi="3"), dt=0.05)


def test_all_inputs_are_inputs_where_none_is_a_disturbance_and_it_is_compared_and_pickled(path):
    plant = pickle.loads(pickle.dumps(from_fmu(path, dt=0.05)))
    assert (plant.nu, plant.nw, plant.design.dim) == (2, 0, 0)
    scenario = Scenario(plant, np.array([[1.0, 0.0]]), np.zeros((1, 30, 0)))
    laws = {"LQR": LinearFeedback(np.zeros((2, 2))), "pushed": LinearFeedback([[2.0, 1.0], [0.0, 0.0]])}
    table = compare(laws, scenario, objective=QuadraticObjective(np.eye(2), 0.01 * np.eye(2)), X=([-9, -9], [9, 9]))
    assert table["pushed"].summary.mean > table["LQR"].summary.mean


def test_a_step_that_the_fmu_refuses_is_told(path):
    plant = from_fmu(path, dt=0.05, disturbances=["push"], design=BOX)
    with pytest.raises(InputError, match=r"path: got an FMU that stops .* at x = \[0.0, 2000.0\], u = ") as told:
        plant.step([0.0, 2e3], [0.0], [0.0], [1.0, 0.1])
    assert "batched" not in str(told.value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"inputs": ["force"]}, "torque, push"),
        ({"disturbances": ["wind"]}, "torque, push"),
        ({"design": DesignSpace(["mass"], [0.5], [2.0])}, "m, c"),
        ({"inputs": ["torque", "push"], "disturbances": ["push"]}, "each input of the FMU once"),
        ({"inputs": ["torque", "torque"]}, "each input of the FMU once"),
        ({"inputs": "torque"}, "inputs: got 'torque', expected a list of names"),
        ({"disturbances": 3}, "disturbances: got 3, expected a list of names"),
        ({"dt": -1.0}, "dt"),
        ({"substeps": 0}, "substeps"),
    ],
)
def test_names_that_it_does_not_have_are_refused(path, given, words):
    with pytest.raises(InputError, match=words):
        from_fmu(path, **({"dt": 0.05} | given))


def test_an_fmu_that_stopped_begins_anew_and_need_not_answer_at_zero(tmp_path):
    stopped = "if (stopped || v[OMEGA] > 1e3 || v[PHI] == 0) { stopped = 1; return ERROR; }"
    changed = [
        ("if (n != 2 || v[OMEGA] > 1e3) return ERROR;", stopped),
        ("EXPORT int fmi2Reset(component c) {", "EXPORT int fmi2Reset(component c) { stopped = 0;"),
        ("static void start", "static int stopped = 0;\nstatic void start"),
    ]
    plant = from_fmu(packed(tmp_path, changed=changed), dt=0.05, disturbances=["push"], design=BOX)
    given = [1.0, 0.0], [0.0], [0.0], [1.0, 0.1]
    before = plant.step(*given)
    with pytest.raises(InputError, match="path: got an FMU that stops"):
        plant.step([1.0, 2e3], *given[1:])
    np.testing.assert_array_equal(plant.step(*given), before)


@pytest.mark.long
def test_an_fmu_that_crashes_or_hangs_takes_nothing_with_it(tmp_path, path):
    refused = "if (n != 2 || v[OMEGA] > 1e3) return ERROR;"
    whole, laws = from_fmu(path, dt=0.05, disturbances=["push"], design=BOX), LinearFeedback([[0.0, 0.0]])
    run = {"x0": [0.5, 0.0], "steps": 30, "design": [1.0, 0.1]}
    expected = simulate(whole, laws, **run)
    crash = packed(tmp_path, changed=[(refused, "if (v[OMEGA] < -1) abort();")])
    plant = from_fmu(crash, dt=0.05, disturbances=["push"], design=BOX, step_limit=60.0)
    with pytest.raises(SimulatorError, match="ends its process by SIGABRT at x = ") as caught:
        simulate(plant, laws, **run)
    kept = caught.value.kept
    np.testing.assert_array_equal(kept.states, expected.states[:, : kept.states.shape[1]])
    assert kept.states[0, -1, 1] > -1.0
    begins = "int fmi2ExitInitializationMode(component c) { (void)c; "
    hangs = packed(tmp_path, changed=[(begins, f"{begins}for (volatile int i = 0;; i++) ;")])
    with pytest.raises(SimulatorError, match=r"does not come back at p = \[1.25, 0.27"):
        from_fmu(hangs, dt=0.05, design=BOX, step_limit=0.5)


@pytest.mark.long
def test_an_fmu_that_does_not_begin_and_variables_that_are_not_real_are_refused(tmp_path):
    begins = "int fmi2ExitInitializationMode(component c) { (void)c; return "
    with pytest.raises(InputError, match="does not begin"):
        from_fmu(packed(tmp_path, changed=[(f"{begins}OK", f"{begins}ERROR")]), dt=0.05)
    chatter = "memset(e, 0, sizeof *e);"
    with pytest.raises(InputError, match="events go on"):
        from_fmu(packed(tmp_path, changed=[(chatter, f"{chatter} e->needed = 1;")]), dt=0.05)
    text = (CASES / "pendulum_fmu.xml").read_text(encoding="utf-8")
    whole = packed(tmp_path, text.replace('<Real start="1"/>', '<Integer start="1"/>'))
    with pytest.raises(InputError, match="real parameters of the FMU: c"):
        from_fmu(whole, dt=0.05, design=BOX)


def test_files_that_are_no_such_fmu_are_refused(tmp_path):
    text = (CASES / "pendulum_fmu.xml").read_text(encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read"):
        from_fmu(tmp_path / "none.fmu", dt=0.1)
    other = packed(tmp_path, text.replace("ModelExchange", "CoSimulation"))
    with pytest.raises(InputError, match="co-simulation alone"):
        from_fmu(other, dt=0.1)
    without = packed(tmp_path, binary=False)
    with pytest.raises(InputError, match=f"does not load.*expected one with a binary for {fmpy.platform}; it has none"):
        from_fmu(without, dt=0.1)
    with zipfile.ZipFile(without, "a") as archive:
        archive.writestr("binaries/win32/pendulum.dll", "of another platform")
    with pytest.raises(InputError, match=f"does not load.*a binary for {fmpy.platform}; it has win32"):
        from_fmu(without, dt=0.1)


def test_an_experiment_knows_an_fmu_by_what_its_file_holds(path, tmp_path):
    other = packed(tmp_path, (CASES / "pendulum_fmu.xml").read_text(encoding="utf-8") + "\n")
    moved = Path(shutil.copy(path, tmp_path / "moved.fmu"))
    for file, records in ((path, 1), (moved, 1), (other, 2)):
        scenario = Scenario(from_fmu(file, dt=0.05), np.array([[1.0, 0.0]]), np.zeros((1, 5, 0)))
        experiment(
            {"LQR": lambda p, rng: LinearFeedback(np.zeros((2, 2)))}, scenario, seeds=1, X=([-9, -9], [9, 9]),
            objective=QuadraticObjective(np.eye(2), np.eye(2)), folder=tmp_path / "kept",
        )  # fmt: skip
        assert len(list((tmp_path / "kept").iterdir())) == records
