"""Spectra of the classes of ISO 8608, stated apart from the library's roads."""

import numpy as np

BAND = (0.011, 2.83)  # 1/m


def road_spectrum(frequency, road_class):
    """One-sided spectrum G(n) = G(n₀) (n/n₀)⁻² [m³] at frequencies n [1/m], n₀ = 0.1; 0 outside the band."""
    n = np.asarray(frequency, dtype=float)
    inside = (n >= BAND[0]) & (n <= BAND[1])
    roughness = 16e-6 * 4 ** "ABCDEFGH".index(road_class)
    return np.where(inside, roughness * (np.where(inside, n, BAND[0]) / 0.1) ** -2, 0.0)
