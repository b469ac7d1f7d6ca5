"""Policies outside Python: C99 and ONNX give the mean action of the policy that was exported."""

import copy
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    DesignSpace,
    InputError,
    KalmanFilter,
    LearnedPolicy,
    LinearFeedback,
    Measurement,
    Plant,
    discretise,
    load_policy,
    simulate,
)
from ccdtools.cli import main
from ccdtools.controllers import History, Observed, OnnxPolicy
from ccdtools.estimation import CubatureKalmanFilter
from ccdtools.plants import BlackBox
from learning import ActorCritic, CheckpointError, NetworkConfig, load, save

CC = shutil.which("gcc") or shutil.which("clang") or shutil.which("cc")
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler")
WARNINGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror"]
WIDE = np.array([0.3, 3.0, 0.6, 3.0])

DRIVER = """
#include <stdio.h>
#include "%s.h"
int main(void)
{
    %s_real x[%s_NT], u[%s_NU];
    while (fread(x, sizeof(x), 1, stdin) == 1) {
        double row[%s_NU + 1];
        int i;
        row[%s_NU] = %s_law(x, u);
        for (i = 0; i < %s_NU; i++) row[i] = (double)u[i];
        fwrite(row, sizeof(row), 1, stdout);
    }
    return 0;
}
"""

MEMORY = """
#include <stdio.h>
#include "policy.h"
int main(void)
{
    policy_state state;
    policy_real sent[1 + POLICY_NY + POLICY_NU], u[POLICY_NU] = {0};
    while (fread(sent, sizeof(sent), 1, stdin) == 1) {
        double row[POLICY_NU + 1];
        int i;
        if (sent[0] > 0) { /* a run begins */
            policy_reset(&state);
            for (i = 0; i < POLICY_NU; i++) u[i] = 0;
        }
        row[POLICY_NU] = policy_step(&state, sent + 1, %s, u);
        for (i = 0; i < POLICY_NU; i++) row[i] = (double)u[i];
        fwrite(row, sizeof(row), 1, stdout);
    }
    return 0;
}
"""


def policy(hidden=(16, 16), size=2.0, **options):
    """A policy of four states and two inputs, whose weights are large enough to saturate."""
    config = NetworkConfig(hidden, **options)
    bounds = [-0.2, -2, -0.4, -2, 1e4], [0.2, 2, 0.4, 2.5, 4e4], [-900.0, 0.0], [1000.0, 3.0]
    agent = ActorCritic(*bounds, config=config, imitates=True, seed=1)
    for weight in agent.mean_network.parameters():
        weight.data *= size
    return LearnedPolicy(agent, [2e4])


def compiled(folder, x, scalar, name="policy", driver=None):
    """Inputs and codes of the C code, with warnings as errors and sanitizers."""
    low = name
    driver = driver or DRIVER % (low, low, *[name.upper()] * 4, low, name.upper())
    (folder / "driver.c").write_text(driver)
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-O1"]
    subprocess.run([CC, *WARNINGS, *sanitizers, f"{name}.c", "driver.c", "-o", "run", "-lm"], cwd=folder, check=True)
    sent = x.astype(np.float64 if scalar == "double" else np.float32).tobytes()
    rows = subprocess.run(["./run"], input=sent, cwd=folder, check=True, capture_output=True).stdout
    return np.split(np.frombuffer(rows).reshape(len(x), -1), [-1], axis=1)


@needs_compiler
@pytest.mark.parametrize(("scalar", "tolerance"), [("double", 1e-12), ("float", 1e-6)])
@pytest.mark.parametrize("shape", [{}, {"skip": False}, {"hidden": (7,)}, {"hidden": (5, 9, 4), "size": 4.0}], ids=str)
def test_the_c_code_gives_the_mean_action(tmp_path, rng, scalar, tolerance, shape):
    law = policy(**shape)
    report = law.to_c(tmp_path / "new", scalar=scalar)
    x = rng.uniform(-WIDE, WIDE, (20_000, 4)).astype(np.float32)
    u, code = compiled(tmp_path / "new", x, scalar)
    assert not code.any()
    half = np.array([950.0, 1.5])
    np.testing.assert_allclose(u / half, law(x) / half, rtol=0, atol=tolerance * max(1.0, shape.get("size", 2.0) / 2))
    assert 0.01 < (np.abs(law(x) - [50.0, 1.5]) >= half).mean() < 0.99
    assert report.flash_bytes < 10_000
    assert report.tangents == sum(shape.get("hidden", (16, 16)))


