"""Objective of a co-design: step, end and design costs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.co_design.tolerances import PSD
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import as_symbolic
from ccdtools_ground.door import as_array, as_count, as_instance, as_weight, shown


class Weights(NamedTuple):
    """Quadratic step cost x'Qx + 2x'Su + u'Ru for LQR and MPC."""

    Q: Array
    R: Array
    S: Array | None = None

    def keywords(self) -> dict[str, Any]:
        """Q, R and any S by name."""
        return {name: value for name, value in self._asdict().items() if value is not None}


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Objective(Immutable):
    """Base of the objectives: additions to the cost of steps.

    The return of an episode is minus the cost of its steps and of its end, less the cost of the design.

    Parameters
    ----------
    design_cost : function of p, optional
        J_d(p): mass, price, in units of the return. It takes a CasADi column p (np) and returns a scalar expression,
        as ``lambda p: 3 * p[0] + p[1] ** 2`` or a `casadi.Function` does.
    episode : int, optional
        Number of steps that `design_cost` is set against; a run of twice as many costs twice as much for its design, so
        that the trade does not depend on how long a deployment is. Where it is None: the steps of a problem or study
        that the objective is given to, or of the run that it judges.
    """

    design_cost: Any = None
    episode: int | None = None

    def __post_init__(self) -> None:
        if self.design_cost is not None:
            self._set(design_cost=as_symbolic("design_cost", self.design_cost, ("p",)))
        if self.episode is not None:
            self._set(episode=as_count("episode", self.episode))

    @property
    def looks_back(self) -> bool:
        """Whether a reward depends on the previous state or the design."""
        return True

    def rewards(self, x_next: Any, u: Any, x: Any = None, p: Any = None) -> Any:
        """Rewards (...,) of a step, NumPy or torch.

        Parameters
        ----------
        x_next, u, x : (..., nx), (..., nu) and (..., nx)
            State after the step, input held over it, and state before it.
        p : (np,) or (..., np)
        """
        raise NotImplementedError

    def final_rewards(self, x: Any, p: Any) -> Any:
        """Rewards (...,) of final states (..., nx); None if nothing counts."""
        return None

    def jump(self, X: tuple[Array, Array], U: tuple[Array, Array], design: tuple[Array, Array]) -> str:
        """Where it jumps within bounds; empty if unknown."""
        return ""

    def weights(self, p: Array, nx: int, nu: int) -> Weights:
        """Quadratic step cost about rest at a design (np,)."""
        raise NotImplementedError

    def weight_derivatives(self, p: Array, nx: int, nu: int) -> Weights:
        """Derivatives (·, ·, np) of the weights, zeros by default."""
        return Weights(*(np.zeros((m, n, len(p))) for m, n in ((nx, nx), (nu, nu), (nx, nu))))

    def judges(self, nx: int, nu: int, designs: int) -> bool:
        """Whether a state, an input or the design changes it."""
        return True

    def check(self, nx: int, nu: int, designs: int) -> None:
        """Raise an `InputError` unless it fits a model of these sizes."""
        if self.design_cost is not None:
            self.design_cost.scalar(designs)

    def cost_of_design(self, p: Any, steps: int) -> Any:
        """J_d (...,) of designs (..., np) for a run of these steps; 0.0 without one."""
        if self.design_cost is None:
            return 0.0
        return self.design_cost.scalar(p.shape[-1])(p)[..., 0] * (steps / (self.episode or steps))

    def terms(self, run: Any) -> dict[str, float]:
        """Mean costs of a run's states, inputs, end and design.

        States cost what the same states would without inputs, and inputs the rest of the steps. Their sum is minus the
        mean return.

        Parameters
        ----------
        run : Trajectory
            Of runs that were not lost.
        """
        x, p = run.states, run.design
        applied = (0 * run.inputs, run.inputs)
        states, steps = (-self.rewards(x[:, 1:], u, x[:, :-1], p).sum(axis=1).mean() for u in applied)
        end = self.final_rewards(x[:, -1], p)
        return {
            "cost of states": float(states), "cost of inputs": float(steps - states),
            "cost of the end": 0.0 if end is None else float(-end.mean()),
            "cost of the design": float(self.cost_of_design(p, run.inputs.shape[1])),
        }  # fmt: skip

    def made_by_control(self, value: Any, p: Any, steps: int) -> Any:
        """Size (...,) of a return without its design cost.

        A large J_d is a part of every return, and nothing that a controller does would matter beside it.
        """
        return abs(value + self.cost_of_design(p, steps))

    def over(self, steps: int) -> Self:
        """Objective with `design_cost` per episode of `steps` steps.

        An objective that states its own episode keeps it.
        """
        return self if self.design_cost is None or self.episode is not None else replace(self, episode=steps)

    def describe(self) -> dict[str, Any]:
        """Plain values for tables and results."""
        return {} if self.design_cost is None else {"design cost": str(self.design_cost), "episode": self.episode}


