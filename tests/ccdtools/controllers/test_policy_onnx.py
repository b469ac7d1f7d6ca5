"""ONNX gives the mean action of the policy that was exported."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from exported_policies import WIDE, closed_loop, of_estimate, of_outputs, policy

from ccdtools import DesignSpace, InputError, simulate
from ccdtools.controllers import History, OnnxPolicy
from ccdtools.plants import BlackBox

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


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
