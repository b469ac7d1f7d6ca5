"""Contents of results.json."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import tangent_note
from ccdtools.co_design.risk import measure
from ccdtools.limits import limits_in_words
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.report.headline import headline
from ccdtools.studies.stage_storage import Stage, jsonable

SCHEMA_VERSION = 6
PACKAGES = ("ccdtools", "numpy", "scipy", "torch", "casadi", "daqp", "control")


def generation_entry(
    generation: int, evaluation: Evaluation, *, found: Stage, deployed: Stage, learned: Stage, returns: Stage,
    design: Array,
) -> dict[str, Any]:  # fmt: skip
    """Element of ``generations`` from a generation's stages; `design` is deployed after it."""
    space = evaluation.problem.design
    keep = ("model", "model_return", "nominal_return", "updated_model_return")
    return {
        "generation": generation,
        "account": deployed.values["account"],
        "design": space.as_dict(design),
        "active_bounds": space.active_bounds(design),
        "active_constraints": space.active_constraints(design),
        "deployed_design": space.as_dict(found.arrays["design"]),
        "predicted_return": found.values["predicted"],
        **{name: returns.values[name] for name in keep},
        "deployed_return": deployed.values["deployed_return"],
        "deployed_diverged": deployed.values["diverged"],
        "delivery": deployed.values["delivery"],
        "trust": deployed.values["trust"],
        "online_updates": deployed.values["updates"],
        "quantiles": learned.values["scores"],
        "free_running": learned.values["free_running"],
        "gradient_check": found.values["gradient_check"],
        "codesign": found.values["ended"],
        "redesign": found.values["redesign"],
        "limits": found.values["limits"],
    }


def results(
    evaluation: Evaluation,
    *,
    initial: Stage,
    generations: Sequence[dict[str, Any]],
    comparison: Sequence[dict[str, Any]],
    stages: Sequence[Stage],
    beyond: Stage,
) -> dict[str, Any]:
    """Results that the tables show, with what reproduces them."""
    study = evaluation.study
    config = evaluation.config
    space = evaluation.problem.design
    contents: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "study": study.name, "title": study.title, "seed": evaluation.seed,
        "quick": config.quick, "preset": config.preset,
        "wall_seconds": sum(stage.values["seconds"] for stage in stages),
        "x0": study.x0, "starts": None if study.starts is None else repr(study.scenarios), "dt": study.plant.dt,
        "deployment_steps": evaluation.deployment_steps, "deployment_runs": study.real.runs,
        "state_names": study.plant.state_names, "input_names": study.plant.input_names,
        "design_space": {"names": space.names, "units": space.units, "lower": space.lower, "upper": space.upper,
                         "constraints": space.constraint_names, "integer": space.integer},
        "start": space.as_dict(study.p0), "limits": limits_in_words(evaluation.problem.output_limits),
        "measure": measure(study.judged_in), "optimised": measure(evaluation.problem.risk),
        "objective": study.objective.describe(), "linearisation": tangent_note(evaluation.problem),
        "initialisation": {key: value for key, value in initial.values.items() if key != "report"},
        "generations": list(generations),
        "comparison": list(comparison),
        "held_out": beyond.values["rows"],
        "gains": beyond.values["gains"],
        "configuration": config.as_dict(),
        "versions": {"python": platform.python_version()} | {name: version(name) for name in PACKAGES},
    }  # fmt: skip
    return dict(jsonable(contents | {"headline": headline(contents)}))
