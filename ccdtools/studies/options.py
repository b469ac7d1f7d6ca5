"""Options of a run, checked before slow imports."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ccdtools.exceptions import InputError
from ccdtools.limit_tolerance import TOLERANCES, as_limit_tolerance
from ccdtools.studies.price import RedesignPrice, accepted_loss
from ccdtools_ground.door import as_choice, as_count, as_flag, as_positive, as_share, nearest, shown

CHOICES = {
    "preset": ("default", "paper"), "method": ("pathwise", "ppo", "pathwise+ppo"),
    "design_gradient": ("pathwise", "network_input"), "sets": ("auto", "lqr", "none"),
    "driver": ("mild", "aggressive"), "filter": ("none", "admissible"),
}  # fmt: skip
FILES = ("disturbance", "road", "speed")
WHOLE = re.compile(r"[+-]?[0-9]{1,40}")
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Options:
    """Options of ``ccdtools run``, kept in run.json for `resume`.

    Attributes
    ----------
    study : str
        Name of a study, or the absolute path of its file.
    generations, seed, quick, preset, expert, method, design_gradient, sets, sets_time_limit
        As in `Generations` and `configuration`.
    x0, p0 : list of float or None
        Another initial state and first design.
    redesign_price, accept_loss, filter : str or None
        As in `Study`; the study's own where None.
    redesign_cost : str or None
        As `RedesignCost.parse` takes it; the study's own where None.
    drift, trial
        As in `configuration`.
    limits : str or None
        The `limit_tolerance` of the study: mpc, off, or two numbers "0.01,0.05".
    disturbance, column, road, speed, driver : str or None
        Files of a recorded disturbance, or the driver of a generated one.

    Raises
    ------
    InputError
        If a value is of another kind or unknown, or two options exclude each other; it names the option.
    """

    study: str
    generations: int = 2
    seed: int = 0
    quick: bool = False
    preset: str = "default"
    expert: str | None = None
    method: str | None = None
    design_gradient: str | None = None
    sets: str | None = None
    sets_time_limit: float | None = None
    x0: list[float] | None = None
    p0: list[float] | None = None
    disturbance: str | None = None
    column: str | None = None
    road: str | None = None
    speed: str | None = None
    driver: str | None = None
    redesign_price: str | None = None
    limits: str | None = None
    filter: str | None = None
    accept_loss: str | None = None
    drift: float | None = None
    trial: bool = False
    redesign_cost: str | None = None

    def __post_init__(self) -> None:
        _check_study(self.study)
        as_count("--generations", self.generations)
        as_count("--seed", self.seed, least=0)
        for name in ("quick", "trial"):
            as_flag(f"--{name}", getattr(self, name))
        for name, choices in CHOICES.items():
            if getattr(self, name) is not None or getattr(Options, name) is not None:
                as_choice(f"--{name.replace('_', '-')}", getattr(self, name), choices)
        if self.expert is not None and not isinstance(self.expert, str):
            raise InputError("--expert", shown(self.expert), "the name of an expert")
        self._check_sizes()
        for name in ("x0", "p0"):
            values = getattr(self, name)
            right = isinstance(values, list) and all(type(v) in (int, float) and math.isfinite(v) for v in values)
            if values is not None and not (right and values):
                raise InputError(f"--{name}", shown(values), "a list of finite numbers")
        self._check_source()

    def _check_sizes(self) -> None:
        if self.sets_time_limit is not None:
            as_positive("--sets-time-limit", self.sets_time_limit, unit="s")
        if self.redesign_price is not None:
            RedesignPrice.parse(self.redesign_price, "--redesign-price")
        if self.redesign_cost is not None:
            from ccdtools.studies.redesign_cost import RedesignCost  # loads SciPy's statistics

            RedesignCost.parse(self.redesign_cost, "--redesign-cost")
        if self.accept_loss is not None:
            accepted_loss(self.accept_loss, "--accept-loss")
        if self.drift is not None:
            as_share("--drift", self.drift)
        self.limit_tolerance()

    def _check_source(self) -> None:
        for name in (*FILES, "column"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, str):
                raise InputError(f"--{name}", shown(value), "text")
        given = self.sources()
        if len(given) > 1:
            raise InputError(f"--{given[1]}", f"it together with --{given[0]}", "one source of the disturbance")
        if self.column is not None and self.disturbance is None:
            raise InputError("--column", "it without --disturbance", "the file it is a column of")

    def sources(self) -> list[str]:
        """Options that name the disturbance's source; road with speed is one."""
        given = [name for name in ("disturbance", "road", "speed", "driver") if getattr(self, name) is not None]
        return [name for name in given if name != "speed" or "road" not in given]

    def limit_tolerance(self) -> str | tuple[float, float] | None:
        """Tolerance of the state limits by `limits`; None for the study's own."""
        if self.limits is None or self.limits in TOLERANCES:
            return self.limits
        expected = "mpc, off, or two numbers: fraction of the states outside X, peak depth in half-widths"
        parts = self.limits.split(",") if isinstance(self.limits, str) else []
        if len(parts) != 2 or not all(NUMBER.fullmatch(part.strip()) for part in parts):
            raise InputError("--limits", shown(self.limits), expected)
        return as_limit_tolerance("--limits", tuple(float(part) for part in parts))

    def check_files(self) -> None:
        """Raise unless the files of a recording are there."""
        for name in FILES:
            value = getattr(self, name)
            if value is not None and not _is_file(value):
                raise InputError(f"--{name}", f"{value!r}, which is not a file", "the path of a CSV file")

    @classmethod
    def from_json(cls, values: object) -> Options:
        """Options kept in a run.json.

        Raises
        ------
        InputError
            If a name or a value is not one of this version.
        """
        known = {field.name for field in fields(cls)}
        if not isinstance(values, Mapping) or set(values) != known:
            raise InputError("folder", "a run.json of another kind", "one of this version of ccdtools")
        try:
            return cls(**{str(name): value for name, value in values.items()})
        except InputError as error:
            name = f"run.json, {error.argument.removeprefix('--').replace('-', '_')}"
            raise InputError(name, error.got, error.expected, error.cure) from None


