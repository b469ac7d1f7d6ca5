from ccdtools.disturbances.recordings import read_road as read_road, read_speed as read_speed
from ccdtools.vehicles.car_metrics import (
    SuspensionMetrics as SuspensionMetrics,
    suspension_metrics as suspension_metrics,
)
from ccdtools.vehicles.corner import RealStrut as RealStrut
from ccdtools.vehicles.iso_road import ISORoad as ISORoad
from ccdtools.vehicles.ride import Ride as Ride
from ccdtools.vehicles.ride_comfort import comfort as comfort, weighted_acceleration as weighted_acceleration
from ccdtools.vehicles.roads import GeneratedRoad as GeneratedRoad, road_disturbance as road_disturbance
from ccdtools.vehicles.semi_active import SemiActive as SemiActive, clipped_lqr as clipped_lqr, skyhook as skyhook
