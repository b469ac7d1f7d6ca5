"""Content of functions and objects, the same in every process."""

from __future__ import annotations

import inspect
import secrets
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from threading import Lock, RLock
from types import BuiltinMethodType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

OURS = ("ccdtools", "ccdtools_ground", "invariant_sets", "learning", "mpc")
PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis))
KINDS: dict[Any, Callable[[Any], Iterable[Any]]] = {
    ModuleType: lambda module: (module.__name__,),
    CodeType: lambda code: (code.co_code, code.co_consts, code.co_names, code.co_varnames, code.co_freevars),
    property: lambda one: (one.fget, one.fset, one.fdel),
    cached_property: lambda one: (one.func,),
    (classmethod, staticmethod): lambda one: (one.__func__,),
    (MethodType, BuiltinMethodType): lambda one: (one.__name__, one.__self__, getattr(one, "__func__", None)),
    type(Lock()): lambda lock: (),
    type(RLock()): lambda lock: (),
}
METHODS: dict[str, Callable[[Any], Iterable[Any]]] = {
    "cache_info": lambda cached: (inspect.unwrap(cached),),
    "detach": lambda tensor: (str(tensor.dtype), tensor.detach().cpu().double().numpy()),
    "serialize": lambda expression: (expression.serialize(),),  # of CasADi
    "as_given": lambda one: one.as_given(),
}


def content_of(value: Any) -> str:
    """Digest of what a function does, or an object holds.

    Of a function: its instructions, defaults, what it closes over, and the functions, classes and values of its module
    and of others that are not installed, as far as it names them, also as attributes of a module. What is installed is
    known by its name and by what it closes over. Values that were only cached do not count, nor do names of files and
    lines. An object that does not say what it holds is another one each time.
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
        if type(value) is np.ndarray and value.dtype != object:
            return _digest(str(value.dtype), repr(value.shape), np.ascontiguousarray(value).tobytes())
        if id(value) in self.places:
            return _digest("again", str(self.places[id(value)]))
        self.places[id(value)] = len(self.places)
        self.held.append(value)
        try:
            parts = [part if isinstance(part, bytes) else self.digest(part) for part in self._parts(value)]
        except Exception:  # it does not say what it holds: it is taken for another one
            parts = [secrets.token_bytes(16)]
        return _digest(type(value).__name__, *parts)

    def _parts(self, value: Any) -> Iterator[Any]:
        """Parts of a value, in an order of their own."""
        known = next((parts for kind, parts in KINDS.items() if isinstance(value, kind)), None)
        if known is not None:
            yield from known(value)
        elif isinstance(value, set | frozenset):
            yield from sorted(_Walk().digest(one) for one in value)
        elif isinstance(value, Mapping) and type(value).__module__ in ("builtins", "collections", "types"):
            yield from (part for item in value.items() for part in item)
        elif isinstance(value, list | tuple) and type(value).__module__ == "builtins":
            yield from value
        elif isinstance(value, type) or (callable(value) and hasattr(value, "__qualname__")):
            yield from self._of_named(value)
        else:
            yield from self._of_object(value)

    def _of_named(self, value: Any) -> Iterator[Any]:
        """Parts of a function or a class."""
        if isinstance(value, FunctionType):
            yield from (value.__defaults__, value.__kwdefaults__, *map(_held, value.__closure__ or ()))
        if _installed(str(value.__module__)) or not isinstance(value, type | FunctionType):
            yield f"{value.__module__}.{value.__qualname__}"
        elif isinstance(value, type):
            yield value.__bases__
            for name, part in sorted(vars(value).items()):
                if not name.startswith("__") or inspect.isroutine(part):
                    yield from (name, part)
        else:
            yield value.__code__
            names = _names(value.__code__)
            for name in names:
                found = value.__globals__.get(name, sys.modules.get(name))
                yield found
                yield from _within(found, names, set())

    def _of_object(self, value: Any) -> Iterator[Any]:
        """Parts of an object, as it is copied."""
        for name, parts in METHODS.items():
            if callable(getattr(type(value), name, None)):
                yield from parts(value)
                return
        for part in value.__reduce_ex__(4):
            if isinstance(part, dict):
                part = {k: v for k, v in part.items() if not _only_cached(value, k, v)}
            yield list(part) if inspect.isgenerator(part) or hasattr(part, "__next__") else part


def _only_cached(value: Any, name: Any, part: Any) -> bool:
    """Whether a part of an object's state is what a property of that name has cached."""
    own = isinstance(getattr(type(value), str(name), None), cached_property)
    return own and vars(value).get(name) is part


def _within(module: Any, names: Iterable[str], seen: set[int]) -> Iterator[Any]:
    """What has one of the names in a module of one's own, and in such modules within it."""
    if not isinstance(module, ModuleType) or id(module) in seen or _installed(module.__name__):
        return
    seen.add(id(module))
    for name in names:
        if name in vars(module):
            yield vars(module)[name]
            yield from _within(vars(module)[name], names, seen)


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


def _held(cell: Any) -> Any:
    """What a function closes over; None of a name without a value yet."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _installed(module: str) -> bool:
    """Whether a module belongs to an installed package, this one or Python itself."""
    package = module.split(".")[0]
    if package in OURS or (package in sys.stdlib_module_names and package != "__main__"):
        return True
    file = getattr(sys.modules.get(package), "__file__", None)
    roots = (sysconfig.get_path(name) for name in ("purelib", "platlib"))
    return file is not None and any(Path(file).is_relative_to(root) for root in roots)