@needs_compiler
def test_outside_every_range_the_c_code_stays_within_the_limits(tmp_path):
    policy().to_c(tmp_path, name="law2")
    large = [1e308, -1e308, 0.0, 1e300]
    x = np.array([large, [np.nan, 0, 0, 0], [0, 0, 0, -np.inf]])
    u, code = compiled(tmp_path, x, "double", name="law2")
    assert code.ravel().tolist() == [0, 2, 2]
    np.testing.assert_array_equal(u[1:], np.zeros((2, 2)))
    assert ((u >= [-900, 0]) & (u <= [1000, 3])).all()


@needs_compiler
def test_inputs_that_a_design_limits_are_limited_in_c(tmp_path, rng):
    class Stronger:
        """Inputs within ± 3p."""

        entries = 1
        box = (np.array([-6.0]), np.array([6.0]))

        def bounds(self, p):
            return -3 * p, 3 * p

    agent = ActorCritic([-4, -4, 0.5], [4, 4, 2.0], [-6], [6], imitates=True, action_limits=Stronger(), seed=2)
    for weight in agent.mean_network.parameters():
        weight.data *= 9.0
    law = LearnedPolicy(agent, [0.7])
    law.to_c(tmp_path)
    x = rng.uniform(-4, 4, (500, 2))
    u, _ = compiled(tmp_path, x, "double")
    np.testing.assert_allclose(u, law(x), rtol=0, atol=1e-11)
    assert np.abs(u).max() == pytest.approx(2.1)


M, NY, NU = 5, 2, 2


def of_outputs(size=1.5, n=M * (NY + NU)):
    """A policy of the last five pairs of outputs and inputs."""
    bounds = -np.arange(1.0, n + 2), np.full(n + 1, 2.0), [-2.0, 0.0], [2.0, 3.0]
    agent = ActorCritic(*bounds, config=NetworkConfig((16, 16)), imitates=True, seed=4)
    for weight in agent.mean_network.parameters():
        weight.data *= size
    return History(LearnedPolicy(agent, [0.5]), M)


def test_a_history_of_other_outputs_names_them():
    with pytest.raises(InputError, match="y: got 3 outputs beside 2 inputs, expected 4 together"):
        of_outputs()(y=np.zeros(3), u_prev=np.zeros(2))


A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.3], [0.0, 0.0, 0.7]])
B = np.array([[0.0, 0.1], [0.3, 0.0], [0.2, 0.4]])


def of_estimate(*, steady=False):
    """A policy of the estimate of a filter that begins anywhere, with outputs of correlated noise."""
    known = {
        "D": [[0.1, 0.0], [0.0, 0.2]],
        "y0": [0.05, -0.1],
        "x0": [0.3, -0.2, 0.1],
        "c": [-0.03, 0.01, 0.05],
        "steady": steady,
    }
    start = {} if steady else {"P0": [1.0, 0.5, 2.0]}
    V = np.array([[0.01, 0.005], [0.005, 0.04]])
    estimator = KalmanFilter(A, B, np.eye(NY, 3), 0.01 * np.eye(3), V, **known, **start)
    return Observed(of_outputs(n=3, size=2.5).controller, estimator)


SPACE = DesignSpace(["p"], [0.0], [1.0])
NOISE = {
    "W": [0.01, 0.02, 0.01], "V": [[0.01, 0.005], [0.005, 0.04]], "P0": [1.0, 0.5, 2.0], "x0": [0.3, -0.2, 0.1],
    "c": [-0.03, 0.01, 0.05], "disturbance": ([0.1], [0.2]),
}  # fmt: skip


