"""Model predictive control: linear MPC online, explained infeasibility, explicit MPC and its C code."""

from .exceptions import InvalidDataError, MPCError, NotConvexError, NotStabilisableError
from .linear_mpc import LinearMPC
from .lqr import lqr
from .parametric_qp import ParametricQP
from .plan import Plan, Status

__all__ = [
    "InvalidDataError",
    "LinearMPC",
    "MPCError",
    "NotConvexError",
    "NotStabilisableError",
    "ParametricQP",
    "Plan",
    "Status",
    "lqr",
]
