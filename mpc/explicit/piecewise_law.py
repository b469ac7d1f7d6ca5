"""What is stored, drawn and written as C: a piecewise affine law, whatever class holds it."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from numpy.typing import ArrayLike

from mpc.checks import Array
from mpc.explicit.partition import Ints, MPQPStatus, Partition
from mpc.explicit.search_tree import SearchTree


class LawParts(NamedTuple):
    """The parts of an explicit law, see `ExplicitMPC`."""

    partition: Partition
    tree: SearchTree
    law: Array
    law_number: Ints
    input_rows: tuple[Array, Array]


class PiecewiseLaw(Protocol):
    """An explicit law, see `ExplicitMPC`."""

    @property
    def partition(self) -> Partition:
        """Regions and the law of the whole input sequence."""

    @property
    def tree(self) -> SearchTree:
        """Finds the region of a parameter."""

    @property
    def law(self) -> Array:
        """First input law[r] [θ; 1], (n_regions, nu, nt + 1)."""

    @property
    def law_number(self) -> Ints:
        """Regions of equal number share their law, (n_regions,)."""

    @property
    def input_rows(self) -> tuple[Array, Array]:
        """(H, h) of the input set {u : Hu <= h}."""

    @property
    def status(self) -> MPQPStatus:
        """Whether the partition is complete."""

    @property
    def nu(self) -> int:
        """Number of inputs."""

    @property
    def nt(self) -> int:
        """Number of parameters."""

    def __len__(self) -> int: ...

    def evaluate(self, theta: ArrayLike) -> tuple[Array, Any]:
        """First input and whether the parameter lies outside."""

    def value(self, theta: ArrayLike) -> Array:
        """Optimal cost."""
