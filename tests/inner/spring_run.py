"""The command line with the tiny configuration, in this process, and a finished run of it that tests share."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from small_runs import SPRING, tiny_configuration

from ccdtools.cli import main
from ccdtools.studies import preparation

ARGUMENTS = ("--quick", "--filter", "admissible", "--limits", "0,0")


def call(*arguments: str) -> int:
    """The exit code of the command line in this process, with the tiny configuration."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "configuration", tiny_configuration)
        patch.setattr(sys, "argv", ["ccdtools", *arguments])
        with pytest.raises(SystemExit) as stopped:
            main()
    return stopped.value.code


def run_spring(place: Path) -> None:
    """Fill a folder with a study and its finished run of two generations, with a filter and a tolerance of nothing."""
    (place / "spring.py").write_text(SPRING)
    rows = "\n".join(f"{value:.3f}" for value in 0.1 * np.random.default_rng(0).standard_normal(600))
    (place / "w.csv").write_text("w\n" + rows + "\n")
    assert call("run", str(place / "spring.py"), "--output", str(place / "run"), *ARGUMENTS) == 0
