"""From an optimal control problem and a mesh to a nonlinear program."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.optimal_control.assembly import Assembly
from mpc.optimal_control.interval import layout_of
from mpc.optimal_control.meshes import as_meshes
from mpc.optimal_control.phase import Phase
from mpc.optimal_control.phase_equations import PhaseToCome, phase_equations
from mpc.optimal_control.phase_unknowns import phase_unknowns
from mpc.optimal_control.pieces import Clock, itself, link_piece, mean_and_spread, parameter_piece
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, PhasePart
from mpc.optimal_control.schemes import Collocation, MultipleShooting, Radau, Scheme
from mpc.optimal_control.unknowns import first_duration


def build(problem: OptimalControlProblem | Phase, scheme: Scheme | None = None, intervals: Any = 20,
          meshes: Any = None) -> NonlinearProgram:  # fmt: skip
    """Transcribe a problem on a mesh.

    Parameters
    ----------
    problem : OptimalControlProblem or Phase
    scheme : Collocation or MultipleShooting
        `Radau(3)` by default. Discrete dynamics are taken as they are, whatever the scheme.
    intervals : int, or one a phase
        Equal ones.
    meshes : list of (N + 1,) arrays, optional
        Rising fractions of each phase from 0 to 1, instead.

    Raises
    ------
    InputError
        If a mesh does not rise from 0 to 1, or something is not finite at the guess: it says what, and when.
    """
    if isinstance(problem, Phase):
        problem = OptimalControlProblem(problem)
    if not isinstance(problem, OptimalControlProblem):
        raise InputError("problem", type(problem).__name__, "an OptimalControlProblem or a Phase")
    scheme = Radau(3) if scheme is None else scheme
    if not isinstance(scheme, Collocation | MultipleShooting):
        raise InputError(
            "scheme", type(scheme).__name__, "Radau(), Trapezoidal(), HermiteSimpson() or MultipleShooting()"
        )
    return _Builder(problem, scheme, as_meshes(problem, intervals, meshes)).program()


class _Builder:
    """Puts a program together, phase by phase."""

    def __init__(self, problem: OptimalControlProblem, scheme: Scheme, meshes: list[Array]) -> None:
        self.problem = problem
        self.scheme = scheme
        self.meshes = meshes
        self.into = Assembly()

    def program(self) -> NonlinearProgram:
        """The whole."""
        problem, into = self.problem, self.into
        first_parameters = np.asarray(problem.p_guess)
        layouts = [layout_of(phase, own.nw, self.scheme) for phase, own in zip(problem.phases, problem.functions)]
        firsts = []
        for phase, functions, layout, mesh in zip(problem.phases, problem.functions, layouts, self.meshes):
            firsts.append(into.width)
            into.unknown(*phase_unknowns(phase, functions, first_parameters, layout, mesh))
        durations = [self._duration(phase) for phase in problem.phases]
        parameters = slice(into.width, into.width + problem.parameters)
        self.p = np.arange(parameters.start, parameters.stop)
        low, high = problem.p_bounds
        into.unknown(low, high, first_parameters)
        count = len(problem.phases)
        costs = self._costs_of_scenarios()
        alone = costs.stop > costs.start
        targets = np.arange(1, count + 1) if alone else np.zeros(count, dtype=int)
        weights = np.ones(count) if alone else problem.weights
        parts: list[PhasePart] = []
        for k, (phase, functions) in enumerate(zip(problem.phases, problem.functions)):
            to_come = PhaseToCome(
                k, phase, functions, self.scheme, self.meshes[k], layouts[k], self._clock(k, durations), firsts[k],
                durations[k], self.p, int(targets[k]), float(weights[k]),
            )  # fmt: skip
            parts.append(phase_equations(into, to_come))
            if k and problem.linked:
                self._link(k, parts[-2], parts[-1])
        self._of_parameters()
        return into.program(problem, tuple(parts), parameters, costs)

    def _costs_of_scenarios(self) -> slice:
        """Append what the costs of scenarios are known by, where these are not summed: the largest, or each of them."""
        problem = self.problem
        count = len(problem.phases)
        first = self.into.width
        if problem.risk == "sum" or count == 1:
            return slice(first, first)
        many = count if problem.risk == "spread" else 1
        self.into.unknown(np.full(many, -np.inf), np.full(many, np.inf), np.zeros(many))
        named = [f"cost of scenario {k + 1}" for k in range(count)]
        self.into.rows("cost of a scenario", -1, named, 1, -np.inf, 0.0, 1.0, 0.0)
        places = np.broadcast_to(np.arange(first, first + many), (count,))
        self.into.piece(itself(), places[None], np.arange(1, count + 1)[None], -np.ones(1))
        objective = itself() if many == 1 else mean_and_spread(problem.weights, problem.spread)
        self.into.piece(objective, places[:many, None], np.zeros((1, 1), dtype=int), np.ones(1))
        return slice(first, first + many)

    def _duration(self, phase: Phase) -> int:
        """Append a duration that is free; its place, or −1."""
        if not phase.free_duration:
            return -1
        low, high = phase.duration
        guess = np.array([first_duration(phase)])  # its size, too: bounds of durations are often far away
        self.into.unknown(np.array([low]), np.array([high]), guess, guess)
        return self.into.width - 1

    def _clock(self, k: int, durations: list[int]) -> Clock:
        """When phase k is."""
        phases = self.problem.phases
        before = range(k) if self.problem.linked else range(0)
        start = phases[0 if self.problem.linked else k].start_time
        given = sum(phases[i].duration[0] for i in before if durations[i] < 0)
        free = [durations[i] for i in (*before, k) if durations[i] >= 0]
        return Clock(start + given, phases[k].duration[0], np.array(free, dtype=int), durations[k] >= 0)

    def _link(self, k: int, before: PhasePart, after: PhasePart) -> None:
        """Append that a phase begins where the one before it ends."""
        link = None if self.problem.link is None else self.problem.link_function(k - 1)
        end, begin = before.layout.nx, after.layout.nx
        size = self.into.scale[k][:begin]
        named = [f"link of {name}" for name in self.problem.phases[k].state_names]
        rows = self.into.rows("link", k, named, 1, 0.0, 0.0, size, 0.0)
        at = np.concatenate([before.last - before.layout.node + np.arange(end), after.first + np.arange(begin), self.p])
        function = link_piece(link, end, begin, self.problem.parameters)
        self.into.piece(function, at[:, None], 1 + np.arange(rows.start, rows.stop)[:, None], np.ones(begin))

    def _of_parameters(self) -> None:
        """Append cost and constraints of the parameters."""
        cost, constraints = self.problem.of_parameters
        count = 0 if constraints is None else constraints.numel_out(0)
        if cost is None and not count:
            return
        rows = self.into.rows("p_constraints", -1, self.problem.p_constraint_names, 1, -np.inf, 0.0, 1.0, 0.0)
        targets = np.concatenate([np.zeros(0 if cost is None else 1), 1 + np.arange(rows.start, rows.stop)]).astype(int)
        function = parameter_piece((cost, constraints), self.problem.parameters)
        self.into.piece(function, self.p[:, None], targets[:, None], np.ones(len(targets)))
