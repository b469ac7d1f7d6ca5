"""Time of a step of a controller's exported C code."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller

LOOP = """\
#include <stdio.h>
#include <time.h>
#include "law.h"
static law_real x[%d][LAW_NT];
int main(void)
{
    law_real u[LAW_NU];
    volatile double sum = 0; /* no call is left out */
    double best = 1e9, seconds;
    int k, pass;
    if (fread(x, sizeof x, 1, stdin) != 1) return 1;
    for (pass = 0; pass < 7; pass++) {
        const clock_t start = clock();
        for (k = 0; k < 100000; k++) {
            law_law(x[k %% %d], u);
            sum += u[0];
        }
        seconds = (double)(clock() - start) / CLOCKS_PER_SEC / 100000;
        best = seconds < best ? seconds : best;
    }
    printf("%%.9g", best);
    return 0;
}
"""


def c_step_time(controller: Controller, states: Array) -> float:
    """Time [s] of a call of the exported law, or NaN.

    Learned policies and explicit MPC are exported, in double precision, and compiled by ``cc -O2``.
    """
    from ccdtools.controllers.learned import LearnedPolicy
    from mpc import ExplicitMPC

    compiler = shutil.which("cc")
    if compiler is None or not isinstance(controller, LearnedPolicy | ExplicitMPC):
        return float("nan")
    with TemporaryDirectory() as name:
        folder = Path(name)
        controller.to_c(folder, name="law")
        (folder / "loop.c").write_text(LOOP % (len(states), len(states)))
        command = [compiler, "-std=c99", "-O2", "law.c", "loop.c", "-o", "loop"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        sent = np.ascontiguousarray(states, dtype=float).tobytes()
        return float(subprocess.run([folder / "loop"], input=sent, check=True, capture_output=True).stdout)
