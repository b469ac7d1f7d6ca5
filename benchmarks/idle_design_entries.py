"""Design entries that enter nowhere: how many of so many random plants are named, and whether a study is blamed.

python benchmarks/idle_design_entries.py [PLANTS]
"""

import sys

import casadi as ca
import numpy as np

import ccdtools as cc
from ccdtools.studies.options import study_names

DISGUISES = (  # of an entry q that changes nothing, beside x (nx,)
    lambda q, x: ca.SX(0),
    lambda q, x: 0 * q * x[0],
    lambda q, x: (q + x[0]) - (x[0] + q),
    lambda q, x: x[-1] * (q / q - 1),
    lambda q, x: (ca.sin(q) ** 2 + ca.cos(q) ** 2 - 1) * x[0],
    lambda q, x: (ca.fabs(q) - ca.fmax(q, -q)) * x[0],
)
PLACES = ("dynamics", "stage_cost", "terminal_cost", "design_cost", "X", "U", "outputs", "constraints")


def problem(rng: np.random.Generator, place: str, acts: bool) -> cc.CoDesignProblem:
    """A random co-design of one to three useful entries and one named idle, which acts at one place or nowhere."""
    nx, nu, used = int(rng.integers(1, 5)), int(rng.integers(1, 3)), int(rng.integers(1, 4))
    linear = rng.random() < 0.5
    size = 10.0 ** rng.integers(-3, 6, used + 1)
    x, u, w, p = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("w"), ca.SX.sym("p", used + 1)
    idle = int(rng.integers(used + 1))
    weak = sum(p[i] / size[i] * (0.1 * rng.standard_normal((nx, nx)) @ x) for i in range(used + 1) if i != idle)
    stretch = 10.0 ** rng.integers(-3, 4)  # of the states
    rate = (0.3 * rng.standard_normal((nx, nx)) - np.eye(nx)) @ x + rng.standard_normal((nx, nu)) @ u + w + weak
    linear = bool(rng.random() < 0.5)
    rate = rate if linear else rate - x**3 / stretch**2
    names = [f"p{i}" if i != idle else "idle" for i in range(used + 1)]
    at = {name: acts and place == name for name in PLACES}

    def own(p):
        """The idle entry, in its own size."""
        return p[idle] / size[idle]

    dynamics = rate + (0.01 * own(p) * x if at["dynamics"] else DISGUISES[rng.integers(len(DISGUISES))](p[idle], x))
    constraints = (lambda p: own(p) - 1.9) if at["constraints"] else None
    space = cc.DesignSpace(names, size, 2 * size, constraints=constraints)
    dynamics = dynamics if linear else x + 0.05 * dynamics
    plant = cc.Plant(x, u, w, p, dynamics, space, dt=0.05, continuous=linear)
    objective = cc.CustomObjective(
        lambda x, u, p: (own(p) if at["stage_cost"] else 1) * ca.sumsqr(x) + ca.sumsqr(u),
        (lambda x, p: own(p) * ca.sumsqr(x)) if at["terminal_cost"] else None,
        design_cost=own if at["design_cost"] else None,
    )
    box = {"X": stretch * np.ones(nx), "U": np.ones(nu)}
    limits = {name: (lambda p, h=h: (-h * own(p), h * own(p))) if at[name] else (-h, h) for name, h in box.items()}
    outputs = cc.OutputLimits(lambda x, u, p: x[0] - 9 * stretch * own(p)) if at["outputs"] else None
    model = cc.discretise(plant, X=(-stretch, stretch), U=(-1, 1), W=(-0.1, 0.1), sampling_guard="ignore")
    scenarios = cc.FixedStart(np.zeros(nx), cc.Gaussian([0.01]))
    return cc.CoDesignProblem(model, **limits, objective=objective, steps=5, scenarios=scenarios, output_limits=outputs)


def named(number: int, acts: bool) -> bool:
    """Whether the idle entry of a random plant is named; any other refusal is an error of this script."""
    rng = np.random.default_rng(number)
    try:
        problem(rng, PLACES[number % len(PLACES)], acts)
    except cc.InputError as error:
        if not str(error).startswith("model.design: got the entry idle,"):
            raise
        return True
    return False


def main() -> None:
    """Print the counts."""
    plants = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{sum(named(k, False) for k in range(plants))} of {plants} idle entries named")
    print(f"{sum(named(k, True) for k in range(plants))} of {plants} entries that act blamed")
    wrong = 0
    for name in study_names():
        try:
            cc.load_study(name).problem()
        except cc.InputError as error:
            wrong += error.argument == "model.design"
    print(f"{wrong} of {len(study_names())} studies blamed")


if __name__ == "__main__":
    main()
