"""Preparation of a run: study, configuration, early checks and fingerprint, so that only the same study is resumed."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import jsonable
from ccdtools.disturbances.disturbance import Recorded
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import SymbolicFunction
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools.studies.asked_study import asked_study, blamed_on_source_options
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.options import Options
from ccdtools.studies.presets import StudyConfig, configuration
from ccdtools.studies.run_folder import DISTURBANCE, RunFolder
from ccdtools.studies.study import Study
from invariant_sets import Polytope

FORMAT = 5  # This is the version of run.json.
PLANT_NUMBERS = ("design", "dt", "continuous", "substeps", "state_names", "input_names")


@dataclass(frozen=True, eq=False)
class PreparedRun:
    """Contents of a run besides its folder."""

    options: Options
    study: Study
    config: StudyConfig
    begun_with: dict[str, Any]

    def begin(self, folder: RunFolder) -> None:
        """Write run.json and a copy of a recorded disturbance."""
        if isinstance(self.study.real.disturbance, Recorded):
            kept = io.BytesIO()
            np.save(kept, self.study.real.disturbance.signal)
            folder.write_bytes(DISTURBANCE, kept.getvalue())
        options = asdict(self.options)
        folder.write_json("run.json", {"format": FORMAT, "options": options, "begun_with": self.begun_with})


def prepare(options: Options, asked: tuple[Study, dict[str, str]] | None = None) -> PreparedRun:
    """Run that the options ask for; `asked` is its study, with sources, if made.

    Raises
    ------
    InputError
        If the study, a recording or what they give together cannot be run; it names an option only if it was given.
    """
    study, sources = asked_study(options) if asked is None else asked
    with blamed_on_source_options(options):
        config = configuration(
            study,
            preset=options.preset,
            quick=options.quick,
            expert=options.expert,
            method=options.method,
            design_gradient=options.design_gradient,
            sets=options.sets,
            sets_time_limit=options.sets_time_limit,
            drift=options.drift,
            trial=options.trial,
        )
        Evaluation(study, config, options.seed).check_deployment()
    return PreparedRun(options, study, config, fingerprint(study, sources, config))


def prepare_again(folder: RunFolder) -> PreparedRun:
    """Run that was begun in a folder.

    Raises
    ------
    InputError
        If the folder is damaged, or the study or its configuration is no longer what the run was begun with.
    """
    kept = folder.read_json("run.json")
    if kept.get("format") != FORMAT or not isinstance(kept.get("begun_with"), dict):
        got = f"{folder.path} with a run.json of another kind"
        raise InputError("folder", got, "one of this version of ccdtools")
    options = Options.from_json(kept.get("options"))
    prepared = prepare(options, asked_study(options, _kept_recording(folder, options)))
    found = differences(kept["begun_with"], prepared.begun_with)
    if found:
        first = "; ".join(found[:3]) + (f"; and {len(found) - 3} more" if len(found) > 3 else "")
        cure = "Undo the change, or begin a new run."
        raise InputError("folder", f"{folder.path}, begun with another study: {first}", "the same one", cure)
    return prepared


def _kept_recording(folder: RunFolder, options: Options) -> Recorded | None:
    path = folder.path / DISTURBANCE
    asked = options.disturbance is not None or options.road is not None
    if not path.is_file():
        if asked:
            raise InputError("folder", f"{folder.path} without {DISTURBANCE}", "the recording the run was begun with")
        return None
    try:
        return Recorded(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError, TypeError):
        got = f"{folder.path} with a damaged {DISTURBANCE}"
        raise InputError("folder", got, "the recording the run was begun with") from None


def fingerprint(study: Study, sources: Mapping[str, str], config: StudyConfig) -> dict[str, Any]:
    """Study, sources and configuration as flat JSON values; long ones hashed."""
    declared = {field.name: getattr(study, field.name) for field in dataclasses.fields(study)}
    parts = {"study": declared, "source": sources, "configuration": asdict(config)}
    return dict(_flat(jsonable_of(parts))) | {"ccdtools": version("ccdtools")}


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Entries that differ, as "name: before → now"; hashes by name."""
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    names.sort(key=lambda name: name.startswith("source."))  # what is declared says more than that a file was edited
    return [_difference(name, before.get(name), now.get(name)) for name in names]


def jsonable_of(value: Any) -> Any:
    """JSON form of `value`: fields, dynamics of plants, arrays as lists."""
    stated = _stated(value)
    if stated is not None:
        return stated
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: jsonable_of(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"kind": type(value).__name__, **fields}
    if isinstance(value, Mapping):
        return {str(key): jsonable_of(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable_of(item) for item in value]
    plain = jsonable(value)
    if plain is None or isinstance(plain, bool | int | float | str | list):
        return plain
    return f"a {type(value).__name__}"  # a disturbance of the user's own: its source is part of the fingerprint


def _stated(value: Any) -> Any:
    """JSON form of a plant, a function, a box of designs or a set; None for anything else."""
    if isinstance(value, Plant):
        arguments = [value.x, value.u, value.w, value.p]
        dynamics = ca.Function("dynamics", arguments, [value.dynamics]).serialize()
        numbers = {name: jsonable_of(getattr(value, name)) for name in PLANT_NUMBERS}
        if value.ny:
            numbers["outputs"] = [value.output.serialize(), value.output_names, jsonable_of(list(value.output_limits))]
        return {"dynamics": dynamics, **numbers}
    if isinstance(value, SymbolicFunction):
        return value.serialized()
    if isinstance(value, DesignSpace):  # what it does not have is left out, as in the runs of before it could have it
        held = {"constraints": value.constraints and value.constraints.serialize(), "integer": list(value.integer),
                "constraint_names": list(value.constraint_names)}  # fmt: skip
        plain = {name: jsonable_of(getattr(value, name)) for name in ("names", "lower", "upper", "units")}
        return {"kind": "DesignSpace", **plain, **{name: what for name, what in held.items() if what}}
    if isinstance(value, Polytope):
        return {name: jsonable_of(getattr(value, name)) for name in ("A", "b", "A_eq", "b_eq")}
    return None


def _flat(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """Name and value of every leaf of nested dictionaries; long ones hashed."""
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in _flat(item, f"{name}.{key}" if name else key)]
    text = json.dumps(value, ensure_ascii=False)
    return [(name, value if len(text) <= 80 else "sha256:" + hashlib.sha256(text.encode()).hexdigest())]


def _difference(name: str, before: Any, now: Any) -> str:
    if name.startswith("source."):
        return f"the source {name.removeprefix('source.')} was edited"
    if any(str(value).startswith("sha256:") for value in (before, now)):
        return f"{name} differs"
    return f"{name} was {json.dumps(before, ensure_ascii=False)}, is {json.dumps(now, ensure_ascii=False)}"
