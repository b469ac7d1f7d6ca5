"""The quarter car with a hardening spring and a damper stiffer in rebound."""

from ccdtools.studies.cases._quarter_cars import quarter_car_study

study = quarter_car_study("quarter_car_nonlinear", "Quarter car, nonlinear", nonlinear=True)
