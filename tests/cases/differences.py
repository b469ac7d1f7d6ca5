"""Central differences of fourth order, which the derivatives are compared with."""

import numpy as np


def slope(function, step):
    """d/dt of a function of a number at 0, by Richardson's extrapolation of central differences."""

    def central(h):
        return (np.asarray(function(h)) - np.asarray(function(-h))) / (2 * h)

    return (4 * central(step) - central(2 * step)) / 3


def slopes(function, at, steps):
    """Derivatives (..., n) of a function of a vector (n,), with one step for each entry."""
    found = []
    for unit, step in zip(np.eye(len(at)), steps):
        found.append(slope(lambda t, unit=unit: function(at + t * unit), step))
    return np.stack(found, axis=-1)


def distance(found, expected):
    """Largest difference, relative to the largest entry."""
    return np.abs(np.asarray(found) - expected).max() / np.abs(expected).max()
