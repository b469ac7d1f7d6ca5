"""Study of a run with its options applied, fast to import."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import fields, replace
from typing import Any

from ccdtools.co_design.method_names import STUDY_EXPERTS
from ccdtools.disturbances.disturbance import Disturbance, Recorded
from ccdtools.disturbances.recordings import read_disturbance, read_road, read_speed
from ccdtools.exceptions import InputError
from ccdtools.studies.loading import load_with_sources
from ccdtools.studies.options import Options, blamed_on_options
from ccdtools.studies.price import DEFAULT_PRICE
from ccdtools.studies.redesign_cost import RedesignCost
from ccdtools.studies.study import Study
from ccdtools.vehicles.roads import GeneratedRoad, road_disturbance
from ccdtools_ground.door import as_choice


def asked_study(options: Options, recording: Recorded | None = None) -> tuple[Study, dict[str, str]]:
    """Study that the options ask for, or on a kept recording, and its sources.

    Raises
    ------
    InputError
        If there is no such study, or an option does not fit it.
    """
    study, sources = load_with_sources(options.study)
    _check_effect(options, study)
    source = recording if recording is not None else _source(options, study)
    with blamed_on_options({name: f"--{name}" for name in ("x0", "p0") if getattr(options, name) is not None}):
        study = study.started(x0=options.x0, p0=options.p0)
    asked = {"redesign_price": options.redesign_price, "accept_loss": options.accept_loss,
             "limit_tolerance": options.limit_tolerance(), "filter": options.filter}  # fmt: skip
    changes: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    if options.redesign_cost is not None:
        price = options.redesign_price or DEFAULT_PRICE  # not that of the study
        changes |= {"redesign_cost": RedesignCost.parse(options.redesign_cost), "redesign_price": price}
    with blamed_on_source_options(options):
        if source is not None:
            changes["real"] = study.real.each(disturbance=source)
        return replace(study, **changes) if changes else study, sources


def blamed_on_source_options(options: Options) -> AbstractContextManager[None]:
    """Make an `InputError` about the disturbance name its option."""
    given = options.sources()
    return blamed_on_options({"real.disturbance": f"--{given[0]}", "disturbance": f"--{given[0]}"} if given else {})


def _check_effect(options: Options, study: Study) -> None:
    for field in fields(Options)[1:] if study.options_taken else ():
        if field.name not in study.options_taken and getattr(options, field.name) != field.default:
            *some, last = (f"--{name.replace('_', '-')}" for name in study.options_taken)
            got = f"it for {study.name!r}, {study.runs_so}"
            raise InputError(f"--{field.name.replace('_', '-')}", got, f"{', '.join(some)} and {last} alone")
    if options.expert is not None:
        as_choice("--expert", options.expert, (*STUDY_EXPERTS, *study.laws))
    sets = study.sets if options.sets is None else options.sets
    if options.sets_time_limit is not None and sets != "auto":
        raise InputError("--sets-time-limit", f"it with sets {sets!r}, which computes none", "it with --sets auto")
    for name in ("redesign_price", "redesign_cost"):
        if getattr(options, name) is not None and options.generations == 1:
            raise InputError(
                f"--{name.replace('_', '-')}", "it with --generations 1", "2 generations: the second one redesigns"
            )
    if options.preset == "paper" and "pathwise" in (options.method or ""):
        got = f"{options.method!r} with --preset paper, which has no rate for it"
        raise InputError("--method", got, "ppo with that preset, or --preset default")
    if options.design_gradient is not None and not study.plant.design.allowed.free.any():
        raise InputError("--design-gradient", "it for a design that has no gradient", "an entry that is free to move")


def _source(options: Options, study: Study) -> Disturbance | None:
    """Disturbance of the options; None for the study's own."""
    dt = study.plant.dt
    given = options.sources()
    if given and given[0] != "disturbance" and not study.real.road:
        cure = "Its real plant takes --disturbance FILE.csv; one on a road is declared by RealPlant(…, road=True)."
        got = f"it for {study.name!r}, whose disturbance is not the road under one wheel"
        raise InputError(f"--{given[0]}", got, "a study that declares a road, such as suspension", cure)
    for own, other in (("road", "speed"), ("speed", "road")):
        if getattr(options, own) is not None and getattr(options, other) is None:
            expected = "both: elevation over distance, speed over time"
            raise InputError(f"--{own}", f"it without --{other}", expected)
    options.check_files()
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
