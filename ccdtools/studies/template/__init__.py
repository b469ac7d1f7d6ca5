"""File that ``ccdtools new`` writes."""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from ccdtools.exceptions import InputError

PLACEHOLDER = "my_study"


def write_template(name: str, folder: str | Path = ".") -> Path:
    """Write a commented study to FOLDER/NAME.py and return its path.

    Raises
    ------
    InputError
        If the name is none for a Python module or that of an installed one, or the file exists or cannot be written.
    """
    stem = name.removesuffix(".py")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,99}", stem):
        raise InputError("name", repr(name[:60]), "letters, digits and underscores, beginning with a letter")
    path = Path(folder) / f"{stem}.py"
    if keyword.iskeyword(stem) or (not path.exists() and find_spec(stem) is not None):
        raise InputError("name", repr(stem), "a name that Python or an installed package does not use")
    source = files("ccdtools.studies.template").joinpath(f"{PLACEHOLDER}.py").read_text(encoding="utf-8")
    source = source.replace(PLACEHOLDER, stem).replace("My study", stem.replace("_", " ").capitalize())
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(source)
    except FileExistsError:
        raise InputError("name", f"{path}, which exists", "the name of a new file") from None
    except OSError as error:
        raise InputError("name", str(path), f"a file that can be written ({error.strerror})") from None
    return path
