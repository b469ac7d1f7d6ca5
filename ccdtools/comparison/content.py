"""Content of functions and objects, the same in every process."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator, Mapping
from functools import cache, cached_property
from hashlib import sha256
from importlib.metadata import packages_distributions
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis))


def content_of(value: Any) -> str:
    """Digest of what a function does, or an object holds.

    Of a function: its instructions, defaults, what it closes over, and the functions, classes and values of its module
    and of others that are not installed, as far as it names them. What is installed is known by its name. Values that
    were only cached do not count, nor do names of files and lines.
    """
    return _Walk().digest(value).hex()[:24]


class _Walk:
    """Walk through values, each object once."""

    def __init__(self) -> None:
        self.places: dict[int, int] = {}
        self.held: list[Any] = []  # so that no other object gets the place of one that was seen

    def digest(self, value: Any) -> bytes:
        """Digest of a value's kind and parts."""
        if isinstance(value, PLAIN):
            return _digest(type(value).__name__, repr(value))
        if isinstance(value, np.ndarray) and value.dtype != object:
            return _digest(str(value.dtype), repr(value.shape), np.ascontiguousarray(value).tobytes())
        if id(value) in self.places:
            return _digest("again", str(self.places[id(value)]))
        self.places[id(value)] = len(self.places)
        self.held.append(value)
        try:
            parts = [part if isinstance(part, bytes) else self.digest(part) for part in self._parts(value)]
        except Exception:  # an object that does not say what it holds is known by its type
            parts = []
        return _digest(type(value).__name__, *parts)

    def _parts(self, value: Any) -> Iterator[Any]:
        """Parts of a value, in an order of their own."""
        if isinstance(value, ModuleType):
            yield value.__name__
        elif isinstance(value, set | frozenset):
            yield from sorted(self.digest(one) for one in value)
        elif isinstance(value, Mapping) and type(value).__module__ in ("builtins", "collections", "types"):
            yield from (part for item in value.items() for part in item)
        elif isinstance(value, list | tuple) and type(value).__module__ == "builtins":
            yield from value
        elif isinstance(value, CodeType):
            yield value.co_code
            yield from (value.co_consts, value.co_names, value.co_varnames, value.co_freevars)
        elif isinstance(value, type) or (callable(value) and hasattr(value, "__qualname__")):
            yield from self._of_named(inspect.unwrap(value))
        elif hasattr(value, "detach"):  # a tensor
            yield value.detach().cpu().numpy()
        elif hasattr(type(value), "as_given"):
            yield from value.as_given()
        else:
            yield from self._of_object(value)

    def _of_named(self, value: Any) -> Iterator[Any]:
        """Parts of a function, a method or a class."""
        if isinstance(value, MethodType):
            yield from (value.__func__, value.__self__)
        elif _installed(str(value.__module__)) or not isinstance(value, type | FunctionType):
            yield f"{value.__module__}.{value.__qualname__}"
        elif isinstance(value, type):
            known = sorted((name, part) for name, part in vars(value).items() if not name.startswith("__"))
            own = {name: getattr(value, name) for name in ("__init__", "__call__") if name in vars(value)}
            yield from (value.__bases__, *(part for item in (*known, *own.items()) for part in item))
        else:
            cells = [cell.cell_contents for cell in value.__closure__ or ()]
            yield from (value.__code__, value.__defaults__, value.__kwdefaults__, cells)
            yield from (value.__globals__.get(name) for name in _names(value.__code__))

    def _of_object(self, value: Any) -> Iterator[Any]:
        """Parts of an object, as it is copied."""
        for part in value.__reduce_ex__(4):
            if isinstance(part, dict):
                kind = type(value)
                part = {k: v for k, v in part.items() if not isinstance(getattr(kind, str(k), None), cached_property)}
            yield list(part) if inspect.isgenerator(part) or hasattr(part, "__next__") else part


def _digest(*parts: str | bytes) -> bytes:
    """Digest of texts and digests."""
    found = sha256()
    for part in parts:
        raw = part.encode() if isinstance(part, str) else part
        found.update(len(raw).to_bytes(8, "big") + raw)
    return found.digest()


def _names(code: CodeType) -> list[str]:
    """Names that code and the code within it look up."""
    inner = (const for const in code.co_consts if isinstance(const, CodeType))
    return sorted({*code.co_names, *(name for one in inner for name in _names(one))})


@cache
def _packages() -> frozenset[str]:
    """Names of installed packages and those of Python itself."""
    return frozenset({*packages_distributions(), *sys.stdlib_module_names} - {"__main__"})


def _installed(module: str) -> bool:
    """Whether a module belongs to an installed package."""
    return module.split(".")[0] in _packages()
