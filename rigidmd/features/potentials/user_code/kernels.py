"""User forces and thermostats that are compiled into the step loop."""

import inspect
from collections.abc import Callable
from functools import cache
from typing import TypeVar

import numpy as np

from rigidmd.compile import implements
from rigidmd.compile.kernels import compile_user_function
from rigidmd.core.state import State
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.thermostats import Tasks, apply_thermostat
from rigidmd.forces.terms import add_forces

#: The registered classes, and the function of each.
FORCES: dict[type, Callable[..., object]] = {}
THERMOSTATS: dict[type, Callable[..., object]] = {}


@cache
def with_checked_indices(function: Callable[..., object]) -> Callable[..., object]:
    """A registered function by itself, compiled such that an index beyond an array raises
    IndexError."""
    return compile_user_function(function, checks_indices=True)


Function = TypeVar("Function", bound=Callable[..., object])


def compiled_force(kind: type) -> Callable[[Function], Function]:
    """Make a NamedTuple class a force that is compiled into the step loop.

    The decorated function adds forces (lab frame, u Å/ps²) and torques (body frame, u Å²/ps²) to
    `load` and, unless `tally` is None, its energy (u Å²/ps², 100 of them are 1 kJ/mol) and
    molecular virial, sum of F (x) R in rows, to `tally`.

    The class may have the attribute `changes_momentum`, three booleans: whether the force may
    change each component of the total momentum (the default), so False for forces between
    molecules. `absolute_positions = True` means that the energy depends on positions in the lab,
    which excludes a barostat. The class may hold numbers, arrays and tuples of them. If its numbers
    come from the system, give `Simulation` an object with a method `term(system)` that makes it.

    Parameters
    ----------
    kind : type
        The NamedTuple class

    Returns
    -------
    callable
        A decorator of a function of (term, state, load, tally)

    Raises
    ------
    TypeError
        For another class, or a function with other arguments.

    Examples
    --------
        class Trap(NamedTuple):
            stiffness: float  # u/ps²

        @rigidmd.compiled_force(Trap)
        def trap(term, state, load, tally):
            for m in range(len(state.position)):
                for k in range(3):
                    load.force[m, k] -= term.stiffness * state.position[m, k]
                    if tally is not None:
                        tally[0] += 0.5 * term.stiffness * state.position[m, k] ** 2
    """
    _check_class(kind)

    def register(function: Function) -> Function:
        _check_arguments(function, ("term", "state", "load", "tally"))
        compiled = compile_user_function(function)
        FORCES[kind] = function
        implements(add_forces, kind)(
            lambda term, state, load, tally: compiled(term, state, load, tally)
        )
        return function

    return register


class ThermostatDefaults:
    """Attributes that the class of a user's thermostat may have, with the defaults."""

    halved = True

    def tasks(self, model: Model, state: State, workspace: np.ndarray) -> Tasks:
        return {}


def compiled_thermostat(kind: type) -> Callable[[Function], Function]:
    """Make a NamedTuple class a thermostat: a flow on the momenta.

    The decorated function has the arguments thermostat, model, state, h and draw. It changes
    `state.velocity` and `state.angular_momentum_body` over a time h (ps), and adds the change of
    the kinetic energy to `state.energy_ledger[0]`, so that energy less heat is conserved. With
    "baoab", the default in nvt and npt, it acts in the middle of each step. With other integrators
    half before and half after each step (`halved = False` in the class: all of it after the step).

    `model` is a `rigidmd.dynamics.model.Model`. Masses and moments are by species,
    `model.mass[model.species[m]]`. `draw` is an integer, the first of the random numbers of this
    call. `rigidmd.dynamics.noise` has `normals(thermostat.key, draw, m, state.step[0])`, two normal
    numbers for molecule m. Draw + 1, ... gives more. The key is a field of the class, from
    `key_of(seed, THERMOSTAT, stage)`. `changes_momentum = True` in the class means that it changes
    the total momentum.

    Parameters
    ----------
    kind : type
        The NamedTuple class

    Returns
    -------
    callable
        A decorator of a function of (thermostat, model, state, h, draw)

    Raises
    ------
    TypeError
        For another class, or a function with other arguments.

    Examples
    --------
        class Friction(NamedTuple):
            rate: float  # 1/ps

        @rigidmd.compiled_thermostat(Friction)
        def slow_down(thermostat, model, state, h, draw):
            factor = np.exp(-thermostat.rate * h)
            for m in range(len(state.velocity)):
                mass = model.mass[model.species[m]]
                for k in range(3):
                    before = 0.5 * mass * state.velocity[m, k] ** 2
                    state.velocity[m, k] *= factor
                    state.energy_ledger[0] += (factor**2 - 1.0) * before
    """
    _check_class(kind)
    for name in ("halved", "tasks"):
        if not hasattr(kind, name):
            setattr(kind, name, getattr(ThermostatDefaults, name))

    def register(function: Function) -> Function:
        _check_arguments(function, ("thermostat", "model", "state", "h", "draw"))
        compiled = compile_user_function(function)
        THERMOSTATS[kind] = function

        @implements(apply_thermostat, kind)
        def _apply(thermostat, model, code, state, workspace, h, draw):
            return compiled(thermostat, model, state, h, draw)

        return function

    return register


def _check_arguments(function: Callable, expected: tuple[str, ...]) -> None:
    arguments = list(inspect.signature(function).parameters)
    if len(arguments) != len(expected):
        raise TypeError(
            f"the function has the arguments ({', '.join(arguments)}), must have"
            f" ({', '.join(expected)})"
        )


def _check_class(kind: object) -> None:
    if not (isinstance(kind, type) and issubclass(kind, tuple) and getattr(kind, "_fields", ())):
        raise TypeError(f"{kind!r} is not a NamedTuple class with fields")
