"""Minkowski sum and Pontryagin difference of a polygon and a square: they do not undo each other."""

from pathlib import Path

from matplotlib.figure import Figure

from invariant_sets import Polytope, plot_family

P = Polytope.from_vertices([[-3, -2], [3, -2], [4, 1], [0, 3], [-3, 2]])
Q = Polytope.from_bounds([-1, -1], [1, 1])
difference = P.pontryagin_difference(Q)

figure = Figure(figsize=(7.5, 3.4), layout="constrained")
one, two = figure.subplots(1, 2, sharex=True, sharey=True)
plot_family([P.minkowski_sum(Q), P, difference], labels=["P ⊕ Q", "P", "P ⊖ Q"], ax=one)
plot_family([P, difference.minkowski_sum(Q)], labels=["P", "(P ⊖ Q) ⊕ Q"], ax=two)
for ax in (one, two):
    ax.set(xlabel="$x_1$ [-]", ylabel="$x_2$ [-]", aspect="equal", ylim=(-5, 4.5))
    ax.legend(loc="lower center", ncols=3)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
