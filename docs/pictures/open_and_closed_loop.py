"""Draw the picture of explanation/open_and_closed_loop.md: the unstable example from (-2, -2)."""

from dataclasses import replace

import numpy as np
from _page import save

from ccdtools import compare_methods, load_study

problem = replace(load_study("illustrative"), x0=np.array([-2.0, -2.0])).problem()
table = compare_methods(problem, ["nested LQR", "sequential", "nested trajectory", "simultaneous", "CMA-ES"], seed=0)
print(table)
save(table.plot(), __file__)
