"""Time of a step of a controller's exported C code."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError
from ccdtools.trajectory import Trajectory

NONE = float("nan"), float("nan")
LOOP = """\
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include "law.h"
#ifdef LAW_NY /* a law with a memory, which sees outputs */
static law_state state;
#define SEEN LAW_NY
#define BEGIN law_reset(&state)
#define CALL(seen) law_step(&state, seen, u, u)
#else
#define SEEN LAW_NT
#define BEGIN
#define CALL(seen) law_law(seen, u)
#endif
static law_real x[%(states)d][SEEN];
static double taken[%(calls)d][2];
static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec %% 1000 + 1e-9 * now.tv_nsec;
}
int main(void)
{
    law_real u[LAW_NU] = {0};
    volatile double sum = 0; /* no call is left out */
    int k;
    if (fread(x, sizeof x, 1, stdin) != 1) return 1;
    BEGIN;
    for (k = 0; k < %(calls)d; k++) {
        const double start = seconds(), begun = seconds();
        CALL(x[k %% %(states)d]);
        taken[k][0] = begun - start; /* of the clock alone */
        taken[k][1] = seconds() - begun;
        sum += u[0];
    }
    return fwrite(taken, sizeof taken, 1, stdout) != 1;
}
"""


def c_step_time(controller: Controller, run: Trajectory, *, calls: int = 100_000) -> tuple[float, float]:
    """Median and 99th percentile [s] of calls of the exported law along a run, or NaN.

    Learned policies, with their memory or filter, and explicit MPC are exported, in double precision, and compiled by
    ``cc -O2``. What the clock itself takes, in the median, is left out.
    """
    from ccdtools.controllers.history import History
    from ccdtools.controllers.learned import LearnedPolicy
    from ccdtools.controllers.observed import Observed
    from mpc import ExplicitMPC

    compiler = shutil.which("cc")
    if compiler is None or not isinstance(controller, LearnedPolicy | History | Observed | ExplicitMPC):
        return NONE
    states = (run.outputs if isinstance(controller, History | Observed) else run.states)[0]
    with TemporaryDirectory() as name:
        folder = Path(name)
        try:
            controller.to_c(folder, name="law")
        except InputError:  # it holds what is not exported
            return NONE
        (folder / "loop.c").write_text(LOOP % {"states": len(states), "calls": calls})
        command = [compiler, "-std=c99", "-O2", "law.c", "loop.c", "-o", "loop", "-lm"]
        sent = np.ascontiguousarray(states, dtype=float).tobytes()
        try:
            subprocess.run(command, cwd=folder, check=True, capture_output=True)
            found = subprocess.run([folder / "loop"], input=sent, check=True, capture_output=True).stdout
        except subprocess.CalledProcessError:  # a system without this clock
            return NONE
    clock, taken = np.frombuffer(found).reshape(-1, 2).T
    median, most = np.quantile(taken, [0.5, 0.99]) - np.median(clock)
    return float(median), float(most)
