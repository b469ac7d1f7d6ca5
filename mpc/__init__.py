"""Model predictive control: linear MPC online, explained infeasibility, explicit MPC and its C code."""

from .exceptions import InfeasibleError, InvalidDataError, MPCError, NotConvexError, NotStabilisableError
from .explicit import ExplicitMPC
from .infeasibility import Explanation
from .linear_mpc import LinearMPC
from .lqr import lqr
from .mpqp import MPQPStatus, solve_mpqp
from .parametric_qp import ParametricQP
from .plan import Plan, Status
from .tracking import OffsetFreeMPC

__all__ = [
    "Explanation",
    "ExplicitMPC",
    "InfeasibleError",
    "InvalidDataError",
    "LinearMPC",
    "MPCError",
    "MPQPStatus",
    "NotConvexError",
    "NotStabilisableError",
    "OffsetFreeMPC",
    "ParametricQP",
    "Plan",
    "Status",
    "lqr",
    "solve_mpqp",
]
