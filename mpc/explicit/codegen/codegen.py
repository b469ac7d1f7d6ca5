"""C99 source for an explicit law, without allocation or libraries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mpc.checks import Array, Ints
from mpc.dense_qp import DenseQP
from mpc.exceptions import InputError
from mpc.explicit.codegen import c_source as c
from mpc.explicit.codegen.c_source import real, table
from mpc.explicit.partition import MPQPStatus
from mpc.explicit.piecewise_law import PiecewiseLaw
from mpc.explicit.search_tree import distinct_planes, is_scan, region_points
from mpc.halfspaces import box_of
from mpc.tolerances import INSIDE, INSIDE_FLOAT, NO_BOUND

_TOLERANCE = {"double": INSIDE, "float": INSIDE_FLOAT}


@dataclass(frozen=True)
class CodeReport:
    """Report of the written code and its costs.

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
    law: PiecewiseLaw, folder: Path, *, name: str = "mpc", method: str = "tree", scalar: str = "double"
) -> CodeReport:
    """Write `name`.h and `name`.c, which define `int name_law(const name_real theta[], name_real u[])`.

    The function returns 0; 1 where theta lies outside the partition; 2 where it is not finite (u is the input nearest
    to zero). u never leaves an input set that is a box. Outside, u is what `ExplicitMPC.evaluate` gives, by either
    method: the input where the straight line to an inner point enters the partition; for an incomplete partition the
    law of the nearest region, saturated where the input set is a box.
    Gains and hyperplanes that occur more than once, up to sign for the hyperplanes, are stored once.

    Parameters
    ----------
    law : ExplicitMPC
        What to write.
    folder : Path
        Created when missing.
    name : str
        A C identifier.
    method : "tree" or "sequential"
        Binary search tree (fast; a leaf with several laws is scanned), or a scan of all regions (small, and right for
        an incomplete partition too).
    scalar : "double" or "float"
        Type of the numbers.

    Returns
    -------
    CodeReport
        Flash bytes and worst-case operations.

    Raises
    ------
    InputError
        An unknown option, a tree for a partition that is incomplete, or a folder that cannot be written to.
    """
    c.as_name(name)
    scan = is_scan(method)
    c.as_scalar(scalar)
    complete = law.status is MPQPStatus.COMPLETE
    if not scan and not complete:
        got = f"'tree' for a partition that is incomplete ({law.status.name})"
        raise InputError("method", got, "a complete partition", "Use method='sequential'.")
    count = int(law.law_number.max()) + 1
    regions, body, planes, rows = _scan(law, scalar) if scan else _tree(law, scalar)
    low, high, nearest = _inputs(law)
    fields = {
        "what": "Explicit model predictive control", "name": name, "NAME": name.upper(), "scalar": scalar,
        "nt": law.nt, "nu": law.nu,
        "border": _border(law, scalar), "regions": regions, "body": body,
        "law": _law_tables(law, scalar), "summary": f"{len(law)} regions, {count} laws, {method} search",
        "low": table(low, scalar), "high": table(high, scalar), "nearest": table(nearest, scalar),
        "large": real(NO_BOUND, scalar), "largest": c.LARGEST[scalar], "tolerance": real(_TOLERANCE[scalar], scalar),
        "outside": c.OUTSIDE[complete],
    }  # fmt: skip
    source = c.fill(c.SOURCE, fields)
    files = c.written(folder, name, c.fill(c.HEADER, fields), source)
    border = len(law.tree.border)
    rows += 2 * border
    operations = law.nt * rows + law.nu * law.nt * (1 if scalar == "double" else 13)  # 13 in twice the precision
    flash = c.table_bytes(source, scalar)
    return CodeReport(files, method, scalar, len(law), count, border + planes, flash, operations, rows)


def _law_tables(law: PiecewiseLaw, scalar: str) -> str:
    """C text of the distinct laws.

    In double a law is a gain and its value at a point amid its regions; in float, gain and offset in two parts.
    """
    laws = law.law[np.unique(law.law_number, return_index=True)[1]]
    if scalar == "float":
        rests = laws - laws.astype(np.float32)
        fields = {"nlaws": len(laws), "laws": table(laws, scalar), "rests": table(rests, scalar)}
        return c.fill(c.LAW_FLOAT, fields)
    p = law.partition
    found = region_points(p)
    centres = p.centre + p.half * found.points[found.starts[:-1]]
    points = np.array([centres[law.law_number == n].mean(axis=0) for n in range(len(laws))])
    laws[:, :, -1] += np.einsum("rij,rj->ri", laws[:, :, :-1], points)
    fields = {"nlaws": len(laws), "laws": table(laws, scalar), "points": table(points, scalar)}
    return c.fill(c.LAW_DOUBLE, fields)


def _border(law: PiecewiseLaw, scalar: str) -> str:
    """C text that moves outside points onto the border."""
    border = law.tree.border
    if not len(border):
        return c.NO_BORDER
    p = law.partition
    return c.fill(c.BORDER, {
        "border": table(_unscaled(law, border), scalar), "nborder": len(border),
        "room": table(border[:, -1] - border[:, :-1] @ law.tree.centre, scalar),
        "inner": table(p.centre + p.half * law.tree.centre, scalar), "half": table(p.half, scalar),
    })  # fmt: skip