def nonlinear_plant():
    """A continuous plant with functions, a choice and a saturation, of one design and one disturbance."""
    x, u, w, p = (ca.SX.sym(name, n) for name, n in zip("xuwp", (3, NU, 1, 1)))
    dynamics = ca.vertcat(
        x[1] + 0.1 * ca.fmin(u[1], 2.5),
        -ca.sin(x[0]) - p * x[1] * ca.fabs(x[1]) + 3 * u[0] + w,
        ca.if_else(x[2] > 0, -2 * x[2], -x[2] * ca.exp(-(x[0] ** 2))) + 2 * u[0] + ca.tanh(4 * u[1]) / ca.sqrt(1 + p),
    )
    outputs = ca.vertcat(ca.sin(x[0]) + 0.05, ca.atan2(x[1], 2) + 0.2 * u[1])
    return Plant(x, u, w, p, dynamics, SPACE, dt=0.1, outputs=outputs, substeps=3)


def of_cubature(kind):
    """A policy of the estimate of a cubature filter, of a plant, its model or a linear one."""
    plant = model = nonlinear_plant()
    if kind == "sampled":
        model = replace(discretise(plant), substeps=2)
    elif kind == "linear":  # with a constant term
        model = discretise(replace(plant, dynamics=plant.p * (B @ plant.u - plant.x + 0.1)))
    estimator = CubatureKalmanFilter(model, plant, design=[0.5], **NOISE)
    return Observed(of_outputs(n=3, size=2.5).controller, estimator)


def closed_loop(law, rng, plant=None):
    """Outputs and inputs (runs, T, ·) of a loop of three states in which two are measured."""
    linear = BlackBox(lambda x, u, w, p: x @ A.T + u @ B.T, nx=3, nu=NU, dt=0.1, design=SPACE, batched=True)
    output = Measurement(np.eye(NY, 3) if plant is None else plant, noise=[0.1, 0.2])
    plant = linear if plant is None else plant
    run = simulate(plant, law, x0=rng.normal(size=(4, 3)), steps=250, design=[0.5], output=output, rng=rng)
    return run.outputs, run.inputs


def driven(law, y, u):
    """Inputs (runs, T, nu) of a controller that is told outputs, and the inputs before."""
    last = np.concatenate([np.zeros_like(u[:, :1]), u[:, :-1]], axis=1)
    law.reset(len(y))
    return np.stack([law(y=y[:, k], u_prev=last[:, k]) for k in range(y.shape[1])], axis=1)


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize(("scalar", "tolerance"), [("double", 1e-10), ("float", 1e-3)])
@pytest.mark.parametrize("n", [1, 2])
def test_the_c_code_of_a_filter_sees_a_difference_that_is_nearly_known(tmp_path, rng, scalar, tolerance, n):
    x, u, none = ca.SX.sym("x", n), ca.SX.sym("u", NU), ca.SX(0, 1)
    plant = Plant(x, u, none, none, x + 1e-3 * (ca.sin(x) + u[0]), DesignSpace([], [], []), dt=0.1, continuous=False,
                  outputs=[ca.sin(x[-1] - (x[0] if n > 1 else 0.0))])  # fmt: skip
    P0 = [[0.01]] if n == 1 else [[4.0, 4.0], [4.0, 4.0001]]
    estimator = CubatureKalmanFilter(plant, W=np.full(n, 1e-6), V=[1e-4], P0=P0)
    law = Observed(of_outputs(n=n, size=2.5).controller, estimator)
    law.to_c(tmp_path, scalar=scalar)
    y, u = np.float32(0.02 * rng.standard_normal((20, 4, 1))).astype(float), np.zeros((20, 4, NU))
    begins = np.zeros((20, 4, 1))
    begins[:, 0] = 1.0
    sent = np.concatenate([begins, y, u], axis=2).reshape(80, -1)
    found, code = compiled(tmp_path, sent, scalar, driver=MEMORY % "sent + 1 + POLICY_NY")
    assert not code.any()
    np.testing.assert_allclose(found, driven(law, y, u).reshape(80, NU), rtol=0, atol=tolerance)
    assert np.ptp(found[:, 0]) > 10 * tolerance


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize(("scalar", "tolerance"), [("double", 1e-12), ("float", 1e-6)])
@pytest.mark.parametrize("before", ["sent + 1 + POLICY_NY", "u"], ids=["as applied", "its own"])
@pytest.mark.parametrize("kind", ["history", "filter", "steady filter", "plant", "sampled", "linear"])
def test_the_c_code_of_a_policy_of_outputs_is_the_controller_in_a_closed_loop(
    tmp_path, rng, scalar, tolerance, before, kind
):  # fmt: skip
    if kind in ("plant", "sampled", "linear"):
        law, plant = of_cubature(kind), nonlinear_plant()
        if scalar == "float":  # of two of them one rounding of what is measured moves it by 4e-6 and 5e-6
            tolerance = {"plant": 3e-5, "sampled": 1e-5, "linear": 3e-6}[kind]
    else:
        law, plant = of_outputs() if kind == "history" else of_estimate(steady=kind == "steady filter"), None
    first = law
    law.save(tmp_path / "policy.safetensors", origin="a test")
    law = load_policy(tmp_path / "policy.safetensors")
    report = law.to_c(tmp_path, scalar=scalar)
    y, u = closed_loop(law, rng, plant)
    np.testing.assert_allclose(u, driven(first, y, u), rtol=0, atol=1e-12)
    last = np.concatenate([np.zeros((4, 1, NU)), u[:, :-1]], axis=1)
    begins = np.zeros((4, 250, 1))
    begins[:, 0] = 1.0
    sent = np.concatenate([begins, y, last], axis=2).reshape(1000, -1)
    found, code = compiled(tmp_path, sent, scalar, driver=MEMORY % before)
    assert not code.any()
    half = np.array([2.0, 1.5])
    expected = u
    if scalar == "float":  # what was measured is rounded before it is sent
        expected = driven(law, y.astype(np.float32), u.astype(np.float32))
    np.testing.assert_allclose(found / half, expected.reshape(1000, NU) / half, rtol=0, atol=tolerance)
    assert 0.05 < (np.abs(u - [0.0, 1.5]) >= half).mean() < 0.95
    assert report.flash_bytes < 10_000


