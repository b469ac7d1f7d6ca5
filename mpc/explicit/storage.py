"""Explicit laws on disk: checked `.npz` and JSON files, no pickle."""

from __future__ import annotations

import hashlib
import json
import os
import threading
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools_ground.door import array_fields
from mpc.checks import Array, Ints
from mpc.exceptions import InputError
from mpc.explicit.partition import MPQPStatus, Partition
from mpc.explicit.piecewise_law import PiecewiseLaw
from mpc.explicit.search_tree import SearchTree, TreeStatus
from mpc.parametric_qp import Constraint, ParametricQP

_FORMAT = "explicit-mpc/3"
Arrays = dict[str, np.ndarray[Any, Any]]
Parts = tuple[Partition, SearchTree, Array, Ints, tuple[Array, Array]]  # of an `ExplicitMPC`, in its order
_together = threading.Lock()  # two threads that save to one path do not mix their files


def save_explicit(law: PiecewiseLaw, path: Path) -> tuple[Path, Path]:
    """Write the two files and return their paths."""
    arrays, manifest = _files(path)
    problem = law.partition.problem
    partition = law.partition
    members = np.array([i for active in partition.active_sets for i in active], dtype=np.int64)
    parts = {"qp": problem, "partition": partition, "tree": law.tree}
    data = {
        f"{prefix}_{name}": getattr(part, name) for prefix, part in parts.items() for name in array_fields(type(part))
    }
    data |= {"law": law.law, "law_number": law.law_number, "members": members}
    data |= {"input_H": law.input_rows[0], "input_h": law.input_rows[1]}
    data["member_counts"] = np.array([len(active) for active in partition.active_sets], dtype=np.int64)
    text = {
        "format": _FORMAT, "regions": len(partition),
        "status": partition.status.name, "tree_status": law.tree.status.name, "nu": problem.nu,
        "parameters": [list(p) for p in problem.parameters], "constant_cost": problem.c,
        "solve_time": partition.solve_time, "uncovered": partition.uncovered,
        "labels": [list(label) for label in problem.labels],
    }  # fmt: skip
    text["fingerprint"] = _fingerprint(data, text)
    readable = json.dumps(text, indent=1) + "\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _together:
            _replace(arrays, lambda stream: np.savez_compressed(stream, **data))
            _replace(manifest, lambda stream: stream.write(readable.encode()))
    except OSError as error:
        raise InputError("path", f"{str(path)!r} ({error.strerror})", "a place that can be written to") from error
    return arrays, manifest


def _replace(file: Path, write: Callable[[Any], Any]) -> None:
    """Write a file completely beside its place, then move it there."""
    half_written = file.with_name(f"{file.name}.{uuid.uuid4().hex}.part")
    try:
        with half_written.open("wb") as stream:
            write(stream)
        os.replace(half_written, file)
    finally:
        half_written.unlink(missing_ok=True)


def load_parts(path: Path) -> Parts:
    """Read the two files.

    Raises
    ------
    InputError
        A file is missing or damaged, the two do not belong together, or an index points nowhere.
    """
    arrays, manifest = _files(path)
    for file in (manifest, arrays):
        if not file.is_file():
            raise InputError("path", f"no file {str(file)!r}", "the two files that `ExplicitMPC.save` wrote")
    try:
        text: dict[str, Any] = json.loads(manifest.read_text())
        if not isinstance(text, dict) or text.get("format") != _FORMAT:
            got = text.get("format") if isinstance(text, dict) else None
            raise InputError("path", f"{manifest.name} of format {got!r}", repr(_FORMAT), "Save it again.")
        with arrays.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            data = {name: file[name] for name in file.files}
        if text.pop("fingerprint") != _fingerprint(data, text):
            raise ValueError(f"{arrays.name} is not the file that {manifest.name} was written with")
        _check_arrays(data, text)
        return _assemble(text, data)
    except InputError:
        raise
    except Exception as error:  # whatever damaged bytes lead their readers to raise
        why = str(error) or type(error).__name__
        raise InputError(
            "path", f"{manifest.name} and {arrays.name} that cannot be read ({why})", "an undamaged pair of files",
            "Save the law again.",
        ) from error  # fmt: skip


def _files(path: Path) -> tuple[Path, Path]:
    """Paths of the `.npz` and `.json` files of a law."""
    stem = path.with_suffix("") if path.suffix in (".npz", ".json") else path
    return stem.with_name(stem.name + ".npz"), stem.with_name(stem.name + ".json")


