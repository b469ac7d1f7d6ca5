"""Fingerprint of a run, so that only the same study is resumed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import casadi as ca

from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools.plants.symbolic_functions import SymbolicFunction
from ccdtools.studies.loading import LoadedStudy
from ccdtools.studies.presets import StudyConfig
from ccdtools.studies.stage_storage import jsonable
from invariant_sets import Polytope

PLANT_NUMBERS = ("design", "dt", "continuous", "substeps", "state_names", "input_names")


def fingerprint(loaded: LoadedStudy, config: StudyConfig) -> dict[str, Any]:
    """Study, sources and configuration as flat JSON values; long ones hashed."""
    declared = {field.name: getattr(loaded.study, field.name) for field in dataclasses.fields(loaded.study)}
    parts = {"study": declared, "source": loaded.sources, "configuration": config.as_dict()}
    return dict(_flat(jsonable_of(parts))) | {"ccdtools": version("ccdtools")}


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Entries that differ, as "name: before → now"; hashes by name."""
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    names.sort(key=lambda name: name.startswith("source."))  # what is declared says more than that a file was edited
    return [_difference(name, before.get(name), now.get(name)) for name in names]


def summary(found: list[str]) -> str:
    """First differences as one phrase."""
    rest = len(found[3:])  # not named
    return "; ".join(found[:3]) + (f"; and {rest} more" if rest else "")


def jsonable_of(value: Any) -> Any:
    """JSON form of `value`: fields, dynamics of plants, arrays as lists."""
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


def _flat(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """Name and value of every leaf of nested dictionaries; long ones hashed."""
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in _flat(item, f"{name}.{key}" if name else key)]
    text = json.dumps(value, ensure_ascii=False)
    return [(name, value if len(text) <= 80 else "sha256:" + hashlib.sha256(text.encode()).hexdigest())]


def _difference(name: str, before: Any, now: Any) -> str:
    """One difference in words."""
    if name.startswith("source."):
        return f"the source {name.removeprefix('source.')} was edited"
    if any(str(value).startswith("sha256:") for value in (before, now)):
        return f"{name} differs"
    return f"{name} was {json.dumps(before, ensure_ascii=False)}, is {json.dumps(now, ensure_ascii=False)}"
