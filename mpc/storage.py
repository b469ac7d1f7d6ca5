"""Explicit laws on disk: arrays in `.npz`, the rest in JSON, no pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .exceptions import InvalidDataError
from .mpqp import MPQPStatus, Partition
from .parametric_qp import Constraint, ParametricQP
from .search_tree import SearchTree

if TYPE_CHECKING:
    from .explicit import ExplicitMPC

_FORMAT = "explicit-mpc/1"
_QP = ("H", "F", "f", "Y", "y", "G", "w", "S", "Lz", "Lt", "l", "Xz", "Xt", "x")
_PARTITION = ("H", "h", "offsets", "law", "centre", "half")
_TREE = ("planes", "nodes", "leaf_regions", "border")


def save_explicit(law: ExplicitMPC, path: Path) -> tuple[Path, Path]:
    """Write the two files and return their paths."""
    arrays, manifest = path.with_suffix(".npz"), path.with_suffix(".json")
    problem, partition = law.partition.problem, law.partition
    members = np.array([i for active in partition.active_sets for i in active], dtype=np.int64)
    data = {f"qp_{name}": getattr(problem, name) for name in _QP}
    data |= {f"partition_{name}": getattr(partition, name) for name in _PARTITION}
    data |= {f"tree_{name}": getattr(law.tree, name) for name in _TREE}
    data |= {"law": law.law, "law_number": law.law_number}
    data |= {"input_H": law.input_rows[0], "input_h": law.input_rows[1], "members": members}
    data["member_counts"] = np.array([len(active) for active in partition.active_sets], dtype=np.int64)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(arrays, **data)
    text = {
        "format": _FORMAT, "regions": len(partition), "status": partition.status.name, "nu": problem.nu,
        "parameters": [list(p) for p in problem.parameters], "constant_cost": problem.c,
        "solve_time": partition.solve_time, "labels": [list(label) for label in problem.labels],
    }  # fmt: skip
    manifest.write_text(json.dumps(text, indent=1) + "\n")
    return arrays, manifest


def load_explicit(path: Path) -> ExplicitMPC:
    """Read the two files."""
    from .explicit import ExplicitMPC

    text: dict[str, Any] = json.loads(path.with_suffix(".json").read_text())
    if text.get("format") != _FORMAT:
        raise InvalidDataError(f"{path}.json has format {text.get('format')!r}, expected {_FORMAT!r}.")
    with np.load(path.with_suffix(".npz"), allow_pickle=False) as file:
        data = {name: file[name] for name in file.files}
    problem = ParametricQP(
        **{name: data[f"qp_{name}"] for name in _QP}, c=text["constant_cost"], nu=text["nu"],
        parameters=tuple((name, size) for name, size in text["parameters"]),
        labels=tuple(Constraint(*label) for label in text["labels"]),
    )  # fmt: skip
    ends = np.cumsum(data["member_counts"])
    partition = Partition(
        problem=problem, status=MPQPStatus[text["status"]], solve_time=text["solve_time"],
        active_sets=tuple(tuple(part.tolist()) for part in np.split(data["members"], ends)[:-1]),
        **{name: data[f"partition_{name}"] for name in _PARTITION},
    )  # fmt: skip
    tree = SearchTree(**{name: data[f"tree_{name}"] for name in _TREE})
    return ExplicitMPC(partition, tree, data["law"], data["law_number"], (data["input_H"], data["input_h"]))