def study_names() -> list[str]:
    """Names of the studies in `ccdtools.studies.cases`."""
    cases = Path(__file__).parent / "cases"
    return sorted(file.stem for file in cases.glob("*.py") if not file.stem.startswith("_"))


def known_studies() -> str:
    """Text on what may be asked for as a study."""
    return f"one of {', '.join(study_names())}, or a Python file"


@contextmanager
def blamed_on_options(names: dict[str, str]) -> Iterator[None]:
    """Make an `InputError` name the option that an argument came from."""
    try:
        yield
    except InputError as error:
        if error.argument not in names:
            raise
        raise InputError(names[error.argument], error.got, error.expected, error.cure) from None


def described_studies() -> dict[str, str]:
    """First line of every packaged study by name, without running it."""
    cases = Path(__file__).parent / "cases"
    sources = {name: (cases / f"{name}.py").read_text(encoding="utf-8") for name in study_names()}
    return {name: (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0] for name, text in sources.items()}


def located(study: str) -> str:
    """Name of the study, or the absolute path of its file."""
    return str(Path(study).resolve()) if study.endswith(".py") and "\0" not in study else study


def whole_number(argument: str, text: str) -> int:
    """Whole number in a text."""
    if not WHOLE.fullmatch(text):
        raise InputError(argument, repr(text[:50]), "a whole number below 1e40, such as 42")
    return int(text)


def number(argument: str, text: str | None, such: str) -> float | None:
    """Number in a text; None of None."""
    if text is not None and not NUMBER.fullmatch(text.strip()):
        raise InputError(argument, repr(text[:40]), f"one number, {such}")
    return None if text is None else float(text)


def numbers(argument: str, text: str | None) -> list[float] | None:
    """Numbers of a text like "-3,0.5"; None of None."""
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    if not all(NUMBER.fullmatch(part) and math.isfinite(float(part)) for part in parts):
        raise InputError(argument, repr(text[:40]), "finite numbers separated by commas")
    return [float(part) for part in parts]


def _check_study(study: Any) -> None:
    expected = known_studies()
    if not isinstance(study, str):
        raise InputError("study", shown(study), expected)
    if study.endswith(".py") and not _is_file(study):
        raise InputError("study", f"{study}, which is not a file", "a Python file that declares `study`")
    if not study.endswith(".py") and study not in study_names():
        cure = f"A file needs its ending: {study}.py." if _is_file(f"{study}.py") else nearest(study, study_names())
        raise InputError("study", repr(study[:60]), expected, cure)


def _is_file(path: str) -> bool:
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False
