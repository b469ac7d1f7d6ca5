"""Figures that the paper prints, each with its place in it.

Tsai, Karkaria, Chen and Chen, "Digital Twin-enabled Multi-generation Control Co-Design with Deep Reinforcement
Learning", arXiv:2510.10694. These are data to compare with: nothing is computed from them but differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ccdtools.evidence.percent import number, with_minus

SETS_AT = (0.5, 1.0, 1.5, 2.0)  # values of p in figure Xfea
FIRST = {"illustrative": (1.1513,), "suspension": (31863.8, 2067.1)}  # designs of the first optimisation
SECOND = {"illustrative": (1.2947,), "suspension": (32290.6, 2072.6)}  # designs of the second one
STARTS = ((0.49, 1.74, -0.02, 0.57), (-0.28, -1.08, 0.07, -0.96), (-0.40, 1.20, -0.13, 0.31))  # figure susp_traj_trial
BOX = ((-0.5, -2.0, -0.2, -1.0), (0.5, 2.0, 0.2, 1.0))  # of the 200 initial conditions of table returns_step3_susp


@dataclass(frozen=True)
class Printed:
    """Figure of the paper.

    Attributes
    ----------
    place : str
        Section, figure or table.
    mean, std : float
        NaN where none is printed.
    runs : int
        Trajectories that both are of; 0 where none are named.
    says : str
        Its words, where it prints no number.
    """

    place: str
    mean: float = float("nan")
    std: float = float("nan")
    runs: int = 0
    says: str = "no figure"

    @property
    def half_width(self) -> float:
        """Half of the 95 % interval of the mean; 0 if unknown."""
        return 1.96 * self.std / self.runs**0.5 if self.runs and np.isfinite(self.std) else 0.0

    def __str__(self) -> str:
        if not np.isfinite(self.mean):
            return self.says
        return with_minus(number(self.mean, 5) + (f", std {number(self.std, 3)}" if np.isfinite(self.std) else ""))


GROWS = Printed("figure Xfea", says="grows with p")
UNPRINTED = Printed("not in the paper")
PAPER: dict[str, dict[str, Printed]] = {
    "illustrative": {
        **{f"set-{p}": GROWS for p in SETS_AT},
        "r2": Printed("section Initialization", says="300 samples, no measure"),
        "before": Printed("section Step 1", -86.328, 26.369, 1000),
        "after": Printed("section Step 1", -69.783, 11.994, 1000),
        "rmse": Printed("section Step 2", 0.1355),
        "penalised-1": Printed("section Step 3", -113.817, 20.115, 1000),
        "penalised-2": Printed("section Step 3", -108.301, 14.681, 1000),
    },
    "suspension": {
        "r2": Printed("section Step 1 of the suspension", says="3000 samples, no measure"),
        "before": Printed("section Step 1 of the suspension", -87.429, 11.932, 1000),
        "after": Printed("section Step 1 of the suspension", -82.106, 12.059, 1000),
        "rmse": Printed("section Step 2 of the suspension", 0.0343),
        "penalised-2": Printed("figure return_history_susp", says="a curve, no figure"),
        "starts-1": Printed("table returns_step3_susp", -5.6018, 0.2715, 200),
        "starts-2": Printed("table returns_step3_susp", -2.2500, 0.0686, 200),
        "comfort-2": Printed("abstract, conclusion", says="smoother than generation 1"),
        "effort-2": Printed("abstract, conclusion", says="less than generation 1"),
    },
}
SIGMA = np.array([  # table sigma_ss_susp: start × (x₃ [m], x₄ [m/s], u [N]) × (generation 1, generation 2)
    [[0.0025, 0.0020], [0.0222, 0.0194], [59.4364, 13.1011]],
    [[0.0014, 0.0008], [0.0142, 0.0064], [60.8681, 4.9897]],
    [[0.0013, 0.0017], [0.0151, 0.0139], [54.4229, 8.9099]],
])  # fmt: skip
SIGNALS = ("x₃ [m]", "x₄ [m/s]", "u [N]")
for start, signal, generation in np.ndindex(SIGMA.shape):
    PAPER["suspension"][f"sigma-{start + 1}-{SIGNALS[signal]}-{generation + 1}"] = Printed(
        "table sigma_ss_susp", float(SIGMA[start, signal, generation])
    )
