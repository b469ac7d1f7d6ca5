"""C99 source for an explicit law: no allocation, no library, the same tables for every call."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.explicit.codegen.c_source import HEADER, LAW_DOUBLE, LAW_FLOAT, SEQUENTIAL, SOURCE, TREE, real, table
from mpc.explicit.mpqp import MPQPStatus
from mpc.explicit.search_tree import Ints, distinct_planes
from mpc.halfspaces import box_of

if TYPE_CHECKING:
    from mpc.explicit.explicit import ExplicitMPC

_TOLERANCE = {"double": 1e-7, "float": 1e-5}
_COMPENSATED = 13  # multiply-adds that a product in twice the precision costs


@dataclass(frozen=True)
class CodeReport:
    """What was written and what it costs.

    files : header and source; method : "tree" or "sequential"; flash_bytes : size of the constant tables [B];
    operations : multiply-adds in the worst case; comparisons : comparisons in the worst case.
    """

    files: tuple[Path, Path]
    method: str
    scalar: str
    regions: int
    laws: int
    hyperplanes: int
    flash_bytes: int
    operations: int
    comparisons: int

    def __str__(self) -> str:
        return (
            f"{self.regions} regions, {self.laws} laws, {self.hyperplanes} hyperplanes, {self.method} search in "
            f"{self.scalar}: {self.flash_bytes} bytes of tables, at most {self.operations} multiply-adds and "
            f"{self.comparisons} comparisons a call"
        )


def write_c(
    law: ExplicitMPC, folder: Path, *, name: str = "mpc", method: str = "tree", scalar: str = "double"
) -> CodeReport:
    """Write `folder`/`name`.h and `name`.c, which define `int name_law(const name_real theta[], name_real u[])`.

    The function returns 0; 1 where theta lies outside the partition (u is then the law of a region near by, saturated
    where the input set is a box); 2 where theta is not finite (u is zero). Gains and hyperplanes that occur more than
    once, up to sign for the hyperplanes, are stored once.

    Parameters
    ----------
    law : ExplicitMPC
        What to write.
    folder : Path
        Created when missing.
    name : str
        A C identifier.
    method : "tree" or "sequential"
        Binary search tree (fast), or a scan of the regions (small, and right for an incomplete partition too).
    scalar : "double" or "float"
        Type of the numbers.

    Returns
    -------
    CodeReport
        Flash bytes and worst-case operations.

    Raises
    ------
    InputError
        An unknown option, or a tree for a partition that is incomplete or that no hyperplane separates.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise InputError(f"name is {name!r}, expected a C identifier.")
    if method not in ("tree", "sequential") or scalar not in _TOLERANCE:
        raise InputError(
            f"got method {method!r} and scalar {scalar!r}, expected 'tree' or 'sequential', 'double' or 'float'."
        )
    law_text, numbers = _law_tables(law, scalar)
    count = int(law.law_number.max()) + 1
    parts = _tree(law, law.law_number, scalar) if method == "tree" else _scan(law, law.law_number, scalar)
    body, planes, operations, comparisons, parts_bytes = parts
    low, high = _box(law)
    fields = {
        "name": name, "NAME": name.upper(), "scalar": scalar, "nt": law.nt, "nu": law.nu, "body": body,
        "law": law_text, "summary": f"{len(law)} regions, {count} laws, {method} search",
        "low": table(low, scalar), "high": table(high, scalar),
        "largest": "DBL_MAX" if scalar == "double" else "FLT_MAX", "tolerance": real(_TOLERANCE[scalar], scalar),
    }  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    files = (folder / f"{name}.h", folder / f"{name}.c")
    for file, template in zip(files, (HEADER, SOURCE)):
        file.write_text(_fill(template, fields))
    width = 8 if scalar == "double" else 4
    flash = parts_bytes + width * (numbers + 2 * law.nu)
    operations += law.nu * law.nt * (1 if scalar == "double" else _COMPENSATED)
    return CodeReport(files, method, scalar, len(law), count, planes, flash, operations, comparisons)


def _law_tables(law: ExplicitMPC, scalar: str) -> tuple[str, int]:
    """C text of the distinct laws and how many numbers it holds.

    In double a law is a gain and its value at a point amid its regions; in float, gain and offset in two parts.
    """
    laws = law.law[np.unique(law.law_number, return_index=True)[1]]
    if scalar == "float":
        rests = laws - laws.astype(np.float32)
        fields = {"nlaws": len(laws), "laws": table(laws, scalar), "rests": table(rests, scalar)}
        return _fill(LAW_FLOAT, fields), 2 * laws.size
    from mpc.explicit.kernels.search import centres_of

    p = law.partition
    centres = p.centre + p.half * centres_of(p.scaled_rows, p.offsets)
    points = np.array([centres[law.law_number == n].mean(axis=0) for n in range(len(laws))])
    laws[:, :, -1] += np.einsum("rij,rj->ri", laws[:, :, :-1], points)
    fields = {"nlaws": len(laws), "laws": table(laws, scalar), "points": table(points, scalar)}
    return _fill(LAW_DOUBLE, fields), laws.size + points.size


