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

LOOP = """\
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
static law_real x[%d][SEEN];
int main(void)
{
    law_real u[LAW_NU] = {0};
    volatile double sum = 0; /* no call is left out */
    double best = 1e9, seconds;
    int k, pass;
    if (fread(x, sizeof x, 1, stdin) != 1) return 1;
    for (pass = 0; pass < 7; pass++) {
        const clock_t start = clock();
        BEGIN;
        for (k = 0; k < 100000; k++) {
            CALL(x[k %% %d]);
            sum += u[0];
        }
        seconds = (double)(clock() - start) / CLOCKS_PER_SEC / 100000;
        best = seconds < best ? seconds : best;
    }
    printf("%%.9g", best);
    return 0;
}
"""


def c_step_time(controller: Controller, run: Trajectory) -> float:
    """Time [s] of a call of the exported law along a run, or NaN.

    Learned policies, with their memory or filter, and explicit MPC are exported, in double precision, and compiled by
    ``cc -O2``.
    """
    from ccdtools.controllers.history import History
    from ccdtools.controllers.learned import LearnedPolicy
    from ccdtools.controllers.observed import Observed
    from mpc import ExplicitMPC

    compiler = shutil.which("cc")
    if compiler is None or not isinstance(controller, LearnedPolicy | History | Observed | ExplicitMPC):
        return float("nan")
    states = (run.outputs if isinstance(controller, History | Observed) else run.states)[0]
    with TemporaryDirectory() as name:
        folder = Path(name)
        try:
            controller.to_c(folder, name="law")
        except InputError:  # it holds what is not exported
            return float("nan")
        (folder / "loop.c").write_text(LOOP % (len(states), len(states)))
        command = [compiler, "-std=c99", "-O2", "law.c", "loop.c", "-o", "loop", "-lm"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        sent = np.ascontiguousarray(states, dtype=float).tobytes()
        return float(subprocess.run([folder / "loop"], input=sent, check=True, capture_output=True).stdout)
