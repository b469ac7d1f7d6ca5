"""Plants of the case studies."""

from ccdtools import Plant, load_study


def quarter_car(*, nonlinear: bool = False) -> Plant:
    """The suspension of the case study, or its real plant, whose spring and damper are not linear."""
    study = load_study("suspension")
    return study.real.plant if nonlinear else study.plant
