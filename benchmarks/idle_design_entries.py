"""Design entries that enter nowhere, or only together: how many of so many random plants are named, and what is blamed.

python benchmarks/idle_design_entries.py [PLANTS]
"""

import sys

import casadi as ca
import numpy as np

import ccdtools as cc
from ccdtools.co_design.idle_entries import acting_together
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

TOGETHER = (  # of two entries of size one, so that each is free beside the other
    lambda k, q: k * q, lambda k, q: k / q, lambda k, q: k + q, lambda k, q: ca.sqrt(k) * q**2,
    lambda k, q: ca.exp(k) * ca.exp(q), lambda k, q: ca.sin(k * q),
)  # fmt: skip
SPLIT = ("dynamics", "stage_cost", "terminal_cost", "design_cost", "U", "constraints")


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


def told(number: int, split: str = "") -> str:
    """What is said of the entries k, q and m of a random plant."""
    return acting_together(joint(number, split))


def joint(number: int, split: str = "") -> cc.CoDesignProblem:
    """A random plant whose entries k and q act only together, but for the place `split`.

    A third entry m acts alone.
    """
    rng = np.random.default_rng(number)
    nx, size = int(rng.integers(1, 4)), 10.0 ** rng.integers(-3, 6, 3)
    x, u, w, p = ca.SX.sym("x", nx), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 3)
    of = TOGETHER[number % len(TOGETHER)]
    stretch = 10.0 ** rng.integers(-3, 4)

    def together(p):
        """What k and q are together."""
        return of(p[0] / size[0], p[1] / size[1])

    def apart(p, place):
        """What q is alone, at the place where it acts so."""
        return p[1] / size[1] if split == place else 1

    rate = (0.2 * rng.standard_normal((nx, nx)) - np.eye(nx)) @ x + rng.standard_normal((nx, 1)) @ u
    rate += w * p[2] / size[2]
    linear = bool(rng.random() < 0.5)
    rate += 0.1 * together(p) * (x if linear else x**3 / stretch**2) * apart(p, "dynamics")
    rate += 0 if linear else 0.1 * ca.sin(together(p) * x[0] / stretch) * stretch
    constraints = (lambda p: apart(p, "constraints") - 1.9) if split == "constraints" else None
    space = cc.DesignSpace(["k", "q", "m"], size, 2 * size, constraints=constraints)
    plant = cc.Plant(x, u, w, p, rate if linear else x + 0.05 * rate, space, dt=0.05, continuous=linear)
    objective = cc.CustomObjective(
        lambda x, u, p: ca.sumsqr(x) * apart(p, "stage_cost") + ca.sumsqr(u),
        lambda x, p: ca.sumsqr(x) * apart(p, "terminal_cost"),
        design_cost=lambda p: together(p) + p[2] / size[2] * apart(p, "design_cost"),
    )
    model = cc.discretise(plant, X=(-stretch, stretch), U=(-1, 1), W=(-2, 2), sampling_guard="ignore")
    return cc.CoDesignProblem(
        model, X=(-stretch, stretch), U=(lambda p: (-apart(p, "U"), apart(p, "U"))) if split == "U" else (-1, 1),
        objective=objective, steps=5, scenarios=cc.FixedStart(np.zeros(nx), cc.Gaussian([0.01])),
    )  # fmt: skip


def main() -> None:
    """Print the counts."""
    plants = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{sum(named(k, False) for k in range(plants))} of {plants} idle entries named")
    print(f"{sum(named(k, True) for k in range(plants))} of {plants} entries that act blamed")
    pairs = [told(k) for k in range(plants)]
    print(f"{sum(text.startswith('k, q act only together, in 1 of 2') for text in pairs)} of {plants} pairs named")
    apart = [told(k, SPLIT[k % len(SPLIT)]) for k in range(plants)]
    print(f"{sum(map(bool, apart))} of {plants} pairs blamed that act apart somewhere")
    wrong = 0
    for name in study_names():
        try:
            wrong += bool(acting_together(cc.load_study(name).problem()))
        except cc.InputError as error:
            wrong += error.argument == "model.design"
    print(f"{wrong} of {len(study_names())} studies blamed")


if __name__ == "__main__":
    main()
