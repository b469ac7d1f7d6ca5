"""Data of the compiled exploration, with names: numba takes named tuples of arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array

Ints = np.ndarray[Any, np.dtype[np.int64]]
Bits = np.ndarray[Any, np.dtype[np.uint64]]
Flags = np.ndarray[Any, np.dtype[np.bool_]]

KNOWN, QUEUED, DONE, ROWS = range(4)  # positions in `Graph.counts`
# what is known about an active set, FLAT: its region is empty or of lower dimension; INFEASIBLE: there is none
FULL, FLAT, DEPENDENT, INFEASIBLE = range(4)


class QPData(NamedTuple):
    """Minimise ½|v|² subject to Mv <= D [t; 1] for t in {TA t <= Tb}. Rows of M and TA have unit length.

    M : (m, nz); D : (m, nt + 1); tie : (m,) shift of the bounds that decides between active sets which are optimal
    together; gram : (m, m), MM'; TA, Tb : the parameter set.
    """

    M: Array
    D: Array
    tie: Array
    gram: Array
    TA: Array
    Tb: Array


class Graph(NamedTuple):
    """Active sets met so far, and the regions among them.

    masks : (capacity, words) bits of each active set; kinds : what is known about each; table : hash table of their
    numbers; queue : numbers of those with a region, in the order found; counts : sets KNOWN, regions QUEUED, regions
    DONE, facet ROWS stored.
    """

    masks: Bits
    kinds: np.ndarray[Any, np.dtype[np.int8]]
    table: Ints
    queue: Ints
    counts: Ints


class Facets(NamedTuple):
    """Facets of the regions done: region r owns rows[offsets[r] : offsets[r + 1]], each [a, b] for a't <= b.

    centres : a point inside each region; hits : a point on each facet, inside the region where none was met; behind :
    what is known of the active set behind it. FULL: it led to a region; FLAT: it led nowhere; INFEASIBLE: nothing is to
    be found there, it is the border of the parameter set, infeasibility is proven or the QP was solved beyond it.
    """

    offsets: Ints
    rows: Array
    centres: Array
    hits: Array
    behind: np.ndarray[Any, np.dtype[np.int8]]


class RegionData(NamedTuple):
    """A region in {At <= b}, row i for constraint i and then the parameter set.

    mask, members : its active set, as bits and as numbers; facets : rows that are facets; hits : point where a ray from
    the interior met each of them; centre, radius : a ball inside.
    """

    mask: Bits
    members: Ints
    A: Array
    b: Array
    facets: Ints
    hits: Array
    centre: Array
    radius: float
