"""Solution of an optimal control problem, and its status."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.outcome import Outcome
from mpc.checks import Array, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.descriptions import of_phase
from mpc.optimal_control.mesh_errors import Excess, Missed, mesh_errors, path_excess
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.program import NonlinearProgram
from mpc.optimal_control.solution_sensitivity import SolutionSensitivity, solution_sensitivity
from mpc.plan import Residuals
from mpc.tolerances import COARSE_MESH, COST_ERROR, COST_ROUNDING, LIMIT_PASSED


class OptimalControlStatus(Outcome):
    """Outcome of a solve; the value is the advice."""

    SOLVED = (
        "Solved: the optimality conditions hold to the tolerance, checked apart from the solver, limits are kept "
        "between the points, too, and the mesh is fine enough for the dynamics and the cost."
    )
    LIMITS_PASSED = (
        "An optimum on its mesh, but between the points a limit is passed. `refine` cuts intervals there; else take "
        "more of them, or keep a margin; where the trajectory jumps over an obstacle, give a guess that goes round it."
    )
    COARSE = (
        "An optimum on its mesh, but the mesh is too coarse for what is asked. Call `refine`, or take more intervals "
        "or a higher degree."
    )
    INFEASIBLE = (
        "No feasible trajectory was found: not by the solver, nor by making violations least from several starts. "
        "Relax what `conflicts` names, or give a guess nearer to feasible."
    )
    UNBOUNDED = "The cost falls without end. Bound states, inputs, parameters or the duration, or price them."
    UNDEFINED = (
        "Functions or their derivatives are not finite where the solver went, see `conflicts`. "
        "Bound the states away from there, or give a guess away from it."
    )
    STOPPED = "Stopped early: the best that was found is returned. Raise the limit, or start from this solution."
    INACCURATE = (
        "The solver ended, but the optimality conditions do not hold to the tolerance. Rescale, or refine the mesh."
    )


@dataclass(frozen=True)
class Ends:
    """Starts that ended alike.

    Attributes
    ----------
    status : OptimalControlStatus
    cost : float
        NaN without an optimum.
    count : int
    """

    status: OptimalControlStatus
    cost: float
    count: int

    def __str__(self) -> str:
        at = f" at {self.cost:.6g}" if np.isfinite(self.cost) else ""
        return f"{self.count} {self.status.name}{at}"


ON_MESH = (OptimalControlStatus.SOLVED, OptimalControlStatus.LIMITS_PASSED, OptimalControlStatus.COARSE)


def alike(first: float, second: float) -> bool:
    """Whether costs differ by no more than a mesh may make them, or neither is known."""
    return not abs(first - second) > COST_ERROR * abs(second)


def merged(ends: list[Ends]) -> tuple[Ends, ...]:
    """Ends of one status and cost as one, in the order of statuses, then of costs."""
    found: list[Ends] = []
    for one in sorted(ends, key=lambda one: (list(OptimalControlStatus).index(one.status), one.cost)):
        if found and found[-1].status is one.status and alike(one.cost, found[-1].cost):
            found[-1] = replace(found[-1], count=found[-1].count + one.count)
        else:
            found.append(one)
    return tuple(found)


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of an optimal control problem on a mesh.

    Attributes
    ----------
    cost : float
    cost_size : float
        That of the guess, without sign: what a cost that vanishes at the optimum is small beside.
    p : (np,) array
        The shared parameters.
    phases : tuple of PhaseSolution
    status : OptimalControlStatus
    residuals : Residuals
        Optimality residuals, computed from the program alone in scaled unknowns.
    conflicts : tuple of str
        The constraints that are violated most, where some are; if INFEASIBLE, also what contradicts them.
    notes : tuple of str
        What the problem's statement may have to do with the outcome: functions that jump, a duration at its bound.
    multipliers : dict of str to array
        Of "rows" (m,) and "bounds" (n,) of the program; positive at upper bounds.
    iterations : int
    solve_time : float
        [s].
    solver : str
    message : str
        What the solver said.
    ends : tuple of Ends
        How many of several `starts` ended where, the best first; empty after one.
    """

    program: NonlinearProgram
    unknowns: Array
    cost: float
    cost_size: float
    p: Array
    phases: tuple[PhaseSolution, ...]
    status: OptimalControlStatus
    residuals: Residuals
    conflicts: tuple[str, ...]
    notes: tuple[str, ...]
    multipliers: dict[str, Array]
    iterations: int
    solve_time: float
    solver: str
    message: str
    ends: tuple[Ends, ...] = ()

    def __repr__(self) -> str:
        return (
            f"Solution(cost={self.cost:.8g} ± {self.cost_error:.1g}, status={self.status.name}, "
            f"kkt={self.residuals.worst:.1e}, mesh error {self.mesh_error:.1e}, excess {self.excess:.1e}, "
            f"{self.iterations} iterations, {1e3 * self.solve_time:.1f} ms, {self.solver})"
        )

    @property
    def solved(self) -> bool:
        """Whether it is an optimum, also between the points."""
        return self.status is OptimalControlStatus.SOLVED

    @property
    def solved_on_mesh(self) -> bool:
        """Whether it is an optimum on its mesh."""
        return self.status in ON_MESH

    @property
    def advice(self) -> str:
        """Advice on the outcome, with notes, what is missed, and what was tried."""
        said = [self.status.advice, *self.notes, *(self._missed() if self.solved_on_mesh else ())]
        if self.ends:
            count, ended = sum(one.count for one in self.ends), ", ".join(map(str, self.ends))
            said.append(f"Of {count} starts ended: {ended}. Another optimum may lie elsewhere.")
        return " ".join(said)

    @property
    def rank(self) -> tuple[int, float]:
        """Rank among solutions of one problem: by status, then by cost."""
        return list(OptimalControlStatus).index(self.status), self.cost

    @cached_property
    def path_excess(self) -> tuple[Excess, ...]:
        """Violations of limits between mesh points; see `Excess`."""
        return tuple(path_excess(self.program, phase) for phase in self.phases)

    @property
    def excess(self) -> float:
        """Largest relative violation of a limit between the points."""
        return max(float(excess.relative.max(initial=0.0)) for excess in self.path_excess)

    @cached_property
    def missed(self) -> tuple[Missed, ...]:
        """Errors between mesh points; see `mesh_errors`."""
        return tuple(mesh_errors(self.program, phase, self.multipliers, self.residuals) for phase in self.phases)

    @property
    def errors(self) -> tuple[Array, ...]:
        """Relative errors of the dynamics between points, (N,) a phase."""
        return tuple(one.dynamics for one in self.missed)

    @property
    def mesh_error(self) -> float:
        """Largest of `errors`."""
        return max(float(error.max(initial=0.0)) for error in self.errors)

    @property
    def cost_error(self) -> float:
        """Estimated error of the cost by the mesh."""
        return float(sum(np.maximum(one.cost, one.saved).sum() for one in self.missed))

    def looked_between(self) -> Solution:
        """Solution with its status revised between the points."""
        status = OptimalControlStatus.SOLVED
        if not self.excess <= LIMIT_PASSED:
            status = OptimalControlStatus.LIMITS_PASSED
        elif not (self.mesh_error <= COARSE_MESH and self.cost_error <= self.cost_tolerance):
            status = OptimalControlStatus.COARSE
        return replace(self, status=status) if self.solved_on_mesh else self

    @property
    def cost_tolerance(self) -> float:
        """Estimated error of the cost that SOLVED accepts."""
        size = max(self.cost_size, self.program.cost_scale)
        return max(COST_ERROR * abs(self.cost), COST_ROUNDING * size)

    def _missed(self) -> list[str]:
        """Limits exceeded and errors made between the points, in words."""
        said = [
            f"Between the points of the mesh {name}{of_phase(self.program, k)} is exceeded by {value:.3g} at "
            f"t = {time:.6g}: cut the intervals there, or keep a margin."
            for k, excess in enumerate(self.path_excess)
            for name, value, time, relative in zip(excess.names, excess.value, excess.time, excess.relative)
            if not relative <= LIMIT_PASSED
        ]
        if self.mesh_error > COARSE_MESH:
            said.append(f"The dynamics are missed by {self.mesh_error:.1e} of the extent of a state.")
        if not self.cost_error <= self.cost_tolerance:
            said.append(f"The cost may be off by about {self.cost_error:.2g}.")
            saved = sum(one.saved.sum() for one in self.missed)
            if saved > self.cost_tolerance:
                said.append(f"By the Hamiltonian inputs at bounds would save {saved:.2g}: try another guess, too.")
        return said

    @property
    def times(self) -> Array:
        """Mesh of the first phase [s]."""
        return self.phases[0].times

    @property
    def duration(self) -> float:
        """Duration of all phases, or of the longest scenario [s]."""
        if not self.program.problem.linked:
            return max(phase.duration for phase in self.phases)
        return float(self.phases[-1].times[-1] - self.phases[0].times[0])

    @property
    def p_gradient(self) -> Array:
        """Derivatives (np,) of the optimal cost by held or bounded parameters; else 0."""
        return -self.multipliers["bounds"][self.program.parameters]

    def sensitivity(self) -> SolutionSensitivity:
        """Derivatives of optimal cost and trajectory by parameters and start.

        The conditions of an optimum of the program, on its mesh, are differentiated at the active constraints. Solve
        to a small tolerance for derivatives of as many digits: `solve(…, tolerance=1e-10)`.

        Returns
        -------
        SolutionSensitivity
            ∂J*/∂p, ∂²J*/∂p², ∂u/∂p, ∂x/∂p, the same by the start, and a status: weakly active constraints are named.

        References
        ----------
        Fiacco, *Introduction to Sensitivity and Stability Analysis in Nonlinear Programming*, 1983; Pirnay,
        López-Negrete and Biegler, "Optimal sensitivity based on IPOPT", Mathematical Programming Computation 4, 2012.
        """
        return solution_sensitivity(self.program, self.unknowns, self.multipliers, self.solved_on_mesh)

    def x(self, t: ArrayLike) -> Array:
        """States (..., nx) at times (...), of their phase."""
        return self._of_phases("x", t)

    def u(self, t: ArrayLike) -> Array:
        """Inputs (..., nu) at times (...), of their phase."""
        return self._of_phases("u", t)

    def z(self, t: ArrayLike) -> Array:
        """Algebraic variables (..., nz) at times (...), of their phase."""
        if not any(phase.part.phase.algebraics for phase in self.phases):
            cure = "By shooting and in discrete phases z is an expression of x and u: evaluate your equations there."
            raise InputError("z", "a solution without unknown z", "one of algebraic equations by collocation", cure)
        return self._of_phases("z", t)

    def costate(self, t: ArrayLike) -> Array:
        """Costates (..., nx) at times (...), of their phase."""
        return self._of_phases("costate", t)

    def plot(self, *, costates: bool = False, mesh: bool = True, figure: Any = None) -> Any:
        """Draw states, inputs and mesh, phases side by side.

        Parameters
        ----------
        costates : bool
            Whether they are drawn too.
        mesh : bool
            Whether the points of the mesh are marked.
        figure : matplotlib Figure, optional
            Where to draw; a new one by default.

        Returns
        -------
        matplotlib Figure
        """
        from mpc.optimal_control.plotting import plot_phases

        title = f"cost {self.cost:.6g}, {self.status.name}"
        return plot_phases(self.phases, costates=costates, mesh=mesh, title=title, figure=figure)

    def _of_phases(self, name: str, t: ArrayLike) -> Array:
        """Values of phases at times."""
        if len(self.phases) == 1:
            return np.asarray(getattr(self.phases[0], name)(t))
        cure = f"Ask one of `phases`: solution.phases[0].{name}(t)."
        if not self.program.problem.linked:
            raise InputError(name, "scenarios, which run side by side", "phases that follow one another", cure)
        sizes = {getattr(phase, name)(phase.times[0]).size for phase in self.phases}
        if len(sizes) > 1:
            raise InputError(name, f"phases with {sorted(sizes)} of them", "phases with the same number", cure)
        given = as_floats("t", t)
        ends = np.array([phase.times[-1] for phase in self.phases[:-1]])
        which = np.searchsorted(ends, given.ravel(), side="right")
        values = [getattr(self.phases[k], name)(one) for k, one in zip(which, given.ravel())]
        return np.asarray(values).reshape(*given.shape, *sizes)
