"""What test_presets.py claims, seen from inside."""

import json
from dataclasses import asdict

import pytest

from ccdtools.studies import configuration
from ccdtools.studies.stage_storage import jsonable


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_configuration_is_plain_values(study, preset):
    values = asdict(configuration(study, preset=preset, quick=True))
    assert json.loads(json.dumps(jsonable(values), allow_nan=False))["preset"] == preset
    assert values["codesign"]["ppo"]["gamma"] == 0.99
