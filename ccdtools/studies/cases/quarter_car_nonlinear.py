"""The quarter car with hardening spring and asymmetric damper."""

from ccdtools.studies.cases._cars import quarter_car_study

study = quarter_car_study("quarter_car_nonlinear", "Quarter car, nonlinear", nonlinear=True)
