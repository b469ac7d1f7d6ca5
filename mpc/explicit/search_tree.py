"""Point location by a binary tree of hyperplanes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ccdtools_ground.outcome import Outcome
from mpc.budgets import LEAF_ENTRIES, POINTS_OF_REGION, TESTS_AT_ONCE
from mpc.checks import Array, Flags, Immutable, Ints, as_seconds
from mpc.exceptions import InputError
from mpc.explicit.partition import MPQPStatus, Partition
from mpc.tolerances import CROSSING, SAME_HYPERPLANE_DIGITS

Laws = tuple[Array, Ints, Array]  # [gain, offset] of every region, their numbers, and input limits [low, high]


class TreeStatus(Outcome):
    """Outcome of growing a search tree; the value is the advice."""

    COMPLETE = "Complete: every leaf holds regions of one law, or few."
    TIME_LIMIT = "Stopped at `tree_time_limit`: some leaves hold many regions and are scanned. The law is the same."
    SIZE_LIMIT = "Stopped at the limit on memory: some leaves hold many regions and are scanned. The law is the same."
    SEQUENTIAL = "No tree: all regions are scanned. Pass method='tree' where many states are evaluated."


@dataclass(frozen=True, eq=False, repr=False)
class SearchTree(Immutable):
    """Binary search tree over a partition in scaled parameters; read-only.

    Attributes
    ----------
    planes : (n_planes, nt + 1) array
        Hyperplanes a't = b as rows [a, b].
    nodes : (n_nodes, 3) int array
        Inner node: hyperplane, child where a't <= b, child where a't > b. Leaf: -1 and its slice of `leaf_regions`.
    leaf_regions : int array
        Regions of the leaves.
    border : (n_border, nt + 1) array
        Facets [a, b] that have every region on their side a't <= b; empty for an incomplete partition.
    centre : (nt,) array
        A point within the border, towards which outside parameters are pulled.
    status : TreeStatus
        Whether the tree has grown to the end.
    """

    planes: Array
    nodes: Ints
    leaf_regions: Ints
    border: Array
    centre: Array
    status: TreeStatus = TreeStatus.COMPLETE

    @property
    def depth(self) -> int:
        """Largest number of hyperplanes evaluated."""
        level = np.zeros(len(self.nodes), dtype=np.int64)
        for node, (plane, below, above) in enumerate(self.nodes):  # children come after their parent
            if plane >= 0:
                level[[below, above]] = level[node] + 1
        return int(level.max(initial=0))

    def __repr__(self) -> str:
        size = f"{len(self.nodes)} nodes, depth {self.depth}, {len(self.planes)} hyperplanes"
        return f"SearchTree({size}, {self.status.name})"


class RegionPoints(NamedTuple):
    """Points points[starts[r] : starts[r + 1]] of region r: centre, then facets."""

    points: Array
    starts: Ints


def build_tree(
    partition: Partition, laws: Ints, points: RegionPoints, *, method: str = "tree", time_limit: float | None = None
) -> SearchTree:
    """Search tree whose leaves hold regions of one law, or few; with "sequential" one leaf with all regions.

    Regions of equal `laws` (n_regions,) need not be told apart; at the time limit [s] the leaves reached so far are
    kept (Tøndel, Johansen and Bemporad, *Evaluation of piecewise affine control via binary search tree*, Automatica
    39(5), 2003). Here hyperplanes are judged by points of the regions at a node, and only the sides of the chosen one
    are computed, so that the work grows little faster than the number of regions.
    """
    scan = is_scan(method)
    seconds = as_seconds("tree_time_limit", time_limit)
    n = len(partition.centre)
    every = np.arange(len(partition), dtype=np.int64)
    nodes = np.array([[-1, 0, len(partition)]], dtype=np.int64)
    tree = SearchTree(np.zeros((0, n + 1)), nodes, every, np.zeros((0, n + 1)), np.zeros(n), TreeStatus.SEQUENTIAL)
    if not scan:
        planes, nodes, leaf, status = _grow(partition, laws, points, seconds)
        tree = replace(
            tree, planes=planes, nodes=nodes, leaf_regions=_largest_first(nodes, leaf, points), status=status
        )
    if partition.status is not MPQPStatus.COMPLETE:
        return tree
    from mpc.explicit.kernels.halfspace import interior_point

    border = _border(partition, tree, points)
    centre = np.zeros(n)  # becomes a point well within the border, if there is one
    if len(border):
        A, b = (np.ascontiguousarray(part) for part in (border[:, :-1], border[:, -1]))
        interior_point(A, b, np.inf, centre)
    return replace(tree, border=border, centre=centre)


def search(
    tree: SearchTree, partition: Partition, theta: Array, laws: Laws | None = None, *, scan: bool = False
) -> tuple[Ints, Flags, Array]:
    """Region of every parameter (n, nt), whether it lies outside, and its input law[region] [θ; 1], by tree or scan.

    A parameter outside a complete partition gets the region where the straight line to the centre enters it, and the
    input there; one outside an incomplete partition the region from which it is least far, in scaled parameters.
    Outside any, the input is kept within the limits.
    """
    from mpc.explicit.kernels import search as compiled

    count, n = theta.shape
    parts = (tree.planes, tree.nodes, tree.leaf_regions)
    if scan:
        parts = (np.zeros((0, n + 1)), np.array([[-1, 0, 0]], dtype=np.int64), np.zeros(0, dtype=np.int64))
    if laws is None:
        laws = np.zeros((len(partition), 0, n + 1)), np.arange(len(partition)), np.zeros((2, 0))
    regions = (partition.scaled_rows, partition.offsets)
    scaling = (tree.border, tree.centre, partition.centre, partition.half)
    where = tuple(map(_view, (*parts, *regions, *scaling)))
    found = np.empty(count, dtype=np.int64), np.empty(count, dtype=bool), np.empty((count, laws[0].shape[1]))
    compiled.search(where, _view(theta), tuple(map(_view, laws)), found)
    return found


def distinct_planes(rows: Array) -> tuple[Array, Ints, Flags]:
    """Distinct hyperplanes up to sign, row numbers, and flips."""
    leading = np.argmax(np.abs(rows[:, :-1]) > 0.5 / np.sqrt(rows.shape[1]), axis=1)
    flipped = rows[np.arange(len(rows)), leading] < 0
    signed = np.where(flipped[:, None], -rows, rows)
    rounded = np.round(signed, SAME_HYPERPLANE_DIGITS) + 0.0
    _, first, number = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return np.ascontiguousarray(signed[first]), number.astype(np.int64).ravel(), flipped


def _view(array: Any) -> Any:
    """Read-only view, the array type of the compiled search."""
    view = array.view()
    view.flags.writeable = False
    return view


def is_scan(method: str) -> bool:
    """Whether all regions are to be scanned; an unknown method is refused."""
    if method not in ("tree", "sequential"):
        raise InputError("method", repr(method), "'tree' or 'sequential'")
    return method == "sequential"


def region_points(partition: Partition) -> RegionPoints:
    """Centre of every region and points on its facets, scaled."""
    from mpc.explicit.kernels.growth import points_of

    sizes = np.minimum(np.diff(partition.offsets) + 1, POINTS_OF_REGION)
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    points = np.zeros((int(starts[-1]), partition.scaled_rows.shape[1] - 1))
    points_of(partition.scaled_rows, partition.offsets, points, starts)
    return RegionPoints(points, starts)


def _grow(
    partition: Partition, laws: Ints, points: RegionPoints, seconds: float
) -> tuple[Array, Ints, Ints, TreeStatus]:
    """Planes, nodes, leaf regions and status of a grown tree."""
    from mpc.explicit.kernels.growth import LEAF, NEXT, NODES, POOL, Growth, Regions, grow

    count = len(partition)
    regions = Regions(partition.scaled_rows, partition.offsets, *points, laws)
    growth = Growth(
        nodes=np.zeros((4 * count + 4, 3), dtype=np.int64), parents=np.full(4 * count + 4, -1, dtype=np.int64),
        first=np.zeros(4 * count + 4, dtype=np.int64), last=np.zeros(4 * count + 4, dtype=np.int64),
        pool=np.zeros(8 * count + 8, dtype=np.int64), inside=np.zeros(8 * count + 8, dtype=np.uint64),
        leaf=np.zeros(8 * count + 8, dtype=np.int64), counts=np.array([1, 0, count, 0], dtype=np.int64),
    )  # fmt: skip
    growth.last[0] = count
    growth.pool[:count] = np.arange(count)
    growth.inside[:count] = [(1 << int(size)) - 1 for size in np.diff(points.starts)]
    bucket = 1 if count <= 2000 else 8
    status = TreeStatus.COMPLETE
    deadline = np.inf
    while True:
        full = grow(regions, growth, bucket, TESTS_AT_ONCE)
        deadline = min(deadline, time.perf_counter() + seconds)  # the first of all is compiled, which does not count
        if growth.counts[NEXT] == growth.counts[NODES]:
            break
        if full:
            longer = {name: np.concatenate([part, part]) for name, part in growth._asdict().items() if name != "counts"}
            growth = growth._replace(**longer)
        if time.perf_counter() > deadline:
            status = TreeStatus.TIME_LIMIT
            break
        waiting = growth.counts[POOL] - growth.first[growth.counts[NEXT]]
        if growth.counts[LEAF] + waiting > LEAF_ENTRIES * count + 10_000:
            status = TreeStatus.SIZE_LIMIT
            break
    nodes = growth.nodes[: growth.counts[NODES]].copy()
    leaf = growth.leaf[: growth.counts[LEAF]]
    open_nodes = np.arange(growth.counts[NEXT], growth.counts[NODES])
    if len(open_nodes):  # what was not looked at becomes a leaf as it is
        shift = len(leaf) - growth.first[open_nodes[0]]
        nodes[open_nodes] = np.column_stack([
            np.full(len(open_nodes), -1), growth.first[open_nodes] + shift, growth.last[open_nodes] + shift,
        ])  # fmt: skip
        leaf = np.concatenate([leaf, growth.pool[growth.first[open_nodes[0]] : growth.counts[POOL]]])
    inner = np.flatnonzero(nodes[:, 0] >= 0)
    planes, number, flipped = distinct_planes(partition.scaled_rows[nodes[inner, 0]])
    nodes[inner, 0] = number
    nodes[inner[flipped], 1:] = nodes[inner[flipped], :0:-1]
    return planes, nodes, leaf.copy(), status


def _largest_first(nodes: Ints, leaf: Ints, points: RegionPoints) -> Ints:
    """Leaf regions, the large ones first in each leaf."""
    counts = np.diff(points.starts)
    centres = np.repeat(points.points[points.starts[:-1]], counts, axis=0)
    radius = np.add.reduceat(np.linalg.norm(points.points - centres, axis=1), points.starts[:-1]) / counts
    leaves = nodes[nodes[:, 0] < 0]
    leaves = leaves[np.argsort(leaves[:, 1], kind="stable")]
    of_leaf = np.repeat(np.arange(len(leaves)), leaves[:, 2] - leaves[:, 1])
    return np.asarray(leaf[np.lexsort((-radius[leaf], of_leaf))])


def _border(partition: Partition, tree: SearchTree, points: RegionPoints) -> Array:
    """Facets with every region on one side and none across."""
    from mpc.explicit.kernels.search import supporting

    rows = partition.scaled_rows
    _, number, flipped = distinct_planes(rows)
    sides = np.zeros((int(number.max()) + 1, 2), dtype=bool)
    sides[number, flipped.astype(int)] = True
    one_sided = np.flatnonzero(~sides[number].all(axis=1))
    one_sided = one_sided[np.unique(number[one_sided], return_index=True)[1]]
    kept = np.zeros(len(one_sided), dtype=bool)
    shuffled = np.random.default_rng(0).permutation(points.points)  # so that most hyperplanes are dismissed early
    supporting(np.ascontiguousarray(rows[one_sided]), shuffled, kept)
    candidates = one_sided[kept]
    region = np.searchsorted(partition.offsets, candidates, side="right") - 1
    facet = points.starts[region] + 1 + candidates - partition.offsets[region]
    facet = np.minimum(facet, points.starts[region + 1] - 1)
    across = partition.centre + partition.half * (points.points[facet] + CROSSING * rows[candidates, :-1])
    return np.ascontiguousarray(rows[candidates[search(tree, partition, across)[1]]])
