"""Plants of which only a step is known, such as simulators."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable, frozen
from ccdtools.exceptions import CCDError, InputError
from ccdtools.plants.design_space import NO_DESIGN, DesignSpace
from ccdtools_ground.content import content_of
from ccdtools_ground.door import as_count, as_flag, as_floats, as_instance, as_positive, as_vector, shown
from ccdtools_ground.own_process import OwnProcess
from ccdtools_ground.user_functions import stopped


@dataclass(frozen=True, eq=False, repr=False)
class BlackBox(Immutable):
    """Plant x⁺ = advance(x, u, w, p) of which nothing else is known.

    It is simulated, deployed on and compared as any plant. In a `CoDesignProblem` its derivatives and matrices (of LQR,
    linear MPC, sets, the gradient through the model) are differences; what needs expressions takes a model beside it.

    Parameters
    ----------
    advance : callable
        (x (nx,), u (nu,), w (nw,), p (np,)) → x⁺ (nx,), one sample later. It holds no memory: the next call may go on
        from another state.
    nx, nu, nw : int
        Sizes of state, input and disturbance.
    dt : float
        Sampling time [s].
    design : DesignSpace
        None by default.
    batched : bool
        Whether `advance` takes the rows of all runs at once, x (n, nx), u (n, nu) and w (n, nw), and returns (n, nx).
    step_limit : float, optional
        Longest time of a call [s]. `advance` then runs in a process of its own, which may hang or die; a call costs
        about 0.1 ms more. Loading a simulator counts as its first call.
    input_bounds : (lower, upper), two numbers or two (nu,)
        Inputs that it takes, in which the U of a problem lies; any by default.

    Raises
    ------
    InputError
        If a size is none, or `advance` stops with an error or returns another shape. A state that is not finite is a
        run that diverged.
    SimulatorError
        If it does so in a simulation, or a call takes longer than `step_limit` or ends its process. What was simulated
        before is `kept` in it.
        `Search(of=function)` leaves such a design out.

    Examples
    --------
    >>> plant = BlackBox(lambda x, u, w, p: x + 0.1 * u, nx=1, nu=1, dt=0.1)
    >>> run = simulate(plant, LinearFeedback([[1.0]]), x0=[1.0], steps=20)
    """

    advance: Callable[[Array, Array, Array, Array], ArrayLike]
    nx: int
    nu: int
    dt: float
    nw: int = 0
    design: DesignSpace = NO_DESIGN
    batched: bool = False
    step_limit: float | None = None
    input_bounds: ArrayField = (-np.inf, np.inf)

    def __post_init__(self) -> None:
        if not callable(self.advance):
            raise InputError("advance", shown(self.advance), "a function (x, u, w, p) -> x⁺")
        for name, least in (("nx", 1), ("nu", 1), ("nw", 0)):
            self._set(**{name: as_count(name, getattr(self, name), least=least)})
        self._set(dt=as_positive("dt", self.dt, unit="s"))
        as_instance("design", self.design, DesignSpace, "a DesignSpace")
        as_flag("batched", self.batched)
        if self.step_limit is not None:
            self._set(step_limit=as_positive("step_limit", self.step_limit, unit="s"))
        bounds = as_floats("input_bounds", self.input_bounds)
        if bounds.shape not in ((2,), (2, self.nu)) or not (bounds[0] <= bounds[1]).all():
            expected = f"(lower, upper), two numbers or two ({self.nu},), lower <= upper"
            raise InputError("input_bounds", shown(self.input_bounds), expected)
        self._set(input_bounds=frozen(bounds))

    def __repr__(self) -> str:
        sizes = f"{self.nx} states, {self.nu} inputs, {self.nw} disturbances"
        return f"BlackBox({sizes}, dt = {self.dt:g} s, design: {self.design!r})"

    def stepper(self, p: Array, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """Step function (x (n, nx), u (n, nu), w (n, nw)) → x⁺."""

        def step(x: Array, u: Array, w: Array) -> Array:
            """States (n, nx) one sample later."""
            if self.batched:
                return self._after(x, u, w, p)
            return np.stack([self._after(*row, p) for row in zip(x, u, w)])

        return step

    def step(self, x: ArrayLike, u: ArrayLike, w: ArrayLike, p: ArrayLike) -> Array:
        """State (nx,) one sample later."""
        given = (np.atleast_2d(np.asarray(value, dtype=float)) for value in (x, u, w))
        found: Array = self.stepper(np.asarray(p, dtype=float), batch=1)(*given)[0]
        return found

    @cached_property
    def _after(self) -> Callable[[Array, Array, Array, Array], Array]:
        """What `advance` returns, checked; from its own process where there is a limit."""
        if self.step_limit is None:
            return partial(_advanced, self)
        return OwnProcess(partial(_advanced, replace(self, step_limit=None)), self.step_limit)


def _advanced(box: BlackBox, x: Array, u: Array, w: Array, p: Array) -> Array:
    """What `advance` returns, checked."""
    try:
        found = as_floats("advance", box.advance(x.copy(), u.copy(), w.copy(), p.copy()))
    except CCDError:
        raise
    except Exception as error:
        at = f" at x = {shown(x)}, u = {shown(u)}"
        cure = "With batched=True it gets rows (n, ·) of all runs, else one run (·,)."
        raise stopped("advance", box.advance, error, f"x⁺ {x.shape}", cure, at=at) from error
    if found.shape != x.shape:
        raise InputError("advance", f"a state of shape {found.shape}", f"{x.shape}")
    return found


def from_gymnasium(
    env: Any,
    *,
    read: Any = None,
    write: Any = None,
    dt: float | None = None,
    design: DesignSpace = NO_DESIGN,
    build: Callable[[Any, Array], None] | None = None,
    step_limit: float | None = None,
) -> BlackBox:
    """Plant that steps an environment of Gymnasium from any state.

    Parameters
    ----------
    env : gymnasium.Env
        With a box of actions (nu,), in which the U of a problem lies; its time limit and its rewards are not looked
        at. It must be deterministic. The folder of an experiment knows it by what it held when it was given here.
    read : function of the unwrapped environment → x (nx,), optional
        State at which it stands; by default its `state`.
    write : function of the unwrapped environment and x (nx,), optional
        Puts it into a state; by default sets its `state`.
    dt : float, optional
        Time of a step [s]; by default `dt` of the unwrapped environment, or 1 where it has none: time counts steps.
    design : DesignSpace
        Its parameters, if any are to be designed; `build` is then required.
    build : function of the unwrapped environment and p (np,), optional
        Gives it a design.
    step_limit : float, optional
        Longest time of a step [s], see `BlackBox`; a copy of the environment then runs in a process of its own.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, the environment has no `state` and `read` or `write` is missing, or a state
        that is written is not the one that is read.

    Examples
    --------
    >>> plant = from_gymnasium(gymnasium.make("Pendulum-v1"))
    """
    inner = _begun(env)
    if hasattr(inner, "state"):
        read = _state if read is None else read
        write = _set_state if write is None else write
    tasks = {"read": "env → x, where it stands", "write": "(env, x), which puts it there", "build": "(env, p)"}
    for (name, task), given in zip(tasks.items(), (read, write, build)):
        if not callable(given) and (name != "build" or given is not None):
            got = f"{shown(given)}, of an environment without a `state`" if given is None else shown(given)
            raise InputError(name, got, f"a function {task}", CURES[name])
    as_instance("design", design, DesignSpace, "a DesignSpace")
    if design.dim and build is None:
        raise InputError("build", "none", "a function (env, p) that gives the environment a design")
    dt = as_positive("dt", getattr(inner, "dt", 1.0) if dt is None else dt, unit="s")

    if build is not None:
        try:
            build(inner, design.project(design.centre))
        except Exception as error:
            raise stopped("build", build, error, "a function (env, p) that gives the environment a design") from error
    told = content_of((inner, read, write, build))  # what it holds before its first step
    advance = _EnvironmentStep(env, read, write, build, told)
    x, u = as_vector("read", _read(read, inner)), np.asarray(env.action_space.sample(), dtype=float)
    taken = env.action_space.low, env.action_space.high
    box = BlackBox(advance, len(x), len(u), dt, design=design, step_limit=step_limit, input_bounds=taken)
    first, again = (box.step(x, u, np.zeros(0), design.project(design.centre)) for _ in range(2))
    if not np.array_equal(first, again, equal_nan=True):
        got = f"{shown(first)} and {shown(again)} after one step from one state"
        raise InputError("env, write", got, "the same state: a deterministic step, and a write that takes effect")
    write(inner, x.copy())
    if not np.array_equal(x, back := _read(read, inner)):
        raise InputError("write", f"a state {shown(back)} where {shown(x)} was written", "the same state, (nx,)")
    _tell_idle(box, x, env.action_space)
    return box


@dataclass(frozen=True, eq=False)
class _EnvironmentStep:
    """Step of an environment from any state, known by the content of what was given."""

    env: Any
    read: Callable[[Any], ArrayLike]
    write: Callable[[Any, Array], None]
    build: Callable[[Any, Array], None] | None
    told: str

    def __call__(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """State after a step of the environment."""
        inner = self.env.unwrapped
        if self.build is not None:
            self.build(inner, p)
        self.write(inner, x)
        try:
            inner.step(u.astype(self.env.action_space.dtype))
        except Exception as error:
            raise stopped("env", inner.step, error, "a step", at=f" at x = {shown(x)}, u = {shown(u)}") from error
        return _read(self.read, inner)

    def as_given(self) -> tuple[str]:
        """Content of the environment before its first step."""
        return (self.told,)


def _tell_idle(box: BlackBox, x: Array, actions: Any) -> None:
    """Warn of free design entries that change nothing.

    The way from a state is long enough for a chain of nx states.
    """
    space = box.design
    inputs = np.array([actions.sample() for _ in range(box.nx + 1)], dtype=float)

    def run(k: int, bound: Array) -> Array:
        """States with one entry at a bound and the others in the middle."""
        p, states = space.centre.copy(), [x]
        p[k] = bound[k]
        for u in inputs:
            states.append(box.step(states[-1], u, np.zeros(0), space.project(p)))
        return np.stack(states)

    def acts(k: int) -> bool:
        """Whether an entry changes a state, as far as the environment answers."""
        try:
            return not np.array_equal(run(k, space.lower), run(k, space.upper))
        except CCDError:
            return True

    for k in np.flatnonzero(space.free).tolist():
        if not acts(k):
            said = f"{space.names[k]} changes no state in {len(inputs)} steps: does the environment read what it sets?"
            warnings.warn(f"build: {said}", UserWarning, stacklevel=3)


CURES = {
    "read": "Such as read=lambda env: np.r_[env.data.qpos, env.data.qvel], of MuJoCo.",
    "write": "Such as write=lambda env, x: env.set_state(x[:n], x[n:]), of MuJoCo. Without a state there is no plant.",
    "build": "Such as build=lambda env, p: setattr(env, 'm', p[0]).",
}


def _begun(env: Any) -> Any:
    """Unwrapped environment after a reset, if it has a box of actions."""
    actions = getattr(env, "action_space", None)
    box = hasattr(env, "unwrapped") and hasattr(actions, "low") and len(actions.shape) == 1  # type: ignore[union-attr]
    kind = getattr(getattr(actions, "dtype", None), "kind", "f")
    if not box or isinstance(env, type) or kind != "f":
        got = shown(env) if actions is None or isinstance(env, type) else f"an environment with the actions {actions}"
        raise InputError("env", got, "a Gymnasium environment with a box of float actions, such as by gymnasium.make")
    if env.unwrapped.action_space != actions:
        got = f"a wrapper that makes the actions {actions} of {env.unwrapped.action_space}"
        raise InputError("env", got, "an environment as it is", "Pass env.unwrapped, whose actions are the inputs.")
    try:
        env.reset(seed=0)
        actions.seed(0)  # so that the same plant is the same in the next process, too
    except Exception as error:
        raise stopped("env", env.reset, error, "a reset") from error
    return env.unwrapped


def _state(env: Any) -> Any:
    """State of the environments of classic control."""
    return env.state


def _set_state(env: Any, x: Array) -> None:
    """Put an environment of classic control into a state."""
    env.state = x


def _read(read: Callable[[Any], ArrayLike], env: Any) -> Array:
    """State (nx,) that a user's function reads."""
    try:
        found = read(env)
    except Exception as error:
        raise stopped("read", read, error, "the state at which the environment stands") from error
    return np.atleast_1d(as_floats("read", found))
