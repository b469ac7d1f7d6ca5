"""The recursion stopped early: the outer set, which is not invariant, and the inner one, which is."""

from pathlib import Path

from matplotlib.figure import Figure

from invariant_sets import maximal_control_invariant_set, plot_family

A, B = [[1, 0.2], [0, 1]], [[0.02], [0.2]]
found = {
    steps: maximal_control_invariant_set(A, B, X=(-5, 5), U=(-1, 1), max_iterations=steps)
    for steps in (2, 4, 8, 12, 16, 24)
}

figure = Figure(figsize=(8, 3.6), layout="constrained")
sets, gap = figure.subplots(1, 2)
plot_family([found[8].outer, found[8].set], labels=["outer: contains the maximal set", "set: invariant"], ax=sets)
sets.set(xlabel="$x_1$ [-]", ylabel="$x_2$ [-]", title=f"stopped after 8 steps: {found[8].status.name}")
figure.legend(loc="outside lower center", ncols=2)
gap.semilogy(list(found), [result.certificate.gap for result in found.values()], "o-")
gap.set(
    xlabel="largest number of steps",
    ylabel="gap of outer and inner set [-]",
    title=f"after 24 steps: {found[24].status.name}",
)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
