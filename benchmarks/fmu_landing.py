"""Study of a car that lands on its bump stops; the real car is an FMU, packed here from C.

    python benchmarks/study_methods.py --studies benchmarks/fmu_landing.py     methods beside each other
    python benchmarks/fmu_landing.py                       a bound, and a design of the FMU itself, without a model

A quarter car falls from 3 to 8 cm onto a rough road; spring and damper are the design, and the input is damping beside
that of the damper. The model knows bump stops. The real car is heavier, its stops come sooner, are harder and lose
energy, and its strut has dry friction. The FMU is held against the same equations in CasADi, which give the bound:
plans that know how each run begins and the road.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.optimize import minimize

import ccdtools as cc
from ccdtools.disturbances import Uniform
from ccdtools.plants import from_fmu

DT, STEPS = 0.01, 100  # s, samples
LEAST, MOST = -1.0, 2.0  # damping beside the damper's [kN·s/m]
DESIGN = cc.DesignSpace(["k_s", "c_s"], [12e3, 1300.0], [40e3, 3000.0], ["N/m", "N·s/m"])
FIRST = np.array([20e3, 1500.0])
HEIGHTS = Uniform([0, -1.25, 0, -1.25], [0, -0.77, 0, -0.77])  # speeds of falls [m/s]
ROAD = cc.Gaussian([0.3])  # m/s

SOURCE = """
#include <math.h>
#include <stdlib.h>
#include <string.h>
#define OK 0
#define ERROR 3
typedef void *component;
typedef struct { int needed, terminate, nominals, values, defined; double next; } event_info;
enum { STRUT, BODY, TYRE, WHEEL, D1, D2, D3, D4, DAMPING, ROAD, SPRING, DAMPER, SIZE };
#define EXPORT __attribute__((visibility("default")))
static void start(double *v) { memset(v, 0, SIZE * sizeof *v); v[SPRING] = 2e4; v[DAMPER] = 1.5e3; }
EXPORT component fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *f, int a, int b)
{
    double *v = malloc(SIZE * sizeof *v);
    (void)n; (void)t; (void)g; (void)r; (void)f; (void)a; (void)b;
    start(v);
    return v;
}
EXPORT void fmi2FreeInstance(component c) { free(c); }
EXPORT int fmi2Reset(component c) { start(c); return OK; }
EXPORT int fmi2SetupExperiment(component c, int a, double b, double d, int e, double f)
{ (void)c; (void)a; (void)b; (void)d; (void)e; (void)f; return OK; }
EXPORT int fmi2NewDiscreteStates(component c, event_info *e) { (void)c; memset(e, 0, sizeof *e); return OK; }
EXPORT int fmi2SetReal(component c, const unsigned r[], size_t n, const double x[])
{ for (size_t i = 0; i < n; i++) ((double *)c)[r[i]] = x[i]; return OK; }
EXPORT int fmi2GetReal(component c, const unsigned r[], size_t n, double x[])
{ for (size_t i = 0; i < n; i++) x[i] = ((double *)c)[r[i]]; return OK; }
EXPORT int fmi2SetContinuousStates(component c, const double x[], size_t n) { memcpy(c, x, n * sizeof *x); return OK; }
EXPORT int fmi2GetContinuousStates(component c, double x[], size_t n) { memcpy(x, c, n * sizeof *x); return OK; }
EXPORT int fmi2GetDerivatives(component c, double dx[], size_t n)
{
    const double *v = c, speed = v[BODY] - v[WHEEL], over = fabs(v[STRUT]) - 0.035;
    double strut = v[SPRING] * v[STRUT] + (v[DAMPER] + 1e3 * v[DAMPING]) * speed + 60 * tanh(speed / 0.02);
    if (n != 4) return ERROR;
    if (over > 0) {
        const double side = v[STRUT] > 0 ? 1 : -1, loss = 1 + 0.5 * side * speed;
        strut += side * 1.5e7 * over * over * (loss > 0 ? loss : 0);
    }
    dx[0] = speed;
    dx[1] = -strut / 420;
    dx[2] = v[WHEEL] - v[ROAD];
    dx[3] = (strut - 2e5 * v[TYRE]) / 40;
    return OK;
}
#define FINE(name) EXPORT int name(component c) { (void)c; return OK; }
#define NOTHING(name) EXPORT int name(void) { return ERROR; }
FINE(fmi2EnterInitializationMode) FINE(fmi2ExitInitializationMode) FINE(fmi2EnterContinuousTimeMode)
FINE(fmi2EnterEventMode) FINE(fmi2Terminate)
NOTHING(fmi2GetInteger) NOTHING(fmi2SetInteger) NOTHING(fmi2GetBoolean) NOTHING(fmi2SetBoolean) NOTHING(fmi2GetString)
NOTHING(fmi2SetString) NOTHING(fmi2GetFMUstate) NOTHING(fmi2SetFMUstate) NOTHING(fmi2FreeFMUstate)
NOTHING(fmi2SerializedFMUstateSize) NOTHING(fmi2SerializeFMUstate) NOTHING(fmi2DeSerializeFMUstate)
NOTHING(fmi2GetDirectionalDerivative) NOTHING(fmi2SetDebugLogging) NOTHING(fmi2CompletedIntegratorStep)
NOTHING(fmi2SetTime) NOTHING(fmi2GetEventIndicators) NOTHING(fmi2GetNominalsOfContinuousStates)
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
"""
VARIABLE = '<ScalarVariable name="{}" valueReference="{}" causality="{}"><Real{}/></ScalarVariable>'
STATES = ("strut", "body", "tyre", "wheel")


def description() -> str:
    """XML of the FMU."""
    rows = [VARIABLE.format(name, i, 'local" initial="exact', ' start="0"') for i, name in enumerate(STATES)]
    rows += [VARIABLE.format(f"der_{name}", 4 + i, "local", f' derivative="{1 + i}"') for i, name in enumerate(STATES)]
    rows += [VARIABLE.format(name, 8 + i, "input", ' start="0"') for i, name in enumerate(("damping", "road"))]
    rows += [VARIABLE.format(name, 10 + i, 'parameter" variability="fixed', f' start="{value:g}"')
             for i, (name, value) in enumerate(zip(DESIGN.names, FIRST))]  # fmt: skip
    known = "".join(f'<Unknown index="{5 + i}"/>' for i in range(4))
    return (
        '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="car" guid="{d2}" '
        'numberOfEventIndicators="0"><ModelExchange modelIdentifier="car"/><ModelVariables>'
        f"{''.join(rows)}</ModelVariables><ModelStructure><Derivatives>{known}</Derivatives></ModelStructure>"
        "</fmiModelDescription>"
    )


def packed() -> Path:
    """FMU of the real car, compiled into a folder that goes with the process."""
    from fmpy import platform

    folder = Path(FOLDER.name)
    (folder / "car.c").write_text(SOURCE)
    compiler = shutil.which("gcc") or shutil.which("cc")
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "car.c", "-o", "car.so", "-lm"], cwd=folder, check=True)
    with zipfile.ZipFile(folder / "car.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", description())
        archive.write(folder / "car.so", f"binaries/{platform}/car.so")
    return folder / "car.fmu"


def strut_force(x, u, p, *, real: bool):
    """Force of spring, damper and stops on the body, downwards [N]."""
    speed, over = x[1] - x[3], ca.fmax(ca.fabs(x[0]) - (0.035 if real else 0.04), 0)
    side = ca.sign(x[0])
    stop = side * (1.5e7 * ca.fmax(1 + 0.5 * side * speed, 0) if real else 1e7) * over**2
    return p[0] * x[0] + (p[1] + 1000 * u[0]) * speed + stop + (60 * ca.tanh(speed / 0.02) if real else 0)


def car(*, real: bool = False) -> cc.Plant:
    """Quarter car: strut [m], body [m/s], tyre [m] and wheel [m/s], as a model or as the FMU has it."""
    x, u, w, p = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    force = strut_force(x, u, p, real=real)
    rates = [x[1] - x[3], -force / (420 if real else 380), x[3] - w, (force - 2e5 * x[2]) / 40]
    return cc.Plant(x, u, w, p, rates, DESIGN, dt=DT, substeps=2)


def stage_cost(x, u, p):
    """Felt acceleration by spring and damper, load of the tyre, travel beyond 3 cm, and a little of the input."""
    felt = (p[0] * x[0] + (p[1] + 1000 * u[0]) * (x[1] - x[3])) / 380
    beyond = ca.fmax(ca.fabs(x[0]) - 0.03, 0)
    return (felt / 3) ** 2 + (x[2] / 0.02) ** 2 + (beyond / 0.01) ** 2 + (x[0] / 0.1) ** 2 + 0.001 * u[0] ** 2


OBJECTIVE = cc.CustomObjective(stage_cost, design_cost=lambda p: 4 * (p[0] / 1e4) ** 2)
FOLDER = tempfile.TemporaryDirectory()
FMU = from_fmu(packed(), dt=DT, inputs=["damping"], disturbances=["road"], design=DESIGN, substeps=2)
study = cc.Study(
    name="fmu_landing", title="A landing on bump stops", plant=car(),
    X=([-0.06, -2.5, -0.06, -4], [0.06, 2.5, 0.06, 4]), U=([LEAST], [MOST]), objective=OBJECTIVE,
    disturbance=ROAD, starts=HEIGHTS, x0=HEIGHTS.sample(1, 1, np.random.default_rng(0))[0, 0], p0=FIRST, steps=STEPS,
    real=cc.RealPlant(FMU, ROAD, x0=[0, -1, 0, -1], runs=100, steps=STEPS), limit_tolerance="off", accuracy=1e-2,
)  # fmt: skip


def bound(plant: cc.Plant, x0, w) -> float:
    """Least cost of a run at the first design whose road is known, by L-BFGS from three constant inputs."""
    u, x = ca.MX.sym("u", 1, STEPS), ca.MX.sym("x", 4)
    p = ca.DM(FIRST)
    after = plant.step.mapaccum(STEPS)(x, u, w.T, ca.repmat(p, 1, STEPS))
    before, xs, us = ca.horzcat(x, after[:, :-1]), ca.SX.sym("x", 4), ca.SX.sym("u")
    stage = ca.Function("stage", [xs, us], [stage_cost(xs, us, FIRST)])
    total = ca.sum2(stage.map(STEPS)(before, u))
    value = ca.Function("value", [u, x], [total, ca.gradient(total, u)])

    def cost_of(inputs):
        worth, slope = value(inputs[None], x0)
        return float(worth), np.asarray(slope).ravel()

    starts = (np.full(STEPS, start) for start in (LEAST, 0.0, MOST))
    return min(minimize(cost_of, start, jac=True, method="L-BFGS-B", bounds=[(LEAST, MOST)] * STEPS,
                        options={"maxiter": 500, "maxfun": 1000}).fun for start in starts)  # fmt: skip


def main() -> None:
    """Print how far the FMU is from its equations, the bound, and a design of the FMU without a model."""
    problem, rng = study.problem(), np.random.default_rng(10**6)
    x0, w = HEIGHTS.sample(8, 1, rng)[:, 0], ROAD.sample(8, STEPS, rng)
    given = {"x0": x0, "steps": STEPS, "design": FIRST, "disturbance": w}
    lqr = cc.saturated_lqr(problem, FIRST)
    fmu, stated = (cc.simulate(plant, lqr, **given).states for plant in (FMU, car(real=True)))
    apart = np.abs(fmu - stated).max()
    assert apart < 1e-9, apart
    print(f"FMU and its equations in CasADi: {apart:.1e} apart, struts to {1000 * np.abs(fmu[..., 0]).max():.0f} mm")
    price = OBJECTIVE.cost_of_design(FIRST, STEPS)
    for name, plant in (("model", car()), ("real car", car(real=True))):
        laws = [cc.LinearFeedback(np.zeros((1, 4)), offset=u) for u in np.linspace(LEAST, MOST, 31)]
        passive, *constant = (
            -cc.simulate(plant, law, **given).returns(OBJECTIVE).mean() - price for law in [lqr, *laws]
        )
        found = np.mean([bound(plant, *run) for run in zip(x0, w)])
        print(f"{name} at the first design, without its price of {price:.0f}, {len(x0)} runs: LQR {passive:.2f}, "
              f"the best constant input {min(constant):.2f}, with foresight {found:.2f}", flush=True)  # fmt: skip
    black = cc.CoDesignProblem(
        FMU, X=study.X, U=study.U, steps=STEPS, objective=OBJECTIVE, scenarios=problem.scenarios, limit_tolerance="off"
    )
    fresh = cc.Scenario(FMU, HEIGHTS.sample(200, 1, rng)[:, 0], ROAD.sample(200, STEPS, rng))
    began, method = time.process_time(), cc.Nested("lqr", runs=4, starts=1, evaluations=2, linearisation="tangent")
    result = cc.codesign(black, method=method, rng=np.random.default_rng(0), design=FIRST)
    seconds = time.process_time() - began
    values = fresh.run(result.controller, design=result.design, limit=problem.limit).returns(OBJECTIVE)
    half = 1.96 * values.std() / len(values) ** 0.5
    print(f"nested LQR of the FMU alone: {DESIGN.describe(result.design)}, {values.mean():.2f} ± {half:.2f} on "
          f"{len(values)} runs, {seconds:.0f} s, {result.status.name}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
