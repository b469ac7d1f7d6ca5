"""Simultaneous and nested co-design of the detailed active suspension, beside the published designs.

``python -m active_suspension.run [--road FILE] [--quick]`` from the folder ``benchmarks``. The road is `IRI_737b.mat`
of the authors' repository (see `roads.py`), from the given file or the folder CCDTOOLS_DATA; where it is absent a
synthetic road takes its place, on which the published designs are not the optimal ones. Required: both strategies
within 0.5 % of each other from every start, all rules kept, no worse than the published designs.
"""

from __future__ import annotations

import argparse

import numpy as np

from active_suspension.detailed_suspension import detailed_active_suspension
from active_suspension.independent import damping, room, rules_along, rules_of_design, simulated, stiffness  # fmt: skip
from active_suspension.roads import SOURCE, SPEED, recorded_road, recording, synthetic_road
from active_suspension.statement import GRADE, OF_RAMP, OF_ROUGH, PUBLISHED, STARTS, WEIGHTS, meshes
from active_suspension.strategies import Found, Inner, nested, simultaneous

RANDOM_STARTS = 2
PRICED = 1e-4  # of J: what is cheaper does not hold the optimum
SEARCHED, CHECKED = (200, 0.02), (500, 0.005)  # meshes: `meshes`


def ramp(t: np.ndarray) -> np.ndarray:
    """Its vertical speed [m/s]."""
    return np.full(len(t), GRADE * SPEED)


def checked(p, solution, road, published: bool) -> tuple[float, str, str]:
    """Cost of the simulated trajectories, and the tightest rules of dimensions and trajectories, apart from CasADi."""
    total, along = 0.0, {}
    for phase, speed, weight, kept in zip(solution.phases, (road, ramp), WEIGHTS, (OF_ROUGH, OF_RAMP)):
        states, cost = simulated(p, phase, speed)
        total += weight * cost
        for name, values in rules_along(p, states, published).items():
            if name in kept:
                along[name] = max(along.get(name, -np.inf), float(values.max()))
    return total, _tightest(rules_of_design(p)), _tightest(along)


def _tightest(rules: dict[str, float]) -> str:
    """The largest of them."""
    name = max(rules, key=lambda name: rules[name])
    return f"{name} {rules[name]:+.1e}"


def row(*cells: object) -> str:
    """Of a table."""
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def described(p) -> str:
    """A design, its stiffness and its damping."""
    return f"{np.array2string(np.asarray(p), precision=5, separator=', ', suppress_small=True, max_line_width=200)}"


def evaluated(plant, road, published: bool) -> dict[str, float]:
    """Optimal trajectories at the published designs, as printed and with their rounding put right."""
    print(row("design", "J", "violation", "tightest of dimensions", "k_s [N/m]", "c_s [N·s/m]", "L0 − Ls [m]"))
    print(row(*["---"] * 7))
    inner, costs = Inner(plant, road, PUBLISHED["simultaneous"], meshes(*SEARCHED)), {}
    for name, printed in PUBLISHED.items():
        for what, p in (("as printed", np.array(printed)), ("nearest allowed", plant.design.project(printed))):
            solution = inner.at(p)
            costs[f"{name}, {what}"] = solution.cost
            print(row(f"{name}, {what}", f"{solution.cost:.5f}", f"{plant.design.violation(p):.1e}",
                      _tightest(rules_of_design(p)), f"{stiffness(p):.0f}", f"{damping(p):.1f}",
                      f"{room(p):.5f}"), flush=True)  # fmt: skip
    return costs


def searched(plant, road, published: bool, starts) -> list[Found]:
    """Both strategies from every start, each checked by simulation."""
    print(row("start", "strategy", "J", "J simulated", "tightest of dimensions", "tightest along the way", "design",
              "k_s", "c_s", "solves", "s", "status"))  # fmt: skip
    print(row(*["---"] * 12))
    every = []
    for name, start in starts.items():
        for strategy in (simultaneous, nested):
            found = strategy(plant, road, start, meshes(*SEARCHED))
            cost, of_design, along = checked(found.p, found.solution, road, published)
            print(row(name, strategy.__name__, f"{found.solution.cost:.6f}", f"{cost:.6f}", of_design, along,
                      described(found.p), f"{stiffness(found.p):.0f}", f"{damping(found.p):.1f}", found.solves,
                      f"{found.seconds:.0f}", found.solution.status.name), flush=True)  # fmt: skip
            every.append(found)
    return every


def refined(plant, road, found: Found, published: bool) -> str:
    """The cost of a design on a fine mesh, and what is tightest along the way there."""
    solution = Inner(plant, road, found.p, meshes(*CHECKED)).at(found.p)
    cost, _, along = checked(found.p, solution, road, published)
    return f"J {solution.cost:.6f}, simulated {cost:.6f}, {along}"


def prices(plant, found: Found) -> str:
    """Rules that hold a simultaneous optimum, and how much J would fall if each gave way, in J for the whole of it."""
    program, paid = found.solution.program, found.solution.multipliers["rows"]
    total: dict[str, float] = {}
    for rows in program.rows:
        values = paid[rows.first : rows.last]
        if rows.name == "p_constraints":
            names = list(plant.design.constraint_names)
        elif rows.name == "path":
            wanted, case = ((OF_ROUGH, "rough road"), (OF_RAMP, "ramp"))[rows.phase]
            names = [f"{name}, {case}" for name in plant.output_names if name.startswith(wanted)]
        else:
            continue
        for i, name in enumerate(names):
            total[name] = total.get(name, 0.0) + float(values[i :: len(names)].sum())
    held = sorted((-price, name) for name, price in total.items() if price > PRICED * found.solution.cost)
    return "; ".join(f"{name} {-price:.3f}" for price, name in held)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--road", help=f"IRI_737b.mat, of {SOURCE}")
    parser.add_argument("--quick", action="store_true", help="two starts, the published statement alone")
    given = parser.parse_args()
    path = recording(given.road)
    if given.road and path is None:
        parser.error(f"there is no file {given.road}")
    road = synthetic_road() if path is None else recorded_road(path)
    print("Road: " + (f"synthetic; the recorded one is {SOURCE}/IRI_737b.mat" if path is None else path.name))
    for published in (True,) if given.quick else (True, False):
        plant = detailed_active_suspension(published=published)
        print("\n## " + ("The published statement" if published else "Limits of travel as the strut gets shorter"))
        starts = dict(STARTS)
        rng = np.random.default_rng(2021)
        for i, drawn in enumerate(plant.design.latin_hypercube(RANDOM_STARTS, rng)):
            starts[f"random, {i + 1}"] = tuple(plant.design.project(drawn))
        costs = evaluated(plant, road, published)
        print()
        few = list(starts.items())[:: 5 if published else 3]
        every = searched(plant, road, published, dict(few) if given.quick or not published else starts)
        found = np.array([one.solution.cost for one in every])
        kept = min(cost for name, cost in costs.items() if "allowed" in name)
        print(f"\nSpread of J over strategies and starts: {np.ptp(found) / found.min():.1e}")
        print(f"Best published design, allowed: {kept:.6f}; worst found: {found.max():.6f}")
        print(f"What holds it, and its price: {prices(plant, every[0])}")
        print(f"The first design on a fine mesh: {refined(plant, road, every[0], published)}")


if __name__ == "__main__":
    main()
