"""Pictures of polytopes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from invariant_sets.exceptions import EmptySetError, InputError, UnboundedError
from invariant_sets.operations import SetOperations
from invariant_sets.tolerances import COARSE
from invariant_sets.validation import as_coordinates, as_vector

Array = np.ndarray


def plot_polytope(P: SetOperations, *, ax: Any = None, coordinates: Any = None, **style: Any) -> Any:
    """Draw a polytope and return the artist, patch or face collection.

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
    _check_drawable(P, "P")
    if ax is not None and not hasattr(ax, "add_patch"):
        raise InputError("ax", type(ax).__name__, "matplotlib Axes")
    if P.is_empty:
        raise EmptySetError("plot", "the set is empty, there is nothing to draw")
    if not P.is_bounded:
        raise UnboundedError("plot")
    shown = np.arange(min(P.dim, 3)) if coordinates is None else as_coordinates(coordinates, P.dim)
    if len(shown) > 3:
        raise InputError("coordinates", f"{len(shown)} entries", "one, two or three")
    if len(shown) != P.dim or (shown != np.arange(P.dim)).any():
        P = P.projection(shown)
    return _draw_space(P, ax, style) if P.dim == 3 else _draw_plane(P, ax, style)


def plot_family(
    sets: Iterable[SetOperations],
    *,
    values: Iterable[float] | None = None,
    labels: Iterable[str] | None = None,
    ax: Any = None,
    coordinates: Any = None,
    **style: Any,
) -> list[Any]:
    """Draw sets of several designs in colours; return the artists.

    In the plane a fill is opaque and pale, and every outline lies above all fills: the legend shows the colours that
    are seen, and no set hides another's outline. The largest set is drawn first.

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

    family = _listed(sets, "sets")
    for member in family:
        _check_drawable(member, "sets")
    numbers = np.arange(len(family), dtype=float) if values is None else as_vector(_listed(values, "values"), "values")
    names = [None] * len(family) if labels is None else _listed(labels, "labels")
    if not len(numbers) == len(names) == len(family):
        raise InputError("values, labels", f"{len(numbers)} and {len(names)} entries", f"{len(family)}, one a set")
    if not family:
        return []
    dim = min(3, family[0].dim if coordinates is None else len(as_coordinates(coordinates, family[0].dim)))
    ax = _axes(dim) if ax is None else ax
    artists = []
    spread = np.ptp(numbers) or 1.0
    colours = colormaps["viridis"](0.85 * (numbers - numbers.min()) / spread)[:, :3]  # visible on white
    for k in sorted(range(len(family)), key=lambda k: -family[k].volume):
        if not family[k].is_empty:
            fill: dict[str, Any] = {"facecolor": (*colours[k], 0.15)}  # translucent in space, opaque in the plane
            if dim < 3:
                fill = {"facecolor": tuple(0.75 + 0.25 * colours[k]), "zorder": 1}
            chosen = {"edgecolor": colours[k], **fill, "label": names[k], **style}
            artists.append(plot_polytope(family[k], ax=ax, coordinates=coordinates, **chosen))
            if dim < 3:
                outline = {"facecolor": "none", "edgecolor": colours[k], **style, "zorder": 2}
                plot_polytope(family[k], ax=ax, coordinates=coordinates, **outline)
    return artists


def _listed(values: Any, name: str) -> list[Any]:
    """Members of an iterable, or raise `InputError`."""
    try:
        return list(values)
    except TypeError:
        raise InputError(name, type(values).__name__, "one entry a set, in a list") from None


def _check_drawable(P: Any, name: str) -> None:
    """Raise `InputError` unless P is a polytope."""
    if not isinstance(P, SetOperations):
        raise InputError(name, type(P).__name__, "a Polytope")


def _axes(dim: int) -> Any:
    """New axes, three-dimensional where `dim` is 3."""
    from matplotlib import pyplot as plt

    return plt.figure().add_subplot(projection="3d" if dim == 3 else None)


def _draw_plane(P: SetOperations, ax: Any, style: dict[str, Any]) -> Any:
    """Draw a set of one or two coordinates as a patch."""
    from matplotlib.patches import Polygon

    ax = _axes(2) if ax is None else ax
    V = P.vertices if P.dim == 2 else np.column_stack([P.vertices, np.zeros(len(P.vertices))])
    patch = ax.add_patch(Polygon(V, closed=True, **{"alpha": None if "facecolor" in style else 0.4, **style}))
    ax.autoscale_view()
    return patch


def _draw_space(P: SetOperations, ax: Any, style: dict[str, Any]) -> Any:
    """Draw a set of three coordinates as a collection of faces."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    ax = _axes(3) if ax is None else ax
    V = P.vertices
    chosen = {"alpha": 0.4, "edgecolor": "k", "linewidth": 0.5, **style}
    faces = ax.add_collection3d(Poly3DCollection(_faces(P), **chosen))
    ax.auto_scale_xyz(*V.T)
    return faces


def _faces(P: SetOperations) -> list[Array]:
    """Vertices of every face of a body in space, in order."""
    V = P.vertices
    if P.affine_dim < 3:
        return [_around(V)]
    M = P.minimal()
    scale = np.abs(M.A) @ M.widths
    touching = np.abs(V @ M.A.T - M.b) <= COARSE * scale
    return [_around(V[touching[:, i]]) for i in range(len(M.b))]


def _around(V: Array) -> Array:
    """Coplanar points ordered by angle about the mean."""
    offset = V - V.mean(axis=0)
    offset = offset / np.maximum(np.ptp(V, axis=0), np.finfo(float).tiny)
    plane = np.linalg.svd(offset, full_matrices=False)[2][:2]
    x = offset @ plane.T
    return V[np.argsort(np.arctan2(x[:, -1], x[:, 0]))]