@needs_compiler
def test_a_history_that_is_not_finite_is_told_until_it_is_over(tmp_path, rng):
    law = of_outputs()
    law.to_c(tmp_path)
    sent = np.hstack([np.eye(12, 1), rng.normal(size=(12, NY + NU))])
    sent[3, 2] = np.nan
    found, code = compiled(tmp_path, sent, "double", driver=MEMORY % "sent + 1 + POLICY_NY")
    assert code.ravel().tolist() == [0] * 3 + [2] * M + [0] * 4
    expected = np.array([law(y=row[1 : 1 + NY], u_prev=row[1 + NY :]) for row in sent])
    np.testing.assert_allclose(found, np.nan_to_num(expected), atol=1e-12)  # zero is within the limits


class Told:
    """An estimator that is told the state."""

    nu, ny = NU, 3

    def start(self, n):
        return None

    predict = update = start


def test_a_policy_behind_a_filter_of_no_expressions_does_not_leave_python(tmp_path):
    known, plant = of_estimate(), nonlinear_plant()
    stiff = CubatureKalmanFilter(discretise(plant, method="collocation"), design=[0.5], **NOISE)
    python = CubatureKalmanFilter(plant, lambda x: x[:, :NY], design=[0.5], **NOISE)
    for law, argument in (
        (Observed(known.controller, stiff), "estimator: got an implicit step.*filter around"),
        (Observed(known.controller, python), "estimator: got outputs by a function in Python.*filter around"),
        (Observed(known.controller, Told()), "estimator.*filter around"),
        (Observed(LinearFeedback(np.ones((2, 3))), known.estimator), "controller"),
        (Observed(policy(), known.estimator), "estimator: got 3 states"),
    ):  # fmt: skip
        for leave in (lambda law=law: law.to_c(tmp_path), lambda law=law: law.save(tmp_path / "p.safetensors")):
            with pytest.raises(InputError, match=argument):
                leave()


@pytest.mark.parametrize("change", [
    lambda known: known.pop("W"), lambda known: known.update(V=[1.0]), lambda known: known["timing"].pop("dt"),
    lambda known: known["expressions"]["instructions"][5].__setitem__(0, "OP_NEW"),
    lambda known: known["expressions"]["instructions"].pop(0),
    lambda known: known["expressions"].update(values=[3]), lambda known: known.update(expressions=None),
])  # fmt: skip
def test_a_file_whose_filter_was_changed_is_refused(tmp_path, change):
    law, path = of_cubature("plant"), tmp_path / "policy.safetensors"
    law.save(path)
    agent, extra = load(path)
    change(extra["filter"])
    save(path, agent, extra)
    with pytest.raises(CheckpointError, match="filter that cannot be read"):
        load_policy(path)


