"""A study whose actuator and room depend on the design, from the command to the page."""

import json

import numpy as np
import pytest
import small_runs
from typer.testing import CliRunner

from ccdtools import InputError, load_policy
from ccdtools.cli import RunFolder, app
from ccdtools.studies import preparation

SOURCE = (
    small_runs.SPRING.replace("Polytope.from_bounds([-1, -2], [1, 2])", "lambda p: ([-1, -2], [1.4 - 0.1 * p, 2])")
    .replace("Polytope.from_bounds([-1], [1])", "lambda p: (-0.15 * p, 0.2 * p)")
    .replace("steps=20, samples=20", 'steps=20, samples=20, filter="admissible"')
)


def study(source=SOURCE):
    """What the source declares."""
    names = {}
    exec(source, names)
    return names["study"]


@pytest.mark.check
def test_a_run_keeps_the_limits_of_every_design_and_the_report_shows_those_of_the_last(tmp_path, monkeypatch):
    monkeypatch.setattr(preparation, "configuration", small_runs.tiny_configuration)
    source = tmp_path / "limited.py"
    source.write_text(SOURCE)
    call = ["run", str(source), "--quick", "--generations", "2", "--output", str(tmp_path / "run")]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0, done.output
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    designs = [2.0] + [generation["design"]["k"] for generation in results["generations"]]
    folder = RunFolder(tmp_path / "run")
    for g, k in enumerate(designs):
        for name, inputs in folder.read_stage(f"comparison-{g}").arrays.items():
            if name.endswith("_inputs"):
                assert inputs.min() >= -0.15 * k * (1 + 1e-6), name
                assert inputs.max() <= 0.2 * k * (1 + 1e-6), name
    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    k = policy.design[0]
    assert k == pytest.approx(designs[-1])
    far = policy(np.array([[-30.0, -60.0], [30.0, 60.0]]))
    assert far.max() <= 0.2 * k + 1e-9
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Limits that depend on the design, those of the final one above: X(p) = " in page
    assert f"{0.2 * k:.4g}" in page
    (tmp_path / "run" / "results.json").unlink()
    again = CliRunner().invoke(app, ["resume", str(tmp_path / "run")])  # from the networks on disk
    assert again.exit_code == 0, again.output


def test_wrong_limits_are_named_when_the_study_is_made():
    with pytest.raises(InputError) as caught:
        study(SOURCE.replace("(-0.15 * p, 0.2 * p)", "(0.5 - 0.15 * p, 0.2 * p)"))
    assert caught.value.argument == "U"
    with pytest.raises(InputError) as caught:
        study(SOURCE.replace("x0=[0.5, 0]", "x0=[1.35, 0]"))
    assert caught.value.argument == "x0"
