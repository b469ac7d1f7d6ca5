"""Preparation of a run: study, configuration and early checks."""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ccdtools.disturbances.disturbance import Recorded
from ccdtools.exceptions import InputError
from ccdtools.studies.asked_study import asked_study, blamed_on_source_options
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.fingerprint import differences, fingerprint, summary
from ccdtools.studies.loading import LoadedStudy
from ccdtools.studies.options import Options
from ccdtools.studies.presets import StudyConfig, configuration
from ccdtools.studies.run_folder import DISTURBANCE, RunFolder
from ccdtools.studies.study import Study

FORMAT = 4  # This is the version of run.json.


@dataclass(frozen=True, eq=False)
class PreparedRun:
    """Contents of a run besides its folder."""

    options: Options
    study: Study
    config: StudyConfig
    begun_with: dict[str, Any]

    def begin(self, folder: RunFolder) -> None:
        """Write run.json and a copy of a recorded disturbance."""
        if isinstance(self.study.real.disturbance, Recorded):
            kept = io.BytesIO()
            np.save(kept, self.study.real.disturbance.signal)
            folder.write_bytes(DISTURBANCE, kept.getvalue())
        options = asdict(self.options)
        folder.write_json("run.json", {"format": FORMAT, "options": options, "begun_with": self.begun_with})


def prepare(options: Options, asked: LoadedStudy | None = None) -> PreparedRun:
    """Run that the options ask for; `asked` is its study if made.

    Raises
    ------
    InputError
        If the study, a recording or what they give together cannot be run; it names an option only if it was given.
    """
    asked = asked_study(options) if asked is None else asked
    study = asked.study
    with blamed_on_source_options(options):
        config = configuration(
            study, preset=options.preset, quick=options.quick, expert=options.expert, method=options.method,
            design_gradient=options.design_gradient, sets=options.sets, sets_time_limit=options.sets_time_limit,
        )
        Evaluation(study, config, options.seed).check_recording()
    return PreparedRun(options, study, config, fingerprint(asked, config))


def prepare_again(folder: RunFolder) -> PreparedRun:
    """Run that was begun in a folder.

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
    prepared = prepare(options, asked_study(options, _kept_recording(folder, options)))
    found = differences(kept["begun_with"], prepared.begun_with)
    if found:
        cure = "Undo the change, or begin a new run."
        raise InputError("folder", f"{folder.path}, begun with another study: {summary(found)}", "the same one", cure)
    return prepared


def _kept_recording(folder: RunFolder, options: Options) -> Recorded | None:
    """Recording kept with a run; None if there was none."""
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
