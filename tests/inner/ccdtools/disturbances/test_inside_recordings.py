"""What test_recordings.py claims, seen from inside."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import trapezoid

from ccdtools.vehicles import read_road, read_speed, road_disturbance
from ccdtools.vehicles.roads import generate_road

DT = 0.05


@pytest.fixture
def write(tmp_path):
    def write(text: str | bytes) -> Path:
        path = tmp_path / "file.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_a_generated_road_is_read_back_as_it_was(tmp_path, write):
    distance, elevation = generate_road(20.0, rng=np.random.default_rng(0))
    rows = "\n".join(f"{z!r},{s!r}" for s, z in zip(distance.tolist(), elevation.tolist()))
    got = read_road(write("elevation,distance\n" + rows))  # by name, in any order
    np.testing.assert_array_equal(got, (distance, elevation))


def test_recorded_speed_drives_a_generated_road(recorded):
    time, speed = read_speed(recorded("speed_data_mild_driver1.csv"))
    assert time[-1] == pytest.approx(875.0)
    assert speed.max() == pytest.approx(80.0 / 3.6, rel=1e-3)
    distance, elevation = generate_road(trapezoid(speed, time) + 1.0, rng=np.random.default_rng(0))
    assert road_disturbance(distance, elevation, time, speed, dt=DT).shape == (17500,)
