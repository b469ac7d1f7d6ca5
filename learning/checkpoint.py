"""Networks on disk: safetensors with a JSON header."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from learning.exceptions import CheckpointError, InputError
from learning.networks import ActionLimits, ActorCritic
from learning.quantile import QuantileNetwork

FORMAT = "ccdtools-1"
LimitsReader: TypeAlias = Callable[[dict[str, Any]], ActionLimits]
Network: TypeAlias = ActorCritic | QuantileNetwork
_KINDS: dict[str, Any] = {kind.__name__: kind for kind in (ActorCritic, QuantileNetwork)}


def save(path: str | Path, network: Network, extra: dict[str, Any] | None = None) -> None:
    """Write a network and JSON-able `extra` values to a safetensors file.

    Raises
    ------
    CheckpointError
        If the file cannot be written.
    InputError
        If an argument is of another kind, or `extra` holds what JSON cannot.
    """
    path = _path(path)
    if not isinstance(network, tuple(_KINDS.values())):
        raise InputError("network", repr(network)[:60], "an ActorCritic or a QuantileNetwork")
    header = {"format": FORMAT, "kind": type(network).__name__, "shape": network.shape(), "extra": extra or {}}
    try:
        text = json.dumps(header)
    except (TypeError, ValueError) as error:
        raise InputError("extra", str(error), "values that JSON can hold") from None
    tensors = {name: value.detach().contiguous() for name, value in network.state_dict().items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file(tensors, str(path), metadata={"ccdtools": text})
    except (OSError, SafetensorError) as error:
        raise CheckpointError(path, error, "a file that can be written") from None


def load(path: str | Path, *, action_limits: LimitsReader | None = None) -> tuple[Any, dict[str, Any]]:
    """Return the network of a file and its `extra` values.

    Parameters
    ----------
    path : path of a file
    action_limits : callable, optional
        Makes `ActionLimits` of their plain values, needed for a policy that has some.

    Raises
    ------
    CheckpointError
        If the file is missing, unreadable, or not one of ours.
    InputError
        If `path` is no path.
    """
    path = _path(path)
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise CheckpointError(path, error, "a file written by ccdtools") from None
    try:
        header = json.loads(metadata.get("ccdtools", "{}"))
    except ValueError:
        header = None
    header = header if isinstance(header, dict) else {}
    if header.get("format") != FORMAT or header.get("kind") not in _KINDS:
        raise CheckpointError(path, f"format {header.get('format')!r} of {header.get('kind')!r}", repr(FORMAT))
    shape = header.get("shape")
    limits = shape.get("action_limits") if isinstance(shape, dict) else None
    if limits is not None and action_limits is None:
        raise CheckpointError(path, "action limits, which depend on the design", "a file read by ccdtools.load_policy")
    try:
        network = _KINDS[header["kind"]].from_shape(shape)
        network.load_state_dict(tensors)
        if limits is not None and action_limits is not None:
            network.action_limits = action_limits(limits)
        return network.eval(), dict(header["extra"])
    except (RuntimeError, KeyError, IndexError, TypeError, ValueError):
        expected = "an intact file of this version: if it is of another, train the network and save it anew"
        raise CheckpointError(path, "tensors that do not fit the header", expected) from None


def _path(value: Any) -> Path:
    """Return a path; refuse anything else."""
    if not isinstance(value, (str, os.PathLike)):
        raise InputError("path", repr(value)[:60], "the path of a file")
    return Path(value)
