"""C99 of a policy gives the mean action of the policy that was exported."""

import sys

import numpy as np
import pytest
from compiler import needs_compiler
from exported_policies import WIDE, compiled, of_outputs, policy, steep

from ccdtools import InputError, LearnedPolicy
from ccdtools.cli import main
from learning import ActorCritic


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
    law = LearnedPolicy(steep(agent, 9.0), [0.7])
    law.to_c(tmp_path)
    x = rng.uniform(-4, 4, (500, 2))
    u, _ = compiled(tmp_path, x, "double")
    np.testing.assert_allclose(u, law(x), rtol=0, atol=1e-11)
    assert np.abs(u).max() == pytest.approx(2.1)


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


@pytest.mark.parametrize("to", ["c", "onnx"])
def test_a_file_is_no_folder_to_export_to(tmp_path, monkeypatch, capsys, to):
    if to == "onnx":
        pytest.importorskip("onnx")
    policy().save(tmp_path / "policy.safetensors")
    for output in (tmp_path / "policy.safetensors", tmp_path / "policy.safetensors" / "x"):
        assert run(monkeypatch, "export", tmp_path, "--to", to, "--output", output) == 2
        assert "expected a folder that can be written to" in capsys.readouterr().err