@dataclass(frozen=True, eq=False, repr=False)
class QuadraticObjective(Objective):
    """Reward r = −x⁺ᵀ Q x⁺ − uᵀ R u − 2 xᵀ S u of next state x⁺, present x.

    A subclass may override `rewards`; it must then take NumPy arrays and torch tensors alike, and the weights remain
    those of the LQR and MPC that it is compared with.

    Parameters
    ----------
    Q : (nx, nx) array_like
        State weight, symmetric positive semidefinite.
    R : (nu, nu) array_like
        Input weight, symmetric positive semidefinite; singular where the states that an input moves are weighted.
    S : (nx, nu) array_like, optional
        Cross weight, such as the acceleration of a body gives; (Q S; Sᵀ R) must be positive semidefinite.
    design_cost, episode
        Keywords, see `Objective`.

    Raises
    ------
    InputError
        If a weight is not square, not symmetric, not finite or not definite as stated.
    """

    Q: ArrayField
    R: ArrayField
    S: ArrayField = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(Q=as_weight("Q", self.Q))
        self._set(R=as_weight("R", self.R))
        if self.S is not None:
            self._set(S=as_array("S", self.S, (len(self.Q), len(self.R))))
            whole = np.block([[self.Q, self.S], [self.S.T, self.R]])
            if not is_semidefinite(whole):
                got = "a cross weight that makes some steps cost less than nothing"
                raise InputError("S", got, "(Q S; Sᵀ R) positive semidefinite")

    def __repr__(self) -> str:
        weights = {"Q": self.Q, "R": self.R} | ({} if self.S is None else {"S": self.S})
        return f"{type(self).__name__}({', '.join(f'{name}={_weight_text(W)}' for name, W in weights.items())})"

    @property
    def looks_back(self) -> bool:
        """True with a cross weight, or rewards of a subclass."""
        return self.S is not None or type(self).rewards is not QuadraticObjective.rewards

    def rewards(self, x_next: Any, u: Any, x: Any = None, p: Any = None) -> Any:
        """Rewards (...,) of next x (..., nx), u (..., nu), and x (..., nx) with an S."""
        rewards = -((x_next @ _as_is(self.Q, x_next)) * x_next).sum(-1) - ((u @ _as_is(self.R, u)) * u).sum(-1)
        if self.S is None:
            return rewards
        if x is None:
            raise InputError("x", "nothing", "the states before the step, which a cross weight needs")
        return rewards - 2 * ((x @ _as_is(self.S, x)) * u).sum(-1)

    def weights(self, p: Array, nx: int, nu: int) -> Weights:
        """Q, R and S, equal at every design."""
        return Weights(self.Q, self.R, self.S)

    def judges(self, nx: int, nu: int, designs: int) -> bool:
        """True with a weight, a design cost, or a subclass's rewards."""
        own = type(self).rewards is not QuadraticObjective.rewards
        return own or self.design_cost is not None or bool(self.Q.any() or self.R.any())

    def check(self, nx: int, nu: int, designs: int) -> None:
        """Raise an `InputError` unless the weights fit states and inputs."""
        super().check(nx, nu, designs)
        for name, size, n in (("Q", len(self.Q), nx), ("R", len(self.R), nu)):
            if size != n:
                raise InputError(f"objective.{name}", f"shape ({size}, {size})", f"({n}, {n})")

    def describe(self) -> dict[str, Any]:
        """Weights."""
        own = {"Q": self.Q, "R": self.R} | ({} if self.S is None else {"S": self.S})
        return own | super().describe()


def as_objective(argument: str, value: Any) -> Objective:
    """`value`, if it is an objective.

    Raises
    ------
    InputError
        If it is none.
    """
    objective: Objective = as_instance(argument, value, Objective, "a QuadraticObjective or a CustomObjective")
    return objective


def is_semidefinite(H: Array) -> bool:
    """True if a symmetric matrix, scaled, is finite and positive semidefinite."""
    if not np.isfinite(H).all():
        return False
    size = np.sqrt(np.abs(np.diag(H)))
    size[size == 0] = 1.0
    return bool(np.linalg.eigvalsh(H / size / size[:, None])[0] >= -PSD * len(H))


def _as_is(weight: Array, like: Any) -> Any:
    """Weight as an array or tensor, like `like`."""
    return weight if isinstance(like, np.ndarray) else like.new_tensor(weight.tolist())


def _weight_text(W: Array) -> str:
    """Diagonal of a weight, or its entries where it has others."""
    square = W.shape[0] == W.shape[1] and not (W - np.diag(np.diag(W))).any()
    return shown(np.diag(W) if square else W)
