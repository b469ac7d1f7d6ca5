"""Point location: a binary tree of hyperplanes that ends in the regions a parameter can lie in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.explicit.mpqp import Partition

Ints = np.ndarray[Any, np.dtype[np.int64]]
_INSIDE = 1e-7  # a parameter this far outside, scaled to [-1, 1], still counts as inside


@dataclass(frozen=True, eq=False, repr=False)
class SearchTree:
    """Binary search tree over a partition, in scaled parameters t.

    Attributes
    ----------
    planes : (n_planes, nt + 1) array
        Hyperplanes a't = b as rows [a, b].
    nodes : (n_nodes, 3) int array
        Inner node: hyperplane, child where a't <= b, child where a't > b. Leaf: -1 and its slice of `leaf_regions`.
    leaf_regions : int array
        Regions of the leaves; those of one leaf share their law wherever hyperplanes can tell regions apart.
    border : (n_border, nt + 1) array
        Facets [a, b] that have every region on their side a't <= b: what violates one is outside.
    """

    planes: Array
    nodes: Ints
    leaf_regions: Ints
    border: Array

    @property
    def depth(self) -> int:
        """Largest number of hyperplanes evaluated."""
        level = np.zeros(len(self.nodes), dtype=np.int64)
        for node, (plane, below, above) in enumerate(self.nodes):  # children come after their parent
            if plane >= 0:
                level[[below, above]] = level[node] + 1
        return int(level.max(initial=0))

    def __repr__(self) -> str:
        return f"SearchTree({len(self.nodes)} nodes, depth {self.depth}, {len(self.planes)} hyperplanes)"


def build_tree(partition: Partition, laws: Ints) -> SearchTree:
    """Search tree in which every leaf holds regions of one law.

    Parameters
    ----------
    partition : Partition
        At least one region.
    laws : (n_regions,) int array
        Number of each region's law; regions of the same law need not be told apart.

    References
    ----------
    Tøndel, Johansen and Bemporad, *Evaluation of piecewise affine control via binary search tree*, Automatica 39(5),
    2003. Hyperplanes are chosen by the sides of whole regions; a child keeps the regions that meet its polytope.
    """
    from mpc.explicit.kernels import search as kernels

    rows = partition.scaled_rows
    planes = distinct_planes(rows)
    centres = kernels.centres_of(rows, partition.offsets)
    side = sides_of_regions(partition, planes, centres)
    border = np.vstack([planes[(side == 1).all(axis=1)], -planes[(side == 2).all(axis=1)]])
    splitting = np.flatnonzero(((side == 1).any(axis=1)) & ((side == 2).any(axis=1)))
    side, planes = np.ascontiguousarray(side[splitting]), np.ascontiguousarray(planes[splitting])
    nodes, leaf = kernels.grow(side, laws, planes, rows, partition.offsets, centres, 256 * len(partition) + 1)
    used = np.unique(nodes[nodes[:, 0] >= 0, 0])
    renumber = np.full(len(splitting) + 1, -1, dtype=np.int64)
    renumber[used] = np.arange(len(used))
    nodes[:, 0] = renumber[nodes[:, 0]]
    return SearchTree(np.ascontiguousarray(planes[used]), nodes, leaf, border)


def sides_of_regions(
    partition: Partition, planes: Array, centres: Array | None = None
) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """On which side of each hyperplane each region lies, (n_planes, n_regions): 1 below, 2 above, 3 both."""
    from mpc.explicit.kernels import search as kernels

    rows = partition.scaled_rows
    centres = kernels.centres_of(rows, partition.offsets) if centres is None else centres
    side: np.ndarray[Any, np.dtype[np.uint8]] = kernels.sides(rows, partition.offsets, centres, planes, 1e-9)
    return side


def distinct_planes(rows: Array) -> Array:
    """Rows up to sign, each once."""
    leading = np.argmax(np.abs(rows[:, :-1]) > 1e-6, axis=1)
    signed = rows * np.sign(rows[np.arange(len(rows)), leading])[:, None]
    _, first = np.unique(np.round(signed, 8) + 0.0, axis=0, return_index=True)
    return np.ascontiguousarray(signed[np.sort(first)])


def locate(tree: SearchTree, partition: Partition, points: Array) -> tuple[Ints, np.ndarray[Any, np.dtype[np.bool_]]]:
    """Region of every scaled point (n, nt) and whether the point lies outside the partition.

    An outside point gets a region near by.
    """
    from mpc.explicit.kernels import search as kernels

    rows = partition.scaled_rows
    region, distance = np.empty(len(points), dtype=np.int64), np.empty(len(points))
    kernels.locate(
        points, tree.planes, tree.nodes, tree.leaf_regions, tree.border, rows, partition.offsets, _INSIDE, region,
        distance,
    )  # fmt: skip
    lost = np.flatnonzero((distance > _INSIDE) & ((distance < np.inf) | (region < 0)))
    if len(lost):  # within the border, or in a leaf without regions: look at every region
        everywhere = np.array([[-1, 0, len(partition)]], dtype=np.int64)
        found, gap = np.empty(len(lost), dtype=np.int64), np.empty(len(lost))
        every = np.arange(len(partition), dtype=np.int64)
        kernels.locate(points[lost], tree.planes, everywhere, every, tree.border[:0], rows, partition.offsets, _INSIDE,
                       found, gap)  # fmt: skip
        region[lost], distance[lost] = found, gap
    return region, distance > _INSIDE
