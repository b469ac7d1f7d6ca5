"""The rough road: the authors' recording, which is not part of the project, or one of our own."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.io import loadmat

from ccdtools.vehicles.iso8608 import road_roughness

NAME = "IRI_737b.mat"
SOURCE = "github.com/danielrherber/dt-qp-project, examples/ACC2021/detailed-suspension-acc/assets"
SPEED = 10.0  # m/s
WAVES = np.arange(0.05, 1.0, 0.05)  # 1/m
SEED = 8608

Road = Callable[[np.ndarray], np.ndarray]


def recording(given: str | Path | None = None) -> Path | None:
    """Where the recorded road is: the given file, or in the folder CCDTOOLS_DATA; None where there is none."""
    beside = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    path = Path(given) if given else Path(os.environ.get("CCDTOOLS_DATA") or beside) / NAME
    return path if path.is_file() else None


def recorded_road(path: Path) -> Road:
    """Times (n,) [s] → vertical speed (n,) of the road [m/s]: the slope of a cubic spline through its heights."""
    data = loadmat(path)
    heights = CubicSpline(data["road_x"].ravel() / SPEED, data["road_z"].ravel())
    return heights.derivative()


def synthetic_road() -> Road:
    """Times (n,) [s] → vertical speed (n,) [m/s] of a road of class C (ISO 8608): a sum of waves, seeded."""
    phases = np.random.default_rng(SEED).uniform(0, 2 * np.pi, len(WAVES))
    density = road_roughness("C") * (WAVES / 0.1) ** -2
    speeds = 2 * np.pi * WAVES * SPEED * np.sqrt(2 * density * (WAVES[1] - WAVES[0]))

    def speed(t: np.ndarray) -> np.ndarray:
        angles = 2 * np.pi * SPEED * np.multiply.outer(np.asarray(t, dtype=float), WAVES)
        return np.cos(angles + phases) @ speeds

    return speed
