from mpc.exceptions import (
    InfeasibleError as InfeasibleError,
    InputError as InputError,
    MPCError as MPCError,
    NotConvexError as NotConvexError,
    NotStabilisableError as NotStabilisableError,
)
from mpc.explicit.explicit import ExplicitMPC as ExplicitMPC
from mpc.explicit.mpqp import solve_mpqp as solve_mpqp
from mpc.explicit.partition import MPQPStatus as MPQPStatus
from mpc.infeasibility import Explanation as Explanation
from mpc.linear_mpc import LinearMPC as LinearMPC
from mpc.parametric_qp import Constraint as Constraint, ParametricQP as ParametricQP
from mpc.plan import Plan as Plan, Status as Status
from mpc.riccati import lqr as lqr
from mpc.sensitivities.plan_sensitivity import (
    PlanSensitivity as PlanSensitivity,
    SensitivityStatus as SensitivityStatus,
)
from mpc.sensitivities.regulator import LQRSensitivity as LQRSensitivity, lqr_sensitivity as lqr_sensitivity
from mpc.tracking import OffsetFreeMPC as OffsetFreeMPC