def _tree(law: PiecewiseLaw, scalar: str) -> tuple[str, str, int, int]:
    """C text of the regions and of the search tree; its hyperplanes, and most that are looked at."""
    laws = int(law.law_number.max()) + 1
    nodes, root, depth, lists = _compact(law, laws)
    none = np.zeros(0, dtype=np.int64)
    members = np.concatenate([none, *lists])
    listed, renumbered = np.unique(members, return_inverse=True)
    offsets = law.partition.offsets
    wanted = np.concatenate([none, *(np.arange(offsets[r], offsets[r + 1]) for r in listed)])
    inner = law.tree.planes
    planes, number, flipped = distinct_planes(np.vstack([inner, law.partition.scaled_rows[wanted]]))
    refs = np.where(flipped, -1 - number, number)[len(inner) :]
    list_start = np.concatenate([[0], np.cumsum([len(part) for part in lists])]).astype(np.int64)
    # the planes of nodes keep their sign: below is where they are negative
    plane, below, above = nodes.T
    turned = flipped[plane]
    kind = _index_type(max(len(nodes), laws + len(lists), len(planes), len(wanted), len(members)))
    fields: dict[str, Any] = {
        "int": kind, "nplanes": max(len(planes), 1), "planes": table(_unscaled(law, planes), scalar),
        "nnodes": max(len(nodes), 1), "plane": table(number[plane], kind),
        "below": table(np.where(turned, above, below), kind), "above": table(np.where(turned, below, above), kind),
        "root": root, "nlaws": laws, "nlists": len(lists), "list_start": table(list_start, kind),
        "nmembers": len(members), "members": table(renumbered, kind),
    }  # fmt: skip
    regions = c.fill(c.REGIONS, fields)
    worst = 0
    if lists:
        regions += c.fill(c.LISTS, fields) + "\n" + _scan_text(law, listed, refs, kind, "members[e]", scalar)
        worst = max(int(np.diff(offsets)[part].sum()) for part in lists)
    fields |= {"lists": "", "leaf": c.fill(c.LEAF_LIST if lists else c.LEAF_LAW, fields)}
    return regions, c.fill(c.TREE, fields), len(planes), depth + worst


def _compact(law: PiecewiseLaw, laws: int) -> tuple[Ints, int, int, list[Ints]]:
    """Inner nodes alone (n, 3), root, depth, and regions of leaves with several laws.

    A node is its plane, the child below and the child above; children without regions are skipped. A child is a node,
    or -1 - leaf; leaf k < laws is law k, leaf laws + l the list l.
    """
    tree = law.tree
    target = np.zeros(len(tree.nodes), dtype=np.int64)  # what a reference to this node becomes
    depth = np.zeros(len(tree.nodes), dtype=np.int64)
    empty = np.zeros(len(tree.nodes), dtype=bool)
    inner: list[tuple[int, int, int]] = []
    lists: list[Ints] = []
    for i in range(len(tree.nodes) - 1, -1, -1):  # children come after their parent
        plane, a, b = (int(v) for v in tree.nodes[i])
        if plane < 0:
            held = np.unique(law.law_number[tree.leaf_regions[a:b]])
            empty[i] = len(held) == 0
            if len(held) > 1:
                target[i] = -1 - laws - len(lists)
                lists.append(tree.leaf_regions[a:b])
            else:
                target[i] = -1 - (held[0] if len(held) else 0)
        elif empty[a] or empty[b]:
            kept = b if empty[a] else a
            target[i] = target[kept]
            depth[i] = depth[kept]
            empty[i] = empty[kept]
        else:
            target[i] = len(inner)
            depth[i] = 1 + max(depth[a], depth[b])
            inner.append((plane, int(target[a]), int(target[b])))
    return np.array(inner, dtype=np.int64).reshape(-1, 3), int(target[0]), int(depth[0]), lists


def _scan(law: PiecewiseLaw, scalar: str) -> tuple[str, str, int, int]:
    """C text of the regions and of the scan of all; its hyperplanes, and most that are looked at."""
    rows = law.partition.scaled_rows
    planes, number, flipped = distinct_planes(rows)
    kind = _index_type(max(len(planes), len(rows), len(law)))
    fields = {"planes": table(_unscaled(law, planes), scalar), "nplanes": len(planes), "nregions": len(law)}
    every = np.arange(len(law))
    text = _scan_text(law, every, np.where(flipped, -1 - number, number), kind, "e", scalar)
    return c.fill(c.REGIONS, fields) + "\n" + text, c.fill(c.SEQUENTIAL, fields), len(planes), len(rows)


def _scan_text(law: PiecewiseLaw, regions: Ints, refs: Ints, kind: str, which: str, scalar: str) -> str:
    """C text that scans some regions; refs: planes of their rows, -1 - i is minus plane i."""
    start = np.concatenate([[0], np.cumsum(np.diff(law.partition.offsets)[regions])])
    return c.fill(c.SCAN, {
        "int": kind, "nregions": len(regions), "start": table(start, kind), "nrows": len(refs),
        "rows": table(refs, kind), "law": table(law.law_number[regions], kind), "which": which,
        "largest": c.LARGEST[scalar],
    })  # fmt: skip


def _unscaled(law: PiecewiseLaw, planes: Array) -> Array:
    """Hyperplanes [a, b] in units of θ, with a'θ - b unchanged."""
    p = law.partition
    a = planes[:, :-1] / p.half
    return np.hstack([a, (planes[:, -1] + a @ p.centre)[:, None]])


def _inputs(law: PiecewiseLaw) -> tuple[Array, Array, Array]:
    """Bounds of the inputs (±1e37 for none), and the input nearest to zero."""
    H, h = law.input_rows
    low, high = box_of(H, h) or (np.full(law.nu, -np.inf), np.full(law.nu, np.inf))
    nearest = np.clip(0.0, low, high)
    if box_of(H, h) is None and (h < 0).any():
        nearest = DenseQP(np.eye(law.nu), H).solve(nearest, h).z
    return np.maximum(low, -1e37), np.minimum(high, 1e37), nearest


def _index_type(largest: int) -> str:
    """C type for indices up to `largest`."""
    return "int16_t" if largest < 2**15 - 1 else "int32_t"
