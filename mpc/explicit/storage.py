"""Explicit laws on disk: arrays in `.npz`, the rest in JSON, no pickle."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpc.exceptions import InputError
from mpc.explicit.mpqp import MPQPStatus, Partition
from mpc.explicit.search_tree import SearchTree
from mpc.parametric_qp import Constraint, ParametricQP

if TYPE_CHECKING:
    from mpc.explicit.explicit import ExplicitMPC

_FORMAT = "explicit-mpc/1"
_QP = ("H", "F", "f", "Y", "y", "G", "w", "S", "Lz", "Lt", "l", "Xz", "Xt", "x")
_PARTITION = ("H", "h", "offsets", "law", "centre", "half")
_TREE = ("planes", "nodes", "leaf_regions", "border")


def save_explicit(law: ExplicitMPC, path: Path) -> tuple[Path, Path]:
    """Write the two files and return their paths."""
    arrays, manifest = _files(path)
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
    arrays, manifest = _files(path)
    try:
        text: dict[str, Any] = json.loads(manifest.read_text())
        if not isinstance(text, dict) or text.get("format") != _FORMAT:
            got = text.get("format") if isinstance(text, dict) else None
            raise InputError(f"{manifest} has format {got!r}, expected {_FORMAT!r}.")
        with arrays.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return _assemble(text, {name: file[name] for name in file.files})
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{manifest} and {arrays.name} cannot be read: {error!r}. Save it again.") from error


def _files(path: Path) -> tuple[Path, Path]:
    """The two files of a law; of a path that already ends in .npz or .json the ending is replaced."""
    stem = path.with_suffix("") if path.suffix in (".npz", ".json") else path
    return stem.with_name(stem.name + ".npz"), stem.with_name(stem.name + ".json")


def _assemble(text: dict[str, Any], data: dict[str, Any]) -> ExplicitMPC:
    from mpc.explicit.explicit import ExplicitMPC

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
