"""Generated roads have the spectrum of their class in every octave, and two tracks the coherence of an isotropic road.

Spectra are measured by Welch's method, which the generator does not use. The bands hold the estimates of a true road
with a probability of 0.9999 each; averages over m bins of K blocks under a Hann window have 2 K m / 1.944 degrees of
freedom, because neighbouring bins are correlated.
"""

from itertools import pairwise

import numpy as np
import pytest
from iso_spectrum import road_spectrum
from scipy.integrate import quad
from scipy.signal import csd, welch
from scipy.stats import chi2

from ccdtools.exceptions import InputError
from ccdtools.vehicles.iso8608 import BAND, generate_profile, road_roughness, track_coherency

CLASSES = "ABCDEFGH"
SPACING = 0.08
BLOCK = 25_000  # samples, 2 km
BLOCKS = 25
TRACK = 1.5


@pytest.fixture(scope="module")
def road():
    """Both tracks of 50 km of class C."""
    _, tracks = generate_profile(
        BLOCK * BLOCKS * SPACING, "C", rng=np.random.default_rng(8608), track=TRACK, spacing=SPACING
    )
    return tracks[:, : BLOCK * BLOCKS]


def measured(signal):
    """Frequencies [1/m] and one-sided spectrum [m³] of the blocks of a signal."""
    return welch(signal, fs=1 / SPACING, nperseg=BLOCK, noverlap=0)


def rng(seed=0):
    return np.random.default_rng(seed)


# ── the classes ──


def test_classes_have_the_roughness_of_the_standard_at_both_reference_frequencies():
    table_c1 = [16, 64, 256, 1024, 4096, 16384, 65536, 262144]  # 10⁻⁶ m³ at 0.1 1/m
    table_c2 = [1, 4, 16, 64, 256, 1024, 4096, 16384]  # 10⁻⁶ m³ at 1 rad/m
    np.testing.assert_allclose([1e6 * road_roughness(name) for name in CLASSES], table_c1)
    one_radian = [1e6 * road_roughness(name) * 0.1**2 * 2 * np.pi for name in CLASSES]
    np.testing.assert_allclose(one_radian, table_c2, rtol=6e-3)


# ── one track ──


@pytest.mark.parametrize("octave", range(8))
@pytest.mark.parametrize("side", [0, 1])
def test_every_octave_of_either_track_has_the_power_of_the_class(road, octave, side):
    n, power = measured(road[side])
    low = BAND[0] * 2**octave
    margin = 2 / (BLOCK * SPACING)  # beyond the leakage of the window at the ends of the band
    inside = (n > low + margin) & (n < min(2 * low, BAND[1]) - margin)
    ratio = (power[inside] / road_spectrum(n[inside], "C")).mean()
    freedom = 2 * BLOCKS * inside.sum() / 1.944
    least, most = chi2.ppf([0.5e-4, 1 - 0.5e-4], freedom) / freedom
    assert least < ratio < most


def test_there_is_nothing_outside_the_band(road):
    n, power = welch(road[0], fs=1 / SPACING, nperseg=BLOCK, noverlap=0, detrend=False)
    margin = 5 / (BLOCK * SPACING)
    outside = (n < BAND[0] - margin) | (n > BAND[1] + margin)
    assert power[outside].sum() < 1e-5 * power.sum()


def test_short_roads_vary_as_pieces_of_a_long_one():
    length = 60.0
    ends = []
    for seed in range(600):
        _, z = generate_profile(length, "C", rng=rng(seed), band=(0.011, 0.5), spacing=0.5)
        ends.append((z[0], z[-1] - z[0]))
    level, rise = np.array(ends).T
    scale = 256e-6 * 0.1**2
    variance = scale * (1 / 0.011 - 1 / 0.5)
    opposite = quad(lambda n: scale / n**2 * (2 - 2 * np.cos(2 * np.pi * n * length)), 0.011, 0.5, limit=500)[0]
    least, most = chi2.ppf([0.5e-4, 1 - 0.5e-4], 600) / 600
    assert least < np.mean(level**2) / variance < most
    assert least < np.mean(rise**2) / opposite < most


def test_each_class_is_twice_as_high_as_the_one_before():
    roads = [generate_profile(200.0, name, rng=rng(3))[1] for name in CLASSES]
    for smooth, rough in pairwise(roads):
        np.testing.assert_allclose(rough, 2 * smooth, rtol=1e-12)


