"""Checks that a study's disturbances fit its plant."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ccdtools.checks import as_mapping, has_method, shown
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.exceptions import InputError
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampled_model import SampledModel


def check_disturbance(argument: str, disturbance: Disturbance, plant: Plant | SampledModel) -> None:
    """Raise unless samples of the disturbance have the plant's channels."""
    has_method(argument, disturbance, "sample", "an object with sample(runs, steps, rng)")
    try:
        drawn = np.asarray(disturbance.sample(1, 2, np.random.default_rng(0)))
    except InputError:
        raise
    except Exception as error:
        reason = f"a {type(disturbance).__name__} whose sample(1, 2, rng) stops with {type(error).__name__}: {error}"
        raise InputError(argument, " ".join(reason.split()), f"samples of shape (1, 2, {plant.nw})") from error
    if drawn.shape != (1, 2, plant.nw):
        got = f"samples of shape {drawn.shape}"
        if drawn.ndim == 3:
            got = f"{drawn.shape[2]} channel{'' if drawn.shape[2] == 1 else 's'}"
        raise InputError(argument, got, f"{plant.nw}, one per disturbance of the plant")
    if drawn.dtype.kind not in "iuf" or not np.isfinite(drawn).all():
        raise InputError(argument, "a sample that is not a finite number", "finite samples")


def checked_held_out(held_out: Mapping[str, Disturbance], plant: Plant | SampledModel) -> dict[str, Disturbance]:
    """Held-out disturbances, with names and samples checked."""
    named = as_mapping("real.held_out", held_out, "a mapping of names to disturbances")
    for name, disturbance in named.items():
        if not isinstance(name, str) or not name.strip() or len(name.splitlines()) > 1:
            raise InputError("real.held_out", shown(name), "names of one line")
        check_disturbance(f"real.held_out[{name!r}]", disturbance, plant)
    return named
