"""Published optimal control problems: cost beside the published optimum, size of the mesh, iterations and time.

`--further` takes those on which nothing was developed.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "cases"))

from classical_problems import CLASSICAL, FREE_FLYING_ROBOT
from further_problems import FURTHER

from mpc.optimal_control import refine


def main() -> None:
    """Print the table."""
    print("| problem | cost | published | apart | intervals | iterations | s | status |")
    print("|---|---|---|---|---|---|---|---|")
    known = CLASSICAL | {"free-flying robot": FREE_FLYING_ROBOT}
    for name, case in (FURTHER if "--further" in sys.argv[1:] else known).items():
        began = time.perf_counter()
        found = refine(case.phase, **case.options)
        seconds = time.perf_counter() - began
        intervals = sum(phase.part.intervals for phase in found.phases)
        apart = abs(found.cost - case.cost) / abs(case.cost)
        print(
            f"| {name} | {found.cost:.7g} | {case.cost:.7g} | {apart:.0e} | {intervals} "
            f"| {found.iterations} | {seconds:.2f} | {found.status.name} |"
        )


if __name__ == "__main__":
    main()