def _fingerprint(data: Arrays, text: dict[str, Any]) -> str:
    """SHA-256 of the manifest and of the arrays."""
    digest = hashlib.sha256(json.dumps(text, sort_keys=True).encode())
    for name in sorted(data):
        array = np.ascontiguousarray(data[name])
        digest.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _check_arrays(data: Arrays, text: dict[str, Any]) -> None:
    """Raise where a shape, type or index does not fit."""
    regions = int(text["regions"])
    nu = int(text["nu"])
    m, nz = data["qp_G"].shape
    nt = data["qp_F"].shape[1]
    rows = len(data["partition_h"])
    nodes = len(data["tree_nodes"])
    leaf = len(data["tree_leaf_regions"])
    planes = len(data["tree_planes"])
    border = len(data["tree_border"])
    inputs = len(data["qp_l"])
    states = len(data["qp_x"])
    shapes = {
        "qp_H": (nz, nz), "qp_F": (nz, nt), "qp_f": (nz,), "qp_Y": (nt, nt), "qp_y": (nt,), "qp_G": (m, nz),
        "qp_w": (m,), "qp_S": (m, nt), "qp_Lz": (inputs, nz), "qp_Lt": (inputs, nt), "qp_l": (inputs,),
        "qp_Xz": (states, nz), "qp_Xt": (states, nt), "qp_x": (states,), "partition_H": (rows, nt),
        "partition_h": (rows,), "partition_offsets": (regions + 1,), "partition_law": (regions, nz, nt + 1),
        "partition_centre": (nt,), "partition_half": (nt,), "tree_planes": (planes, nt + 1), "tree_nodes": (nodes, 3),
        "tree_leaf_regions": (leaf,), "tree_border": (border, nt + 1), "tree_centre": (nt,),
        "law": (regions, nu, nt + 1), "law_number": (regions,), "input_H": (len(data["input_h"]), nu),
        "input_h": (len(data["input_h"]),), "members": (len(data["members"]),), "member_counts": (regions,),
    }  # fmt: skip
    whole = {"partition_offsets", "tree_nodes", "tree_leaf_regions", "law_number", "members", "member_counts"}
    for name, shape in shapes.items():
        array = data[name]
        kind = np.int64 if name in whole else np.float64
        if array.shape != shape or array.dtype != kind:
            raise ValueError(f"{name} has shape {array.shape} of {array.dtype}, not {shape} of {np.dtype(kind)}")
        if kind is np.float64 and not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
    if regions < 1 or not 1 <= nu <= inputs or len(text["labels"]) != m:
        raise ValueError("the numbers of regions, inputs or labels do not fit the arrays")
    if sum(int(size) for _, size in text["parameters"]) != nt or not (data["partition_half"] > 0).all():
        raise ValueError("the parameters do not fit the arrays")
    _check_indices(data, regions, m)


def _check_indices(data: Arrays, regions: int, m: int) -> None:
    """Raise where an index points nowhere, or the tree has a cycle."""
    offsets = data["partition_offsets"]
    number = data["law_number"]
    if offsets[0] != 0 or (np.diff(offsets) < 0).any() or offsets[-1] != len(data["partition_h"]):
        raise ValueError("partition_offsets does not divide the facets among the regions")
    if not np.array_equal(np.unique(number), np.arange(number.max() + 1)):
        raise ValueError("law_number does not count the laws")
    counts = data["member_counts"]
    members = data["members"]
    if (counts < 0).any() or counts.sum() != len(members) or not _within(members, m):
        raise ValueError("members does not name constraints")
    nodes = data["tree_nodes"]
    leaf = data["tree_leaf_regions"]
    inner = nodes[:, 0] >= 0
    node = np.arange(len(nodes))[inner, None]
    children = nodes[inner, 1:]
    leaves = nodes[~inner]
    after = (children > node).all() and (children < len(nodes)).all()  # so that every walk ends
    if not len(nodes) or not after or not _within(nodes[inner, 0], len(data["tree_planes"])):
        raise ValueError("tree_nodes has a hyperplane or a child that does not exist")
    if (leaves[:, 0] != -1).any() or (leaves[:, 1] < 0).any() or (leaves[:, 1] > leaves[:, 2]).any():
        raise ValueError("tree_nodes has a leaf that is no slice")
    if (leaves[:, 2] > len(leaf)).any() or not _within(leaf, regions):
        raise ValueError("tree_leaf_regions names a region that does not exist")


def _within(indices: np.ndarray[Any, Any], count: int) -> bool:
    """Whether all indices are in 0 … count - 1."""
    return bool(((indices >= 0) & (indices < count)).all())


def _assemble(text: dict[str, Any], data: Arrays) -> Parts:
    """Parts of the law from checked arrays."""
    problem = ParametricQP(
        **{name: data[f"qp_{name}"] for name in array_fields(ParametricQP)},
        c=float(text["constant_cost"]), nu=int(text["nu"]),
        parameters=tuple((str(name), int(size)) for name, size in text["parameters"]),
        labels=tuple(Constraint(str(kind), int(step), int(row)) for kind, step, row in text["labels"]),
    )  # fmt: skip
    ends = np.cumsum(data["member_counts"])
    partition = Partition(
        problem=problem, status=MPQPStatus[text["status"]], solve_time=float(text["solve_time"]),
        uncovered=int(text.get("uncovered", 0)),
        active_sets=tuple(tuple(part.tolist()) for part in np.split(data["members"], ends)[:-1]),
        **{name: data[f"partition_{name}"] for name in array_fields(Partition)},
    )  # fmt: skip
    arrays = {name: data[f"tree_{name}"] for name in array_fields(SearchTree)}
    tree = SearchTree(**arrays, status=TreeStatus[text["tree_status"]])
    return partition, tree, data["law"], data["law_number"], (data["input_H"], data["input_h"])
