"""A quarter car on ISO 8608 roads; spring and damper are the design."""

from ccdtools.studies.cases._cars import quarter_car_study

study = quarter_car_study("quarter_car", "Quarter car")
