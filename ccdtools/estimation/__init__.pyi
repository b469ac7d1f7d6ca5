from ccdtools.estimation.cubature import CubatureKalmanFilter as CubatureKalmanFilter
from ccdtools.estimation.kalman import KalmanFilter as KalmanFilter
from ccdtools.estimation.measurement import Measurement as Measurement
