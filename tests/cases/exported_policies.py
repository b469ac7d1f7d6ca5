"""Policies with and without a memory, and their C code run on rows."""

import subprocess

import numpy as np
from compiler import CC

from ccdtools import DesignSpace, KalmanFilter, LearnedPolicy, Measurement, simulate
from ccdtools.controllers import History, Observed
from ccdtools.plants import BlackBox
from learning import ActorCritic, NetworkConfig

WARNINGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror"]
WIDE = np.array([0.3, 3.0, 0.6, 3.0])

DRIVER = """
#include <stdio.h>
#include "%s.h"
int main(void)
{
    %s_real x[%s_NT], u[%s_NU];
    while (fread(x, sizeof(x), 1, stdin) == 1) {
        double row[%s_NU + 1];
        int i;
        row[%s_NU] = %s_law(x, u);
        for (i = 0; i < %s_NU; i++) row[i] = (double)u[i];
        fwrite(row, sizeof(row), 1, stdout);
    }
    return 0;
}
"""

MEMORY = """
#include <stdio.h>
#include "policy.h"
int main(void)
{
    policy_state state;
    policy_real sent[1 + POLICY_NY + POLICY_NU], u[POLICY_NU] = {0};
    while (fread(sent, sizeof(sent), 1, stdin) == 1) {
        double row[POLICY_NU + 1];
        int i;
        if (sent[0] > 0) { /* a run begins */
            policy_reset(&state);
            for (i = 0; i < POLICY_NU; i++) u[i] = 0;
        }
        row[POLICY_NU] = policy_step(&state, sent + 1, %s, u);
        for (i = 0; i < POLICY_NU; i++) row[i] = (double)u[i];
        fwrite(row, sizeof(row), 1, stdout);
    }
    return 0;
}
"""


def steep(agent, size):
    """The agent with weights so many times as large, which saturate."""
    for weight in agent.mean_network.parameters():
        weight.data *= size
    return agent


def policy(hidden=(16, 16), size=2.0, **options):
    """A policy of four states and two inputs, whose weights are large enough to saturate."""
    config = NetworkConfig(hidden, **options)
    bounds = [-0.2, -2, -0.4, -2, 1e4], [0.2, 2, 0.4, 2.5, 4e4], [-900.0, 0.0], [1000.0, 3.0]
    return LearnedPolicy(steep(ActorCritic(*bounds, config=config, imitates=True, seed=1), size), [2e4])


def compiled(folder, x, scalar, name="policy", driver=None):
    """Inputs and codes of the C code, with warnings as errors and sanitizers."""
    driver = driver or DRIVER % (name, name, *[name.upper()] * 4, name, name.upper())
    (folder / "driver.c").write_text(driver)
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-O1"]
    subprocess.run([CC, *WARNINGS, *sanitizers, f"{name}.c", "driver.c", "-o", "run", "-lm"], cwd=folder, check=True)
    sent = x.astype(np.float64 if scalar == "double" else np.float32).tobytes()
    rows = subprocess.run(["./run"], input=sent, cwd=folder, check=True, capture_output=True).stdout
    return np.split(np.frombuffer(rows).reshape(len(x), -1), [-1], axis=1)


M, NY, NU = 5, 2, 2
A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.3], [0.0, 0.0, 0.7]])
B = np.array([[0.0, 0.1], [0.3, 0.0], [0.2, 0.4]])
SPACE = DesignSpace(["p"], [0.0], [1.0])
NOISE = {
    "W": [0.01, 0.02, 0.01], "V": [[0.01, 0.005], [0.005, 0.04]], "P0": [1.0, 0.5, 2.0], "x0": [0.3, -0.2, 0.1],
    "c": [-0.03, 0.01, 0.05], "disturbance": ([0.1], [0.2]),
}  # fmt: skip


def of_outputs(size=1.5, n=M * (NY + NU)):
    """A policy of the last five pairs of outputs and inputs."""
    bounds = -np.arange(1.0, n + 2), np.full(n + 1, 2.0), [-2.0, 0.0], [2.0, 3.0]
    agent = ActorCritic(*bounds, config=NetworkConfig((16, 16)), imitates=True, seed=4)
    return History(LearnedPolicy(steep(agent, size), [0.5]), M)


def of_estimate(*, steady=False):
    """A policy of the estimate of a filter that begins anywhere, with outputs of correlated noise."""
    known = {name: NOISE[name] for name in (("x0", "c") if steady else ("x0", "c", "P0"))}
    estimator = KalmanFilter(
        A, B, np.eye(NY, 3), 0.01 * np.eye(3), NOISE["V"], D=[[0.1, 0.0], [0.0, 0.2]], y0=[0.05, -0.1], steady=steady,
        **known,
    )  # fmt: skip
    return Observed(of_outputs(n=3, size=2.5).controller, estimator)


def closed_loop(law, rng, plant=None):
    """Outputs and inputs (runs, T, ·) of a loop of three states in which two are measured."""
    linear = BlackBox(lambda x, u, w, p: x @ A.T + u @ B.T, nx=3, nu=NU, dt=0.1, design=SPACE, batched=True)
    output = Measurement(np.eye(NY, 3) if plant is None else plant, noise=[0.1, 0.2])
    plant = linear if plant is None else plant
    run = simulate(plant, law, x0=rng.normal(size=(4, 3)), steps=250, design=[0.5], output=output, rng=rng)
    return run.outputs, run.inputs
