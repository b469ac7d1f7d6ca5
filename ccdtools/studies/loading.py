"""Finding a study by name or in a Python file."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType

from ccdtools.exceptions import InputError
from ccdtools.studies.options import known_studies, study_names
from ccdtools.studies.study import Study
from ccdtools_ground.packages import NAMES, what_hides_ours
from ccdtools_ground.user_functions import in_words


def load_study(name: str | Path) -> Study:
    """Study of a name, or the one declared in a Python file.

    Any module of `ccdtools.studies.cases` with a ``study`` is found by its file name.

    Raises
    ------
    InputError
        If there is no such study, or the file declares none or stops with an error.
    """
    return load_with_sources(name)[0]


def load_with_sources(name: str | Path) -> tuple[Study, dict[str, str]]:
    """Study of a name or file, with the SHA-256 of its source files by name."""
    if not isinstance(name, str | Path):
        raise InputError("study", f"a {type(name).__name__}", known_studies())
    text = str(name)
    if text.endswith(".py"):
        module, neighbours = _executed(Path(text))
    elif text in study_names():
        module = import_module(f"ccdtools.studies.cases.{text}")
        neighbours = []
    else:
        raise InputError("study", repr(text), known_studies())
    study = getattr(module, "study", None)
    if not isinstance(study, Study):
        raise InputError("study", f"{text}, which declares no `study`", "a ccdtools.studies.Study of that name")
    files = [Path(m.__file__) for m in (module, *neighbours) if m.__file__]
    return study, {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def _executed(path: Path) -> tuple[ModuleType, list[ModuleType]]:
    """Module of a file, and the modules imported from its folder."""
    if not path.is_file():
        raise InputError("study", f"{path}, which is not a file", "a Python file that declares `study`")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with _importing_from(path.resolve().parent) as neighbours:
        try:
            spec.loader.exec_module(module)
        except (Exception, SystemExit) as error:
            raise _stopped(path, _place(path, error), error) from error
    return module, neighbours


@contextmanager
def blamed_on_source(study: str) -> Iterator[None]:
    """Turn an exception in the user's study file into an `InputError`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        path = Path(study)
        place = _place(path, error)
        if not study.endswith(".py") or place == str(path):
            raise
        raise _stopped(path, place, error) from error


@contextmanager
def _importing_from(folder: Path) -> Iterator[list[ModuleType]]:
    """Put `folder` first on the path and list its imports."""
    before = set(sys.modules)
    imported: list[ModuleType] = []
    sys.path.insert(0, str(folder))
    try:
        yield imported
    finally:
        sys.path.remove(str(folder))
        for name in sorted(set(sys.modules) - before):
            file = getattr(sys.modules[name], "__file__", None)
            if file and _is_beside(Path(file), folder):
                imported.append(sys.modules.pop(name))


def _is_beside(file: Path, folder: Path) -> bool:
    """Whether a source file is the user's own, in the study's folder."""
    if not file.is_absolute() or not file.resolve().is_relative_to(folder):
        return False
    parts = file.resolve().relative_to(folder).parts
    return parts[0] not in NAMES and not {"site-packages", "dist-packages"} & set(parts)


def _place(path: Path, error: BaseException) -> str:
    """FILE:LINE of an error in a study file or a file beside it."""
    place = str(path)
    folder = path.resolve().parent
    for frame in traceback.extract_tb(error.__traceback__):
        file = Path(frame.filename)
        if file.resolve() == path.resolve():
            place = f"{path}:{frame.lineno}"
        elif _is_beside(file, folder):
            place = f"{file}:{frame.lineno}"
    return f"{error.filename}:{error.lineno}" if isinstance(error, SyntaxError) and error.filename else place


def _stopped(path: Path, place: str, error: BaseException) -> InputError:
    """Error at a place of a study file, on one line."""
    if isinstance(error, InputError):
        got = f"{place}, which stops with {error.argument}: got {error.got}"
        return InputError("study", got, error.expected, error.cure)
    if isinstance(error, RuntimeError):  # of CasADi
        reason, cure = in_words(error)
    else:
        text = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())
        reason, cure = f"{type(error).__name__}: {text}", what_hides_ours() if isinstance(error, ImportError) else ""
    return InputError("study", f"{place}, which stops with {reason}".rstrip(". "), "a file that runs", cure)
