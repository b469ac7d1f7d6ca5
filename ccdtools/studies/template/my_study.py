"""A study of your own: change it and run it with ``ccdtools run my_study.py --quick``.

It is a cart on a spring and a damper, pushed by a force: the stiffness of the spring and the damper are the design.
"""

import casadi as ca

from ccdtools import DesignSpace, Plant, QuadraticObjective
from ccdtools.disturbances.disturbance import Gaussian
from ccdtools.studies import RealPlant, Study
from invariant_sets import Polytope


def cart(*, mass: float = 1.0, friction: float = 0.0) -> Plant:
    """The cart: x = [position, velocity], u, w = forces, p = [k, c]; `mass` in [kg], `friction` in [N]."""
    x = ca.SX.sym("x", 2)
    u = ca.SX.sym("u")
    w = ca.SX.sym("w")
    p = ca.SX.sym("p", 2)
    position = x[0]
    velocity = x[1]
    stiffness = p[0]
    damping = p[1]
    force = u + w - stiffness * position - damping * velocity - friction * ca.tanh(velocity / 0.01)
    return Plant(
        x,
        u,
        w,
        p,
        dynamics=ca.vertcat(velocity, force / mass),  # dx/dt; the nominal model is linear in x, u and w
        # What may be designed, between which bounds.
        design=DesignSpace(["k", "c"], lower=[0.5, 0.1], upper=[5.0, 2.0], units=["N/m", "N·s/m"]),
        dt=0.1,  # sampling time [s]
        state_names=["position [m]", "velocity [m/s]"],
        input_names=["force [N]"],
    )


study = Study(
    name="my_study",
    title="My study",
    plant=cart(),
    # Limits of the states and the inputs, around the origin, which is where the controller drives the state to.
    X=Polytope.from_bounds([-1.0, -2.0], [1.0, 2.0]),
    U=Polytope.from_bounds([-1.0], [1.0]),
    # The cost of a step is xᵀQx + uᵀRu; the return is minus its sum, and minus the price of the design: without one
    # the stiffest spring and the strongest damper are the best.
    objective=QuadraticObjective(Q=[[10.0, 0.0], [0.0, 1.0]], R=[[0.1]], design_cost=lambda p: 0.5 * p[0] + 0.4 * p[1]),
    # What the model assumes of the disturbance: its standard deviation [N].
    disturbance=Gaussian(std=[0.3]),
    x0=[0.5, 0.0],  # start of every evaluation, within X
    p0=[1.0, 0.2],  # first design
    steps=100,  # length of an evaluation
    # The plant as it really is. Leave this out (real=None) if the model is all you have.
    real=RealPlant(
        cart(friction=0.05),
        disturbance=Gaussian(std=[0.3]),
        x0=[0.5, 0.0],
        runs=100,  # logged in a deployment
        steps=100,
    ),
    samples=400,  # states and designs that the first policy is trained on
)
