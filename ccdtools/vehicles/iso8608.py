"""Road profiles of the classes of ISO 8608."""

from __future__ import annotations

import math
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len
from scipy.special import k1

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_array, as_choice, as_finite, as_floats, as_generator, as_positive, shown

RoadClass: TypeAlias = Literal["A", "B", "C", "D", "E", "F", "G", "H"]

REFERENCE_FREQUENCY = 0.1  # n₀ [1/m]
BAND = (0.011, 2.83)  # [1/m]: wavelengths from 91 m to 0.35 m, the octaves that ISO 8608 fits its classes to
SPACING = 0.02  # [m]; reading the road linearly between samples takes 2 % of the spectrum at the upper end of BAND


def road_roughness(road_class: RoadClass) -> float:
    """Displacement spectrum [m³] of a class at n₀ = 0.1 1/m: 16·10⁻⁶ for A, 4 times for each next.

    Raises
    ------
    InputError
        If `road_class` is none of A to H.

    References
    ----------
    ISO 8608. The same classes at 1 rad/m are 1, 4, …, 16384·10⁻⁶ m³, which is the same to 0.6 %.
    """
    classes = get_args(RoadClass)
    return 16e-6 * 4.0 ** classes.index(as_choice("road_class", road_class, classes))


def track_coherency(frequency: ArrayLike, track: float) -> Array:
    """Coherency γ(n) of two parallel tracks of an isotropic road.

    γ(n) = x K₁(x) with x = 2π n b. It is real, 1 for long waves and 0 for short ones: the cross spectrum of the
    tracks is γ(n) G(n).

    Parameters
    ----------
    frequency : (...) array_like
        n [1/m], not negative.
    track : float
        Distance b between the tracks [m].

    Raises
    ------
    InputError
        If a frequency is negative, or `track` not positive.

    References
    ----------
    Dodds and Robson, "The description of road surface roughness", Journal of Sound and Vibration 31, 1973; Kamash and
    Robson, "The application of isotropy in road surface modelling", the same journal 57, 1978, with measurements: a
    surface whose statistics are the same in all directions. Its spectrum over both directions is then proportional to
    (n² + m²)^(−3/2), and Basset's integral over m gives the formula. It has no parameter to be fitted and is a valid
    coherence for every track width. Measured roads are not quite isotropic: Múčka, "Model of coherence function of
    road unevenness in parallel tracks for vehicle simulation", International Journal of Vehicle Design 67, 2015, finds
    that fitted functions follow the mean of 3492 records more closely.
    """
    n = as_finite("frequency", as_floats("frequency", frequency))
    if (n < 0).any():
        raise InputError("frequency", shown(float(n.min())), "frequencies ≥ 0 [1/m]")
    x = 2 * np.pi * as_positive("track", track, unit="m") * n
    away = x > 1e-9
    return np.where(away, x * k1(np.where(away, x, 1.0)), 1.0)


def generate_profile(
    length: float,
    road_class: RoadClass,
    *,
    rng: np.random.Generator,
    track: float | None = None,
    band: ArrayLike = BAND,
    spacing: float = SPACING,
) -> tuple[Array, Array]:
    """Road of an ISO 8608 class, of one track or two.

    The elevation is a sum of cosines with normal amplitudes and random phases, on a grid of frequencies as fine as
    that of a road at least twice as long: a stationary Gaussian process, whose spectrum has the class' power in every
    cell of the grid and none outside the band. Filtered white noise would follow n⁻² only far from its corner and
    would not end at the upper frequency; cosines of fixed amplitudes would make every road of a class equally rough,
    which roads are not.

    Parameters
    ----------
    length : float
        Length the road covers at least [m].
    road_class : {"A", …, "H"}
    rng : Generator
        Source of the randomness; the same state gives the same road.
    track : float, optional
        Distance between the left and the right track [m]. The left one is the road that the same state of `rng`
        gives without `track`.
    band : (2,) array_like
        Lowest and highest frequency of the road [1/m].
    spacing : float
        Distance between samples [m], at most a quarter of the shortest wave.

    Returns
    -------
    distance : (S,) array
        [m], from 0.
    elevation : (S,) array, or (2, S) array of left and right with `track`
        [m], of mean zero.

    Raises
    ------
    InputError
        If an argument is not as described.

    References
    ----------
    Shinozuka and Jan, "Digital simulation of random processes and its applications", Journal of Sound and Vibration
    25, 1972, here with normal amplitudes; ISO 8608.
    """
    roughness = road_roughness(road_class)
    as_generator("rng", rng)
    low, high = as_band("band", band)
    spacing = as_spacing("spacing", spacing, high)
    intervals = math.ceil(as_positive("length", length, unit="m") / spacing - 1e-9)
    period = math.ceil(20 / (low * spacing))  # twenty of the longest waves
    samples = next_fast_len(max(2 * intervals, period) + 1, real=True)
    frequency, power = _cells(1.0 / (samples * spacing), low, high)
    power *= roughness * REFERENCE_FREQUENCY**2
    waves = _waves(power, rng)
    if track is not None:
        coherency = track_coherency(frequency, track)
        waves = np.stack([waves, coherency * waves + np.sqrt(1 - coherency**2) * _waves(power, rng)])
    first = round(frequency[0] * samples * spacing)
    spectrum = np.zeros((*waves.shape[:-1], samples // 2 + 1), dtype=complex)
    spectrum[..., first : first + len(frequency)] = 0.5 * samples * waves
    elevation: Array = irfft(spectrum, samples)[..., : intervals + 1]
    return spacing * np.arange(intervals + 1, dtype=np.float64), elevation


def as_band(argument: str, value: Any) -> tuple[float, float]:
    """Lowest and highest frequency [1/m] of a band."""
    low, high = as_array(argument, value, (2,)).tolist()
    if not 0 < low < high:
        raise InputError(argument, f"{low:g} to {high:g}", "0 < lowest < highest [1/m]")
    return low, high


def as_spacing(argument: str, value: Any, high: float) -> float:
    """Distance between samples [m] that resolves the frequency `high` [1/m]."""
    spacing = as_positive(argument, value, unit="m")
    if 4 * spacing * high > 1 + 1e-9:
        most = f"at most {1 / (4 * high):.3g} m, a quarter of the shortest wave of the band"
        raise InputError(argument, f"{spacing:g} m", most, "Take a smaller spacing, or a narrower band.")
    return spacing


def _cells(step: float, low: float, high: float) -> tuple[Array, Array]:
    """Frequencies k·step of the cells that meet the band, and ∫ n⁻² dn within it."""
    k = np.arange(max(1, round(low / step)), round(high / step) + 1, dtype=np.float64)
    begin = np.maximum((k - 0.5) * step, low)
    end = np.minimum((k + 0.5) * step, high)
    power: Array = np.maximum(1 / begin - 1 / end, 0.0)
    return k * step, power


def _waves(power: Array, rng: np.random.Generator) -> NDArray[np.complex128]:
    """Complex normal amplitudes c of cosines with these variances [m²]."""
    parts = rng.standard_normal((2, len(power)))
    return np.asarray(np.sqrt(power) * (parts[0] + 1j * parts[1]))
