"""Continuous dynamics over a sample with the input held."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import casadi as ca

from mpc.checks import as_array, as_count
from mpc.exceptions import InputError
from mpc.optimal_control.functions import Statement, wanted
from mpc.optimal_control.interval import runge_kutta


def sampled(dynamics: Statement, dt: float, *, parts: int = 4) -> Callable[..., Any]:
    """Step x⁺ = f(x, u, w, p) of dx/dt = dynamics(x, u, w, p).

    Parameters
    ----------
    dynamics : function or casadi.Function
        dx/dt; its arguments are named after what they get: x, u, w, p, t.
    dt : float
        Sample time [s, or the unit of time of the dynamics].
    parts : int
        Steps of the classical Runge–Kutta method of order 4 in a sample: twice as many make the error sixteen times
        smaller. Stiff dynamics need many; `ccdtools.discretise` chooses the number and the method by an accuracy.

    Returns
    -------
    function
        With the same arguments, for `NonlinearMPC(step=…)` or `Phase(dynamics=…, discrete=True)`.

    Raises
    ------
    InputError
        If the dynamics are no function of these names, or dt or the number of parts is not positive.

    Examples
    --------
    >>> law = NonlinearMPC(sampled(cart_pole, 0.02), 4, 1, Q=Q, R=R, horizon=30)  # doctest: +SKIP
    """
    names = wanted("dynamics", dynamics, ("x", "u", "w", "p", "t"))
    if "x" not in names:
        raise InputError("dynamics", f"a function of {', '.join(names) or 'nothing'}", "one of x at least")
    count = as_count("parts", parts)
    h = float(as_array("dt", dt, ())) / count
    if h <= 0.0:
        raise InputError("dt", dt, "a positive number")

    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    own = inspect.Signature([inspect.Parameter(name, kind) for name in names])

    def step(*columns: Any, **named: Any) -> Any:
        """Next state."""
        given = own.bind(*columns, **named).arguments

        def rate(z: Any, time: Any, _: Any) -> Any:
            """dx/dt at a state and a time."""
            value = dynamics(*((given | {"x": z, "t": time})[name] for name in names))
            return ca.vertcat(*value) if isinstance(value, list | tuple) else value

        x, t = given["x"], given.get("t", 0)
        for i in range(count):
            x = runge_kutta(rate, x, t + i * h, h, [None] * 3)
        return x

    step.__signature__ = own  # type: ignore[attr-defined]
    step.__wrapped__ = dynamics  # type: ignore[attr-defined]  # errors name the line of the user's function
    return step

