"""The quarter car with a spring that hardens and a damper that is stiffer in rebound, known to the model."""

from ccdtools.studies.cases._quarter_cars import quarter_car_study

study = quarter_car_study("quarter_car_nonlinear", "Quarter car, nonlinear", nonlinear=True)
