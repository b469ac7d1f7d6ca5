"""A full car of seven degrees of freedom on roads of ISO 8608; springs and dampers of both axles are the design.

Its road is given by speeds, so there are 15 states: the plant with 14 has heights, which follow the hills out of any X.
"""

from ccdtools.plants.library import full_car
from ccdtools.studies.cases._cars import CAR, car_study

study = car_study("full_car", "Full car", full_car(), full_car(real=True), track=2 * CAR.half_track)
