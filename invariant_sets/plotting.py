"""Pictures of polytopes; the only module here that imports matplotlib."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from invariant_sets.exceptions import EmptySetError, InputError, UnboundedError
from invariant_sets.polytope import Polytope

Array = np.ndarray


def plot_polytope(P: Polytope, *, ax: Any = None, coordinates: Any = None, **style: Any) -> Any:
    """Draw a polytope and return the artist: a patch in the plane, a face collection in space.

    Parameters
    ----------
    P : Polytope
        Bounded and not empty.
    ax : matplotlib Axes, optional
        Where to draw; three-dimensional for three coordinates. A new one if left out.
    coordinates : sequence of one, two or three ints, optional
        Coordinates to project on; the first three at most if left out.
    **style
        Passed to the artist, for example color, alpha, label.

    Raises
    ------
    InputError, EmptySetError, UnboundedError
    """
    if not isinstance(P, Polytope):
        raise InputError(f"P must be a Polytope, got {type(P).__name__}.")
    if P.is_empty:
        raise EmptySetError("The set is empty; there is nothing to draw.")
    if not P.is_bounded:
        raise UnboundedError("The set is unbounded; intersect it with a box before drawing it.")
    shown = np.arange(min(P.dim, 3)) if coordinates is None else np.atleast_1d(coordinates)
    if len(shown) > 3:
        raise InputError(f"coordinates has {len(shown)} entries, expected one, two or three.")
    if len(shown) != P.dim or (shown != np.arange(P.dim)).any():
        P = P.projection(shown)
    return _draw_space(P, ax, style) if P.dim == 3 else _draw_plane(P, ax, style)


def plot_family(sets: Iterable[Polytope], *, values: Iterable[float] | None = None, labels: Iterable[str] | None = None,
                ax: Any = None, coordinates: Any = None, **style: Any) -> list[Any]:
    """Draw sets of several designs in colours ordered by `values`, largest first, and return the artists.

    Parameters
    ----------
    sets : iterable of Polytope
        One a design; empty ones are skipped.
    values : iterable of float, optional
        One a set, mapped to colours; their order if left out.
    labels : iterable of str, optional
        Legend entries.
    ax, coordinates, **style
        As in `plot_polytope`.
    """
    from matplotlib import colormaps

    family = list(sets)
    numbers = np.arange(len(family), dtype=float) if values is None else np.array(list(values), dtype=float)
    names = [None] * len(family) if labels is None else list(labels)
    if not len(numbers) == len(names) == len(family):
        raise InputError(f"values and labels have {len(numbers)} and {len(names)} entries, expected {len(family)}.")
    if not family:
        return []
    spread = np.ptp(numbers) or 1.0
    colours = colormaps["viridis"]((numbers - numbers.min()) / spread)
    if ax is None:
        dim = family[0].dim if coordinates is None else len(np.atleast_1d(coordinates))
        ax = _axes(min(dim, 3))
    artists = []
    for k in sorted(range(len(family)), key=lambda k: -family[k].volume):
        if not family[k].is_empty:
            chosen = {"facecolor": (*colours[k][:3], 0.15), "edgecolor": colours[k], "label": names[k], **style}
            artists.append(plot_polytope(family[k], ax=ax, coordinates=coordinates, **chosen))
    return artists


def _axes(dim: int) -> Any:
    from matplotlib import pyplot as plt

    return plt.figure().add_subplot(projection="3d" if dim == 3 else None)


def _draw_plane(P: Polytope, ax: Any, style: dict[str, Any]) -> Any:
    from matplotlib.patches import Polygon

    ax = _axes(2) if ax is None else ax
    V = P.vertices if P.dim == 2 else np.column_stack([P.vertices, np.zeros(len(P.vertices))])
    patch = ax.add_patch(Polygon(V, closed=True, **{"alpha": None if "facecolor" in style else 0.4, **style}))
    ax.autoscale_view()
    return patch


def _draw_space(P: Polytope, ax: Any, style: dict[str, Any]) -> Any:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    ax = _axes(3) if ax is None else ax
    V = P.vertices
    chosen = {"alpha": 0.4, "edgecolor": "k", "linewidth": 0.5, **style}
    faces = ax.add_collection3d(Poly3DCollection(_faces(P), **chosen))
    ax.auto_scale_xyz(*V.T)
    return faces


def _faces(P: Polytope) -> list[Array]:
    """Return the vertices of every face of a body in space, in order around the face."""
    V = P.vertices
    if P.affine_dim < 3:
        return [_around(V)]
    M = P.minimal()
    scale = M._row_scales[0]
    touching = np.abs(V @ M.A.T - M.b) <= 1e-7 * scale
    return [_around(V[touching[:, i]]) for i in range(len(M.b))]


def _around(V: Array) -> Array:
    """Return coplanar points in the order of their angle about the mean."""
    offset = V - V.mean(axis=0)
    plane = np.linalg.svd(offset, full_matrices=False)[2][:2]
    x = offset @ plane.T
    return V[np.argsort(np.arctan2(x[:, -1], x[:, 0]))]
