"""Ride comfort by ISO 2631-1: frequency-weighted accelerations."""

from __future__ import annotations

import math
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_choice, as_finite, as_floats, as_positive

Weighting: TypeAlias = Literal["Wk", "Wd"]


def frequency_weighting(frequency: ArrayLike, weighting: Weighting = "Wk") -> NDArray[np.complex128]:
    """Complex transfer function of a weighting at frequencies (...) [Hz].

    Parameters
    ----------
    frequency : (...) array_like
        [Hz].
    weighting : {"Wk", "Wd"}
        W_k for vertical, W_d for horizontal vibration of seated people.

    Raises
    ------
    InputError
        If an argument is not as described.

    References
    ----------
    ISO 2631-1, its filters and their parameters. They give the tabulated factors to the last digit, but for
    W_d at 10 Hz: transcriptions have 0.212 there beside −13.9 dB, which is 0.202.
    """
    as_choice("weighting", weighting, get_args(Weighting))
    f1, f2, butterworth = 0.4, 100.0, 1 / math.sqrt(2)  # limits of the band [Hz], and Q₁ = Q₂
    # f₃ and f₄ [Hz] and Q₄ of the transition from acceleration to velocity; f₅ [Hz], Q₅, f₆ [Hz] and Q₆ of the upward
    # step, which W_d does not have.
    curves = {"Wk": (12.5, 12.5, 0.63, 2.37, 0.91, 3.35, 0.91), "Wd": (2.0, 2.0, 0.63, 1.0, 1.0, 1.0, 1.0)}
    f3, f4, Q4, f5, Q5, f6, Q6 = curves[weighting]
    f = as_finite("frequency", as_floats("frequency", frequency)).astype(complex)
    response: NDArray[np.complex128] = (1j * f / f1) ** 2 / _second_order(f, f1, butterworth)
    response /= _second_order(f, f2, butterworth)
    response *= (1 + 1j * f / f3) / _second_order(f, f4, Q4)
    response *= _second_order(f, f5, Q5) / _second_order(f, f6, Q6) * (f5 / f6) ** 2
    return response


def _second_order(f: NDArray[np.complex128], corner: float, Q: float) -> NDArray[np.complex128]:
    """Factor 1 + s/(Q ω) + (s/ω)² at s = 2πi f, for ω = 2π corner."""
    ratio = 1j * f / corner
    return 1 + ratio / Q + ratio**2


def weighted_acceleration(acceleration: ArrayLike, dt: float, *, weighting: Weighting = "Wk") -> Array:
    """Frequency-weighted acceleration a_w (..., T) [m/s²], filtered from rest.

    The record is weighted in the frequency domain, followed by zeros until the filter has settled. Below half the
    sampling rate the weights are therefore those of the standard at every rate; the usual bilinear filter at
    dt = 0.05 s has 14 % less of W_k at 7 Hz and 38 % less at 8 Hz. What lies above half the rate is not in the
    samples: W_k is largest from 4 to 10 Hz and the standard asks for 0.5 to 80 Hz, so dt = 0.05 s covers the body of
    a car but hardly its wheel hop, and dt ≤ 0.006 s covers all.

    The first second or two hold the filter's start. Where a record begins or ends far from zero the result rings at
    half the sampling rate, by 0.3 % of the jump after 100 samples; of its mean square that is next to nothing.

    Parameters
    ----------
    acceleration : (..., T) array_like
        Without gravity [m/s²], sampled along the last axis.
    dt : float
        Time between samples [s].
    weighting : {"Wk", "Wd"}
        See `frequency_weighting`.

    Raises
    ------
    InputError
        If an argument is not as described.
    """
    a = as_signal("acceleration", acceleration)
    dt = as_positive("dt", dt, unit="s")
    settled = math.ceil(16.0 / dt)  # in 16 s the slowest pole, at 0.4 Hz, falls by 10⁻¹²
    samples = next_fast_len(a.shape[-1] + settled, real=True)
    response = frequency_weighting(rfftfreq(samples, dt), weighting)
    weighted: Array = irfft(rfft(a, samples) * response, samples)[..., : a.shape[-1]]
    return weighted


def comfort(acceleration: ArrayLike, dt: float, *, weighting: Weighting = "Wk") -> Array:
    """Root mean square of the weighted acceleration of each record, (...,) [m/s²].

    ISO 2631-1, for public transport: not uncomfortable below 0.315 m/s², fairly uncomfortable from 0.5,
    uncomfortable from 0.8, very uncomfortable from 1.25, extremely so above 2. Of a trajectory whose state i is the
    velocity of the body:

        acceleration = np.diff(run.states[:, :, i]) / run.dt
        comfort(acceleration, run.dt)

    That is the mean over each step, sinc(f dt) times the acceleration itself: 10 % less at 5 Hz for dt = 0.05 s.

    Parameters
    ----------
    acceleration : (..., T) array_like
        Without gravity [m/s²], sampled along the last axis.
    dt : float
        Time between samples [s].
    weighting : {"Wk", "Wd"}
        See `frequency_weighting`.

    Raises
    ------
    InputError
        If an argument is not as described.
    """
    return root_mean_square(weighted_acceleration(acceleration, dt, weighting=weighting))


def as_signal(argument: str, value: ArrayLike) -> Array:
    """Finite samples along the last axis, at least one."""
    signal = as_finite(argument, as_floats(argument, value))
    if signal.ndim == 0 or signal.shape[-1] == 0:
        raise InputError(argument, f"shape {signal.shape}", "samples (..., T)")
    return signal


def root_mean_square(signal: Array) -> Array:
    """Root mean square along the last axis."""
    size: Array = np.sqrt(np.mean(signal**2, axis=-1))
    return size
