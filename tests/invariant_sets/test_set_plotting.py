"""Plots draw onto the axes given, return artists and show nothing."""

import matplotlib

matplotlib.use("Agg")

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from set_plants import SUSPENSION_U, SUSPENSION_X, suspension

from invariant_sets import Polytope, maximal_control_invariant_set, plot_family, plot_polytope

TRIANGLE = Polytope.from_vertices([[0, 0], [2, 0], [0, 1]])
CUBE = Polytope.from_bounds([0, 0, 0], [1, 1, 1])


@pytest.fixture
def axes():
    return Figure().add_subplot()


def area(polygon):
    x, y = polygon.T
    return 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))


def test_a_plane_set_is_one_patch_on_the_given_axes(axes):
    patch = TRIANGLE.plot(ax=axes, color="red", label="triangle")
    assert list(axes.patches) == [patch]
    assert patch.get_label() == "triangle"
    assert area(patch.get_path().vertices[:-1]) == pytest.approx(1.0)


def test_a_body_is_drawn_face_by_face():
    axes = Figure().add_subplot(projection="3d")
    faces = plot_polytope(CUBE, ax=axes)
    assert faces in axes.collections
    assert len(faces._faces if hasattr(faces, "_faces") else faces._vec) >= 6  # noqa: SLF001


def test_a_set_in_four_dimensions_is_projected(axes):
    C = maximal_control_invariant_set(*suspension((27692.0, 1906.5)), SUSPENSION_X, SUSPENSION_U).set
    patch = plot_polytope(C, ax=axes, coordinates=[0, 2])
    assert area(patch.get_path().vertices[:-1]) == pytest.approx(C.projection([0, 2]).volume, rel=1e-9)


def test_flat_and_one_dimensional_sets_are_drawn(axes):
    assert plot_polytope(Polytope.from_bounds([0, 1], [1, 1]), ax=axes)
    assert plot_polytope(Polytope.from_bounds([0], [1]), ax=axes)


def test_a_family_is_coloured_by_its_values_and_skips_empty_sets(axes):
    sets = [TRIANGLE, TRIANGLE.scale(2), Polytope.empty(2)]
    artists = plot_family(sets, values=[0.5, 3.0, 1.0], labels=["a", "b", "c"], ax=axes)
    assert [artist.get_label() for artist in artists] == ["b", "a"]
    assert len({artist.get_edgecolor() for artist in artists}) == 2


def test_new_axes_are_made_when_none_are_given():
    before = len(plt.get_fignums())
    plot_polytope(TRIANGLE)
    plot_family([CUBE])
    assert len(plt.get_fignums()) == before + 2
    plt.close("all")