def test_the_same_seed_gives_the_same_road_and_another_seed_another():
    one, same, other = (generate_profile(50.0, "B", rng=rng(seed))[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.allclose(one, other)


@pytest.mark.parametrize("length", [0.01, 1.0, 99.97])
def test_a_road_covers_its_length_in_equal_steps(length):
    distance, elevation = generate_profile(length, "A", rng=rng())
    assert distance.shape == elevation.shape
    assert distance[0] == 0.0
    assert length <= distance[-1] + 1e-9 < length + 0.02 + 1e-9
    np.testing.assert_allclose(np.diff(distance), 0.02)


# ── two tracks ──


def test_coherency_is_that_of_a_surface_with_one_spectrum_in_all_directions():
    def across(n, track):
        """Cross spectrum of two tracks of the surface (n² + m²)^(−3/2), over the frequency m across the road."""
        surface = quad(lambda m: (n**2 + m**2) ** -1.5, 0, np.inf)[0]
        return quad(lambda m: (n**2 + m**2) ** -1.5, 0, np.inf, weight="cos", wvar=2 * np.pi * track)[0] / surface

    for n in (0.05, 0.1, 0.3, 1.0):
        assert track_coherency(n, 1.6) == pytest.approx(across(n, 1.6), abs=1e-6)


def test_measured_coherency_is_that_of_the_model(road):
    block = 1000  # 80 m
    options = {"fs": 1 / SPACING, "nperseg": block, "noverlap": 0}
    n, cross = csd(*road, **options)
    _, power = welch(road, **options)
    coherency = cross / np.sqrt(power[0] * power[1])
    seen = (n > 0.05) & (n < 2.5)
    model = track_coherency(n[seen], TRACK)
    blocks = BLOCK * BLOCKS / block
    error = (1 - model**2) / np.sqrt(2 * blocks)  # standard deviation of the estimate
    assert (np.abs(coherency[seen].real - model) < 5 * error + 2e-3).all()
    assert (np.abs(coherency[seen].imag) < 5 / np.sqrt(2 * blocks)).all()
    assert abs((coherency[seen].real - model).mean()) < 0.005


def test_the_left_track_is_the_road_without_a_second_one():
    alone = generate_profile(100.0, "D", rng=rng(4))[1]
    np.testing.assert_array_equal(generate_profile(100.0, "D", rng=rng(4), track=1.4)[1][0], alone)


def test_tracks_close_together_are_the_same_and_far_apart_independent():
    near = generate_profile(2000.0, "C", rng=rng(5), track=1e-4)[1]
    far = generate_profile(20_000.0, "C", rng=rng(5), track=1e4, spacing=0.08)[1]
    assert np.abs(near[0] - near[1]).max() < 1e-4
    assert abs(np.corrcoef(far)[0, 1]) < 0.25
    assert track_coherency(0.0, 1.5) == 1.0
    assert track_coherency(1.0, 1e4) == 0.0


# ── what is refused ──


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: road_roughness("I"), "road_class: got 'I', expected one of A, B, C, D, E, F, G, H."),
        (lambda: road_roughness("c"), "road_class: got 'c', expected one of A"),
        (lambda: generate_profile(9.0, "C", rng=rng(), band=(1, 0.1)), "band: got 1 to 0.1, expected 0 < lowest"),
        (lambda: generate_profile(9.0, "C", rng=rng(), band=0.1), r"band: got shape \(\), expected \(2,\)"),
        (lambda: track_coherency(-0.1, 1.5), "frequency: got -0.1, expected frequencies ≥ 0"),
        (lambda: track_coherency(0.1, 0.0), "track: got 0.0, expected a positive number"),
        (lambda: generate_profile(0.0, "C", rng=rng()), "length: got 0.0, expected a positive number"),
        (lambda: generate_profile(9.0, "C", rng=3), r"rng: got 3, .*Pass rng=np.random.default_rng\(3\)"),
        (lambda: generate_profile(9.0, "C", rng=rng(), spacing=0.1), "spacing: got 0.1 m, expected at most 0.0883 m"),
        (lambda: generate_profile(9.0, "C", rng=rng(), track=-1.0), "track: got -1.0, expected a positive number"),
    ],
)
def test_wrong_calls_name_the_argument(call, message):
    with pytest.raises(InputError, match=f"^{message}"):
        call()
