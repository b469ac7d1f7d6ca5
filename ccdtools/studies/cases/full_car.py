"""A full car on ISO 8608 roads; springs and dampers are the design.

Its road is given by speeds, so there are 15 states; `full_car_heights` has 14.
"""

from ccdtools.plants.library import full_car
from ccdtools.studies.cases._cars import CAR, car_study

study = car_study("full_car", "Full car", full_car(), full_car(real=True), track=2 * CAR.half_track)
