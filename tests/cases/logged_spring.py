"""Logs of a mass on a spring whose position is measured."""

import casadi as ca
import numpy as np

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Measurement,
    Plant,
    QuadraticObjective,
    deploy,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design import kalman_filter
from ccdtools.controllers import Observed
from ccdtools.twin import OutputLog

BOX = DesignSpace(["k"], [0.5], [4.0], ["N/m"])
P = np.array([2.0])
START, RUNS, STEPS, DT = [1.0, 0.0], 40, 80, 0.33


def spring(gain=1.0, push=0.0, unit=1.0, names=(), accelerometer=False):
    """Mass on a spring, positions in a unit; with unknown entries besides: parts of the gain and of the mass."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1 + len(names))
    known = dict(zip(("k", *names), ca.vertsplit(p)))
    force = known.get("gain", gain) * known.get("second", 1.0) * u - (known["k"] * x[0] + 0.3 * x[1]) / unit
    a = force / known.get("mass", 1.0)
    box = DesignSpace(["k", *names], [0.5] + [0.2] * len(names), [4.0] + [3.0] * len(names))
    outputs = [x[0], unit * a] if accelerometer else [x[0]]
    return Plant(x, u, w, p, [x[1], unit * (a + w + push)], box, dt=DT, outputs=outputs)


def cubic(*names, c=0.0):
    """Mass on a spring that may soften and run away."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1 + len(names))
    c = p[1] if names else c
    box = DesignSpace(["k", *names], [0.5] + [-1.0] * len(names), [4.0] + [20.0] * len(names))
    rates = [x[1], -p[0] * x[0] + c * x[0] ** 3 - 0.3 * x[1] + u + w]
    return Plant(x, u, w, p, rates, box, dt=DT, substeps=2)


def stated(noise=0.05, unit=1.0, **changes):
    """Problem whose position is measured."""
    given = {
        "X": (-4 * unit, 4 * unit), "U": (-3, 3), "steps": STEPS, "limit_tolerance": "off",
        "objective": QuadraticObjective(np.eye(2) / unit**2, [[0.1]], design_cost=lambda p: 2 * p[0]),
        "scenarios": FixedStart(unit * np.array(START), Gaussian([0.3])),
        "measurement": Measurement([[1.0, 0.0]], noise=[noise * unit]),
    }  # fmt: skip
    return CoDesignProblem(discretise(spring(unit=unit)), **(given | changes))


def logged(problem, real, seed=0, law=None, x0=None, w=None):
    """Log of LQG on a real plant."""
    rng = np.random.default_rng(seed)
    law = Observed(saturated_lqr(problem, P), kalman_filter(problem, P)) if law is None else law
    w = Gaussian([0.3]).sample(RUNS, STEPS, rng) if w is None else w
    x0 = problem.scenarios.x0 if x0 is None else x0
    return deploy(real, law, P, w, x0=x0, output=problem.measurement, rng=rng)


def without_states(log):
    """What a real log holds."""
    return OutputLog(log.outputs, log.inputs, log.design)


def with_gaps(law, lost, seed, gain=0.8, every=1):
    """A log of LQR behind a filter that misses outputs, or behind one that sees what the log lost; by hand."""
    problem, rng = stated(), np.random.default_rng(seed)
    (A, B, E), (An, Bn, En) = (discretise(plant).matrices(P) for plant in (spring(gain), spring()))
    K, S = np.asarray(saturated_lqr(problem, P).K), np.zeros((2, 2))
    for _ in range(300):
        M = S[:, :1] / (S[0, 0] + 0.05**2)
        S = An @ (S - M @ S[:1]) @ An.T + 0.3**2 * En @ En.T
    M = S[:, :1] / (S[0, 0] + 0.05**2)
    missing = (rng.random((RUNS, STEPS, 1)) < lost) | (np.arange(STEPS)[:, None] % every > 0)
    x = known = np.tile(START, (RUNS, 1))
    latest = x[:, :1]
    outputs, inputs = np.zeros((2, RUNS, STEPS, 1))
    for k in range(STEPS):
        outputs[:, k] = x[:, :1] + 0.05 * rng.standard_normal((RUNS, 1))
        told = np.where(missing[:, k] & (law != "sees all"), 0.0, outputs[:, k] - known[:, :1])
        latest = np.where(missing[:, k], latest, outputs[:, k])  # the last one told, if one is lost
        answers = {"holds": -0.3 * latest, "open": rng.uniform(-1, 1, (RUNS, 1))}
        answers["louder each run"] = np.linspace(0.1, 3.0, RUNS)[:, None] * answers["open"]
        answers["pulses"] = 2 * answers["open"] * (rng.random((RUNS, 1)) < 0.05)
        feedback = -(known + told * M.T) @ K.T
        answers["holds its input"] = np.where(missing[:, k], inputs[:, k - 1], feedback)
        answers["rests"] = np.where(missing[:, k], 0.0, feedback)
        inputs[:, k] = np.clip(answers.get(law, feedback), -3, 3)
        known = (known + told * M.T) @ An.T + inputs[:, k] @ Bn.T
        x = x @ A.T + inputs[:, k] @ B.T + 0.3 * rng.standard_normal((RUNS, 1)) @ E.T
    outputs[missing] = np.nan
    return OutputLog(outputs, inputs, P)
