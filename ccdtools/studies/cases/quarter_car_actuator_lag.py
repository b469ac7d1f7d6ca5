"""The quarter car with an actuator lag of 1/60 s."""

from ccdtools.studies.cases._cars import quarter_car_study

study = quarter_car_study("quarter_car_actuator_lag", "Quarter car with actuator lag", actuator_lag=True)
