"""Model predictive control: linear MPC online, explained infeasibility, explicit MPC and its C code."""

from mpc.exceptions import InfeasibleError, InputError, MPCError, NotConvexError, NotStabilisableError
from mpc.explicit.explicit import ExplicitMPC
from mpc.explicit.mpqp import MPQPStatus, solve_mpqp
from mpc.infeasibility import Explanation
from mpc.linear_mpc import LinearMPC
from mpc.lqr import lqr
from mpc.parametric_qp import Constraint, ParametricQP
from mpc.plan import Plan, Status
from mpc.sensitivities.plan_sensitivity import PlanSensitivity, SensitivityStatus
from mpc.sensitivities.regulator import LQRSensitivity, lqr_sensitivity
from mpc.tracking import OffsetFreeMPC

__all__ = [
    "Constraint",
    "Explanation",
    "ExplicitMPC",
    "InfeasibleError",
    "InputError",
    "LQRSensitivity",
    "LinearMPC",
    "MPCError",
    "MPQPStatus",
    "NotConvexError",
    "NotStabilisableError",
    "OffsetFreeMPC",
    "ParametricQP",
    "Plan",
    "PlanSensitivity",
    "SensitivityStatus",
    "Status",
    "lqr",
    "lqr_sensitivity",
    "solve_mpqp",
]
