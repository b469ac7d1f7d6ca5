"""One step of a model without a disturbance as a CasADi function."""

from __future__ import annotations

from typing import Any

import casadi as ca

from ccdtools.plants.models import Model


def undisturbed_step(model: Model) -> ca.Function:
    """(x, u, p) → x⁺ where w is 0, arguments and value by name."""
    step = model.step
    kind: Any = ca.SX if step.is_a("SXFunction") else ca.MX
    names = ["x", "u", "p"]
    x, u, p = (kind.sym(name, step.size1_in(i)) for name, i in zip(names, (0, 1, 3)))
    return ca.Function("step", [x, u, p], [step(x, u, ca.DM.zeros(model.nw), p)], names, ["value"])