Parts = tuple[str, int, int, int, int]  # C text, hyperplanes, operations, comparisons, bytes


def _tree(law: ExplicitMPC, number: Ints, scalar: str) -> Parts:
    """Tables of the search tree, and the border of the partition that decides what is outside."""
    if law.status is not MPQPStatus.COMPLETE:
        raise InputError(f"a tree needs a complete partition, got {law.status.name}; use method='sequential'.")
    plane, below, above, root, depth = _compact(law, number)
    border = _unscaled(law, law.tree.border)
    planes = _unscaled(law, law.tree.planes)
    kind, size = _index_type(max(len(plane), int(number.max(initial=0)) + 1, len(planes)))
    text = _fill(TREE, {
        "planes": table(planes, scalar), "nplanes": max(len(planes), 1), "border": table(border, scalar),
        "nborder": len(border), "int": kind, "root": root, "nnodes": max(len(plane), 1),
        "plane": table(plane, kind), "below": table(below, kind), "above": table(above, kind),
    })  # fmt: skip
    width = 8 if scalar == "double" else 4
    n_bytes = width * (planes.size + border.size) + size * 3 * len(plane)
    return text, len(planes) + len(border), law.nt * (len(border) + depth), len(border) + depth, n_bytes


def _compact(law: ExplicitMPC, number: Ints) -> tuple[Ints, Ints, Ints, int, int]:
    """Inner nodes alone: a child is a node number, or -1 - law for a leaf. Children without regions are skipped."""
    tree = law.tree
    target = np.zeros(len(tree.nodes), dtype=np.int64)  # what a reference to this node becomes
    depth = np.zeros(len(tree.nodes), dtype=np.int64)
    empty = np.zeros(len(tree.nodes), dtype=bool)
    inner: list[tuple[int, int, int]] = []
    for i in range(len(tree.nodes) - 1, -1, -1):  # children come after their parent
        plane, a, b = (int(v) for v in tree.nodes[i])
        if plane < 0:
            held = np.unique(number[tree.leaf_regions[a:b]])
            if len(held) > 1:
                raise InputError("some regions share no separating hyperplane; use method='sequential'.")
            empty[i] = len(held) == 0
            target[i] = -1 - (held[0] if len(held) else 0)
        elif empty[a] or empty[b]:
            kept = b if empty[a] else a
            target[i], depth[i], empty[i] = target[kept], depth[kept], empty[kept]
        else:
            target[i], depth[i] = len(inner), 1 + max(depth[a], depth[b])
            inner.append((plane, int(target[a]), int(target[b])))
    columns = np.array(inner, dtype=np.int64).reshape(-1, 3).T
    return columns[0], columns[1], columns[2], int(target[0]), int(depth[0])


def _scan(law: ExplicitMPC, number: Ints, scalar: str) -> Parts:
    """Tables of the scan: every region lists its hyperplanes, with -1 - i for the other side of plane i."""
    rows = law.partition.scaled_rows
    planes = distinct_planes(rows)
    # match rows to planes by their rounded values, with either sign
    keys = {key.tobytes(): i for i, key in enumerate(np.round(planes, 8) + 0.0)}
    flipped = {key.tobytes(): -1 - i for i, key in enumerate(np.round(-planes, 8) + 0.0)}
    refs = np.array([(keys | flipped)[key.tobytes()] for key in np.round(rows, 8) + 0.0], dtype=np.int64)
    kind, size = _index_type(max(len(planes), len(rows), len(law)))
    offsets = law.partition.offsets
    text = _fill(SEQUENTIAL, {
        "planes": table(_unscaled(law, planes), scalar), "nplanes": len(planes), "int": kind, "nregions": len(law),
        "start": table(offsets, kind), "nrows": len(refs), "rows": table(refs, kind), "law": table(number, kind),
        "largest": "DBL_MAX" if scalar == "double" else "FLT_MAX",
    })  # fmt: skip
    n_bytes = (8 if scalar == "double" else 4) * planes.size + size * (len(offsets) + len(refs) + len(number))
    return text, len(planes), law.nt * len(rows), len(rows), n_bytes


def _unscaled(law: ExplicitMPC, planes: Array) -> Array:
    """Hyperplanes [a, b] in the units of θ; the residual a'θ - b keeps its size."""
    p = law.partition
    a = planes[:, :-1] / p.half
    return np.hstack([a, (planes[:, -1] + a @ p.centre)[:, None]])


def _box(law: ExplicitMPC) -> tuple[Array, Array]:
    """Bounds of the inputs where the input set is a box, a very large number elsewhere."""
    low, high = box_of(*law.input_rows) or (np.full(law.nu, -np.inf), np.full(law.nu, np.inf))
    return np.maximum(low, -1e37), np.minimum(high, 1e37)


def _index_type(largest: int) -> tuple[str, int]:
    return ("int16_t", 2) if largest < 2**15 - 1 else ("int32_t", 4)


def _fill(template: str, fields: dict[str, Any]) -> str:
    return re.sub(r"@(\w+)@", lambda match: str(fields[match[1]]), template)
