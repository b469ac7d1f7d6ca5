"""Half a car on ISO 8608 roads; springs and dampers are the design."""

from ccdtools.plants.library import half_car
from ccdtools.studies.cases._cars import car_study

study = car_study("half_car", "Half car", half_car(), half_car(real=True))
