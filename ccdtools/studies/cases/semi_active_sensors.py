"""The semi-active car for two drivers on its sensors alone: accelerometers on body and wheel, and the travel.

A policy that is learned on the state of the nominal car is deployed behind the filter of that car. Four drives of two
seconds tell friction, asymmetry of the damper, hardening of the spring and bump stops of the real one.
"""

from dataclasses import fields, replace

from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.studies.cases import semi_active_damper as states
from ccdtools.studies.on_sensors import OnSensors
from learning import CloningConfig

SAME = {field.name: getattr(states.study, field.name) for field in fields(states.study)}

study = OnSensors(
    **SAME | {
        "name": "semi_active_sensors",
        "title": "A semi-active car on its sensors, for two drivers",
        "real": replace(states.study.real, runs=4),
        "unknown": states.unknown_car(),
        "settings": {  # two minutes
            "real_runs": 32, "cloning": CloningConfig(steps=1000), "codesign": CoDesignConfig(iterations=30, starts=1),
            "redesign": CoDesignConfig(iterations=16, starts=1, policy_rate=3e-4),
        },
    },
    noise=[0.1, 0.5, 0.002],  # m/s², m/s², m
)  # fmt: skip
