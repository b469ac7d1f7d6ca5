"""A run made ready: the study as the options change it, its configuration, and all that can be checked beforehand."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.disturbances.disturbance import Disturbance, Recorded
from ccdtools.disturbances.recordings import read_disturbance, read_road, read_speed
from ccdtools.disturbances.roads import GeneratedRoad, road_disturbance
from ccdtools.exceptions import InputError
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.fingerprint import differences, fingerprint, summary
from ccdtools.studies.loading import LoadedStudy, load_with_sources
from ccdtools.studies.options import Options
from ccdtools.studies.presets import StudyConfig, configuration
from ccdtools.studies.run_folder import DISTURBANCE, RunFolder
from ccdtools.studies.study import Study

FORMAT = 3  # of run.json


@dataclass(frozen=True, eq=False)
class PreparedRun:
    """What a run needs besides its folder."""

    options: Options
    study: Study
    config: StudyConfig
    begun_with: dict[str, Any]

    def begin(self, folder: RunFolder) -> None:
        """Write run.json, and a recorded disturbance: its file may be gone when the run is resumed."""
        if isinstance(self.study.real.disturbance, Recorded):
            kept = io.BytesIO()
            np.save(kept, self.study.real.disturbance.signal)
            folder.write_bytes(DISTURBANCE, kept.getvalue())
        options = asdict(self.options)
        folder.write_json("run.json", {"format": FORMAT, "options": options, "begun_with": self.begun_with})


def prepare(options: Options) -> PreparedRun:
    """The run that the options ask for.

    Raises
    ------
    InputError
        If the study, a recording or what they give together cannot be run; it names an option only if it was given.
    """
    loaded = load_with_sources(options.study)
    return _prepared(options, loaded, _source(options, loaded.study.plant.dt))


def prepare_again(folder: RunFolder) -> PreparedRun:
    """The run that was begun in a folder.

    Raises
    ------
    InputError
        If the folder is damaged, or the study or its configuration is no longer what the run was begun with.
    """
    kept = folder.read_json("run.json")
    if kept.get("format") != FORMAT or not isinstance(kept.get("begun_with"), dict):
        got = f"{folder.path} with a run.json of another kind"
        raise InputError("folder", got, "one of this version of ccdtools")
    options = Options.from_json(kept.get("options"))
    recording = _kept_recording(folder, options)
    loaded = load_with_sources(options.study)
    source = recording if recording is not None else _source(options, loaded.study.plant.dt)
    prepared = _prepared(options, loaded, source)
    found = differences(kept["begun_with"], prepared.begun_with)
    if found:
        cure = "Undo the change, or begin a new run."
        raise InputError("folder", f"{folder.path}, begun with another study: {summary(found)}", "the same one", cure)
    return prepared


def _prepared(options: Options, loaded: LoadedStudy, source: Disturbance | None) -> PreparedRun:
    """The run of a loaded study, from the starts and with the source of the disturbance that the options ask for."""
    study = loaded.study
    with blamed_on_options({name: f"--{name}" for name in ("x0", "p0") if getattr(options, name) is not None}):
        study = study.started(x0=_array(options.x0), p0=_array(options.p0))
    for name in ("redesign_price", "accept_loss"):
        if getattr(options, name) is not None:
            study = replace(study, **{name: getattr(options, name)})
    tolerance = options.limit_tolerance()
    if tolerance is not None:
        study = replace(study, limit_tolerance=tolerance)
    if options.filter is not None:
        study = replace(study, filter=options.filter)
    given = options.sources()
    with blamed_on_options({"real.disturbance": f"--{given[0]}", "disturbance": f"--{given[0]}"} if given else {}):
        if source is not None:
            study = replace(study, real=replace(study.real, disturbance=source))
        config = configuration(
            study, preset=options.preset, quick=options.quick, expert=options.expert, method=options.method,
            design_gradient=options.design_gradient, sets=options.sets, sets_time_limit=options.sets_time_limit,
        )
        Evaluation(study, config, options.seed).check_recording()
    return PreparedRun(options, study, config, fingerprint(LoadedStudy(study, loaded.sources), config))


@contextmanager
def blamed_on_options(names: dict[str, str]) -> Iterator[None]:
    """Have an `InputError` name the option that an argument came from; other arguments keep their names."""
    try:
        yield
    except InputError as error:
        if error.argument not in names:
            raise
        raise InputError(names[error.argument], error.got, error.expected, error.cure) from None


def _source(options: Options, dt: float) -> Disturbance | None:
    """The disturbance of the real plant that the options ask for; None for the study's own."""
    if options.disturbance is not None:
        signal = read_disturbance(options.disturbance, dt=dt, column=options.column, argument="--disturbance")
        return Recorded(signal)
    if options.road is not None and options.speed is not None:
        distance, elevation = read_road(options.road, argument="--road")
        time, speed = read_speed(options.speed, argument="--speed")
        with blamed_on_options({"road": "--road", "distance": "--road", "time": "--speed", "speed": "--speed"}):
            return Recorded(road_disturbance(distance, elevation, time, speed, dt=dt))
    if options.driver is not None:
        return GeneratedRoad(options.driver, dt)  # type: ignore[arg-type]
    return None


def _kept_recording(folder: RunFolder, options: Options) -> Recorded | None:
    """The recording that was kept with a run; None if there was none."""
    path = folder.path / DISTURBANCE
    asked = options.disturbance is not None or options.road is not None
    if not path.is_file():
        if asked:
            raise InputError("folder", f"{folder.path} without {DISTURBANCE}", "the recording the run was begun with")
        return None
    try:
        return Recorded(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError, TypeError):
        got = f"{folder.path} with a damaged {DISTURBANCE}"
        raise InputError("folder", got, "the recording the run was begun with") from None


def _array(values: list[float] | None) -> Array | None:
    """The values as an array; None of None."""
    return None if values is None else np.array(values)
