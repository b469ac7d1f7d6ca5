from ccdtools.estimation.cubature import CubatureKalmanFilter as CubatureKalmanFilter
from ccdtools.estimation.extended import ExtendedKalmanFilter as ExtendedKalmanFilter
from ccdtools.estimation.kalman import KalmanFilter as KalmanFilter
from ccdtools.estimation.measurement import Measurement as Measurement
