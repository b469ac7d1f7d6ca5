"""Objectives from any CasADi cost, or from a plant's outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, ArrayField
from ccdtools.co_design.objective import Objective, Weights, is_semidefinite
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import as_symbolic
from ccdtools.plants.jumps import Switches
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_instance, as_weight


@dataclass(frozen=True, eq=False, repr=False)
class CustomObjective(Objective):
    """CasADi cost: r = −ℓ(x, u, p) of the present step, −V_f(x_N, p) at the end.

    Weights that depend on the design, costs of outputs, economic costs and soft limits are of this kind. LQR and MPC
    take half the Hessian of ℓ about x = 0, u = 0 for their weights.

    Parameters
    ----------
    stage_cost : function of (x, u, p)
        ℓ. It takes CasADi columns and returns a scalar expression; a `casadi.Function` is one, too.
    terminal_cost : function of (x, p), optional
        V_f.
    Q, R : (nx, nx) and (nu, nu) array_like, optional
        Weights for LQR and MPC in the place of the Hessian of ℓ: where that is singular or indefinite, or says little.
    design_cost, episode
        Keywords, see `Objective`.

    Raises
    ------
    InputError
        If a cost is no function of such arguments, or returns no scalar expression of them. If LQR and MPC are to take
        the Hessian of ℓ, and it is not positive semidefinite at some design.
    """

    stage_cost: Any
    terminal_cost: Any = None
    Q: ArrayField = None
    R: ArrayField = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(stage_cost=as_symbolic("stage_cost", self.stage_cost, ("x", "u", "p")))
        if self.terminal_cost is not None:
            self._set(terminal_cost=as_symbolic("terminal_cost", self.terminal_cost, ("x", "p")))
        if (self.Q is None) != (self.R is None):
            raise InputError("Q, R", "one of them", "both weights, or neither")
        if self.Q is not None:
            self._set(Q=as_weight("Q", self.Q))
            self._set(R=as_weight("R", self.R))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.stage_cost})"

    def rewards(self, x_next: Any, u: Any, x: Any = None, p: Any = None) -> Any:
        """Rewards (...,) of x (..., nx), u (..., nu) and p (..., np)."""
        if x is None or p is None:
            raise InputError("x, p", "nothing", "the states before the step and the design, which the cost needs")
        return -self.stage_cost.scalar(x.shape[-1], u.shape[-1], p.shape[-1])(x, u, p)[..., 0]

    def jump(self, X: tuple[Array, Array], U: tuple[Array, Array], design: tuple[Array, Array]) -> str:
        """Where ℓ or V_f jumps within bounds, in words; empty where no jump was found."""
        x, u, p = (ca.SX.sym(name, len(low)) for name, (low, _) in zip("xup", (X, U, design)))
        costs = [self.stage_cost.function(len(X[0]), len(U[0]), len(design[0]))(x, u, p)]
        if self.terminal_cost is not None:
            costs.append(self.terminal_cost.function(len(X[0]), len(design[0]))(x, p))
        undisturbed = np.zeros(0), np.zeros(0)
        found = Switches(ca.Function("cost", [x, u, ca.SX(0, 1), p], [ca.vertcat(*costs)])).within(
            (X, U, undisturbed), design
        )  # fmt: skip
        if found is None:
            return ""
        place = ", ".join(f"{name} = {getattr(found, name).round(6).tolist()}" for name in "xu")
        name = ("stage", "terminal")[found.row]
        return f"the {name} cost jumps ({', '.join(found.names)}), such as at {place}: derivatives leave the jump out"

    def final_rewards(self, x: Any, p: Any) -> Any:
        """−V_f (...,) of states (..., nx), None without a terminal cost."""
        if self.terminal_cost is None:
            return None
        return -self.terminal_cost.scalar(x.shape[-1], p.shape[-1])(x, p)[..., 0]

    def weights(self, p: Array, nx: int, nu: int) -> Weights:
        """Given weights, or half the Hessian of ℓ at rest, at a design (np,)."""
        if self.Q is not None:
            return Weights(self.Q, self.R)
        H = np.asarray(self.stage_cost.hessian(nx, nu, len(p))(p), dtype=float) / 2
        if not is_semidefinite(H):
            got = f"one whose Hessian about x = 0, u = 0 is not positive semidefinite at the design {p.tolist()}"
            cure = "Give the weights Q and R of the LQR and MPC that the cost is compared with."
            raise InputError("objective.stage_cost", got, "a cost that grows away from rest", cure)
        H = (H + H.T) / 2
        S = H[:nx, nx:]
        return Weights(H[:nx, :nx], H[nx:, nx:], S if S.any() else None)

    def weight_derivatives(self, p: Array, nx: int, nu: int) -> Weights:
        """Derivatives (·, ·, np) of the given weights or half the Hessian."""
        if self.Q is not None:
            return super().weight_derivatives(p, nx, nu)
        symbol = ca.SX.sym("p", len(p))
        hessian = self.stage_cost.hessian(nx, nu, len(p))(symbol)
        slopes = ca.Function("slopes", [symbol], [ca.densify(ca.jacobian(ca.vec(hessian), symbol))])(p)
        T = np.asarray(slopes, dtype=float).reshape((nx + nu, nx + nu, len(p)), order="F") / 2
        T = (T + T.transpose(1, 0, 2)) / 2
        return Weights(T[:nx, :nx], T[nx:, nx:], T[:nx, nx:])

    def judges(self, nx: int, nu: int, designs: int) -> bool:
        """True if a cost depends on anything, or the design has one."""
        if self.design_cost is not None or self.stage_cost.depends(nx, nu, designs):
            return True
        return self.terminal_cost is not None and bool(self.terminal_cost.depends(nx, designs))

    def check(self, nx: int, nu: int, designs: int) -> None:
        """Raise an `InputError` unless it fits these states, inputs and designs."""
        super().check(nx, nu, designs)
        self.stage_cost.scalar(nx, nu, designs)
        if self.terminal_cost is not None:
            self.terminal_cost.scalar(nx, designs)
        for name, weight, n in (("Q", self.Q, nx), ("R", self.R, nu)):
            if weight is not None and len(weight) != n:
                raise InputError(f"objective.{name}", f"shape ({len(weight)}, {len(weight)})", f"({n}, {n})")

    def describe(self) -> dict[str, Any]:
        """Costs as text."""
        own: dict[str, Any] = {"stage cost": str(self.stage_cost)}
        if self.terminal_cost is not None:
            own["terminal cost"] = str(self.terminal_cost)
        return own | super().describe()


def output_objective(plant: Plant, *, weights: Any, R: Any = 0.0, **others: Any) -> CustomObjective:
    """Cost yᵀ W y + uᵀ R u of outputs y = h(x, u, p).

    Outputs may be body acceleration, tyre load or the force in a joint.

    Parameters
    ----------
    plant : Plant
        With outputs.
    weights : (ny,) or (ny, ny) array_like
        W, or its diagonal.
    R : number, (nu,) or (nu, nu) array_like
        Input weight beside it; none by default.
    **others
        `terminal_cost`, `design_cost`, and what else `CustomObjective` takes.

    Raises
    ------
    InputError
        If the plant has no outputs, or a weight has the wrong size or is not positive semidefinite.
    """
    as_instance("plant", plant, Plant, "a ccdtools.Plant")
    if plant.ny == 0:
        raise InputError("plant", "one without outputs", "Plant(…, outputs=[…])")
    W = as_weight("weights", weights, plant.ny)
    given = as_weight("R", R, plant.nu)
    observe = plant.output

    def stage_cost(x: Any, u: Any, p: Any) -> Any:
        """Cost of a step, of CasADi columns."""
        y = observe(x, u, p)
        return y.T @ W @ y + u.T @ given @ u

    return CustomObjective(stage_cost, **others)