def test_a_history_of_no_learned_policy_does_not_leave_python(tmp_path):
    other = policy()
    for law, argument in (
        (History(LinearFeedback([[1.0, 0.0]]), 1), "controller"), (History(other, 3), "length"),
        (History(other, 2), "length"),
    ):  # fmt: skip
        for call in (law.to_c, law.to_onnx, law.save, lambda _, law=law: law.to_casadi()):
            with pytest.raises(InputError) as caught:
                call(tmp_path / "x")
            assert caught.value.argument == argument


def test_wrong_calls_name_their_argument(tmp_path):
    law = policy()
    for call, argument in (
        (lambda: law.to_c(tmp_path, name="2law"), "name"), (lambda: law.to_c(tmp_path, scalar="half"), "scalar"),
        (lambda: law.to_c(3), "folder"), (lambda: law.to_c(__file__), "folder"),
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            call()
        assert caught.value.argument == argument


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["ccdtools", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        main()
    return caught.value.code


@needs_compiler
def test_the_command_exports_the_policy_of_a_run(tmp_path, rng, monkeypatch, capsys):
    law = policy()
    law.save(tmp_path / "policy.safetensors")
    assert run(monkeypatch, "export", tmp_path, "--to", "c", "--output", tmp_path / "firmware") == 0
    assert "flash" not in capsys.readouterr().err
    x = rng.uniform(-WIDE, WIDE, (100, 4))
    np.testing.assert_allclose(compiled(tmp_path / "firmware", x, "double")[0], law(x), rtol=1e-12, atol=1e-9)
    of_outputs().save(tmp_path / "outputs.safetensors")
    assert run(monkeypatch, "export", tmp_path / "outputs.safetensors", "--output", tmp_path / "outputs") == 0
    assert "policy_step" in (tmp_path / "outputs" / "policy.h").read_text()
    assert run(monkeypatch, "export", tmp_path / "nowhere") == 2
    assert "expected the folder of a run with a policy" in capsys.readouterr().err
    assert run(monkeypatch, "export", tmp_path, "--to", "fortran") == 2
    assert run(monkeypatch, "export") == 2
    assert "folder: got nothing, expected the folder of a run." in capsys.readouterr().err


onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


@pytest.mark.parametrize("to", ["c", "onnx"])
def test_a_file_is_no_folder_to_export_to(tmp_path, monkeypatch, capsys, to):
    policy().save(tmp_path / "policy.safetensors")
    for output in (tmp_path / "policy.safetensors", tmp_path / "policy.safetensors" / "x"):
        assert run(monkeypatch, "export", tmp_path, "--to", to, "--output", output) == 2
        assert "expected a folder that can be written to" in capsys.readouterr().err


@pytest.mark.parametrize("options", [{}, {"skip": False}], ids=str)
def test_an_onnx_model_gives_the_mean_action_and_is_a_controller(tmp_path, rng, options):
    law = policy(**options)
    again = OnnxPolicy(law.to_onnx(tmp_path / "policy.onnx"))
    x = rng.uniform(-WIDE, WIDE, (500, 4))
    np.testing.assert_allclose(again(x), law(x), rtol=1e-12, atol=1e-9)
    assert again(x[0]).shape == (2,)


def test_an_onnx_model_is_taken_at_the_design_that_it_was_written_at_alone(tmp_path):
    plant = BlackBox(lambda x, u, w, p: 0.9 * x, nx=4, nu=2, dt=0.1, design=DesignSpace(["m"], [1e4], [4e4]))
    path = policy().to_onnx(tmp_path / "policy.onnx")
    law = OnnxPolicy(path)
    assert simulate(plant, law, x0=WIDE, steps=3, design=[2e4]).inputs.any()
    with pytest.raises(InputError, match=r"design: got \[30000.0\], expected \[20000.0\], the design of the policy"):
        simulate(plant, law, x0=WIDE, steps=3, design=[3e4])
    np.testing.assert_array_equal(History(law, 1).design, [2e4])
    model = onnx.load(path)
    del model.metadata_props[:]  # as of a model of others
    onnx.save(model, path)
    assert OnnxPolicy(path).design is None
    simulate(plant, OnnxPolicy(path), x0=WIDE, steps=3, design=[3e4])


@pytest.mark.parametrize("law", [of_outputs(), of_estimate()], ids=["history", "filter"])
def test_an_onnx_model_of_a_memory_is_the_controller_again(tmp_path, rng, law):
    again = replace(law, controller=OnnxPolicy(law.to_onnx(tmp_path / "policy.onnx")))
    _, u = closed_loop(law, np.random.default_rng(1))
    np.testing.assert_allclose(closed_loop(again, np.random.default_rng(1))[1], u, rtol=0, atol=1e-11)


@pytest.mark.parametrize("law", [of_outputs(), of_estimate()], ids=["history", "filter"])
def test_an_expression_of_a_memory_is_the_controller_again(law):
    function = law.to_casadi()
    again = replace(law, controller=lambda seen: np.array(function(seen.T)).T)
    _, u = closed_loop(law, np.random.default_rng(1))
    np.testing.assert_allclose(closed_loop(again, np.random.default_rng(1))[1], u, rtol=0, atol=1e-11)


def test_what_is_no_policy_in_onnx_is_refused(tmp_path):
    helper, kind, whole = onnx.helper, onnx.TensorProto.DOUBLE, onnx.TensorProto.INT64

    def saved(operator, inputs, shape, domain="", out=None, given=kind, **options):
        values = [helper.make_tensor_value_info(name, kind, shape) for name in dict.fromkeys(inputs)]
        found = helper.make_tensor_value_info("u", given, shape if out is None else out)
        node = helper.make_node(operator, inputs, ["u"], domain=domain, **options)
        graph = helper.make_graph([node], "policy", values, [found])
        versions = [helper.make_opsetid("", 17), helper.make_opsetid("of.mine", 1)]
        path = tmp_path / f"{operator}{len(shape)}{shape[0]}.onnx"
        onnx.save(helper.make_model(graph, opset_imports=versions, ir_version=8), path)
        return path

    for path, message in (
        (
            saved("Unknown", ["x"], ["n", 2], "of.mine"),
            "got .*of.mine:Unknown.*expected an ONNX model that onnxruntime can run",
        ),
        (saved("Unheard", ["x"], ["n", 2]), "No Op registered for Unheard"),
        (saved("Add", ["x", "y"], ["n", 2]), "expected one input"),
        (saved("Tanh", ["x"], ["n", 2, 3]), "expected one input"),
        (saved("Tanh", ["x"], [4, 2]), "expected one input .*, n free or 1"),
        (saved("Cast", ["x"], ["n", 2], to=whole, given=whole), "one output, of float or double"),
        (tmp_path / "nowhere.onnx", "expected a file"),
        (__file__, "expected an ONNX model"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            OnnxPolicy(path)
        assert caught.value.argument == "path"
    one = OnnxPolicy(saved("Tanh", ["x"], [1, 2]))
    np.testing.assert_allclose(one(np.ones((3, 2))), np.tanh(np.ones((3, 2))))
    for x in (np.ones(3), np.ones((2, 2, 2))):
        with pytest.raises(InputError, match=r"x: got shape"):
            one(x)
    for wrong in (saved("Transpose", ["x"], ["n", 2], out=[2, "n"]), saved("ReduceSum", ["x"], ["n", 2], out=[1, 1])):
        with pytest.raises(InputError, match=r"path: got a model that gives .* expected inputs \(3, nu\)"):
            OnnxPolicy(wrong)(np.ones((3, 2)))
    with pytest.raises(InputError, match="expected states that the model takes"):
        OnnxPolicy(saved("MatMul", ["x", "x"], ["n", "m"]))(np.ones((3, 2)))


def test_a_policy_in_onnx_is_copied_and_pickled(tmp_path):
    law = OnnxPolicy(policy().to_onnx(tmp_path / "a policy ü.onnx"))
    for other in (copy.deepcopy(law), pickle.loads(pickle.dumps(law))):
        np.testing.assert_array_equal(other(WIDE), law(WIDE))
        assert repr(other) == repr(law)
