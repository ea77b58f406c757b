"""The Python side of the compiled code: it gives kernels room when they ask for it and tells apart what they report."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rigidmd.dynamics.advance import Model, advance, new_progress
from rigidmd.dynamics.body import Body
from rigidmd.dynamics.gradient import Probe, probe_for
from rigidmd.dynamics.schemes import Scheme
from rigidmd.errors import SimulationError
from rigidmd.forces.fields import answer
from rigidmd.forces.terms import (
    ASK,
    LIST_FULL,
    NOT_FINITE,
    TALLY_SIZE,
    Load,
    NoForce,
    State,
    add_term,
    no_load,
    with_own_work,
    with_room,
)
from rigidmd.mechanics.rotor import NONE, ExactRotor, SplitRotor


class Tally(NamedTuple):
    """What one term contributes at one moment."""

    energy: float  # u Å²/ps²
    virial: np.ndarray  # (3, 3) molecular, sum F (x) R, u Å²/ps²


class Engine:
    """A model, its terms and the work arrays to move a state.

    Parameters
    ----------
    model : what never changes
    terms : name -> term, in the order in which forces are added
    applied : functions of (time, state) that terms of type `Told` stand for: name -> function
    """

    def __init__(
        self,
        model: Model | Body,
        terms: dict[str, NamedTuple],
        applied: dict[str, Callable[[float, State], tuple]] | None = None,
    ):
        self.model = model
        self.names = list(terms)
        # a list that another engine has left would have its pairs in another order, and sum other last bits
        self._terms = tuple(with_own_work(term) for term in terms.values()) or (NoForce(),)
        self._applied = applied or {}
        self.load: Load | None = None
        self._probe: Probe | None = None
        self._stale = True

    @property
    def terms(self) -> dict[str, NamedTuple]:
        """The terms by name, with the neighbour lists as they are now."""
        return dict(zip(self.names, self._terms, strict=False))

    def change(self, model: Model | Body, terms: dict[str, NamedTuple]) -> None:
        """Go on with others of the same types: what follows time as told enters its next piece."""
        self.model = model
        self._terms = tuple(terms.values()) or (NoForce(),)
        self.forget()

    def forget(self) -> None:
        """Say that positions were changed from outside since the last step."""
        self._stale = True

    def advance(
        self, state: State, scheme: Scheme, dt: float, steps: int, thermostat: NamedTuple, done: int = 0
    ) -> None:
        """Move the state by `steps` steps of dt, in place. Raises SimulationError.

        done : steps taken since an origin of time, `done` times dt ago; a run in parts keeps the very times of a whole.
        """
        if self.load is None:
            self.load = no_load(state)
        progress = new_progress(done, not self._stale)
        origin = float(state.time[0]) if done == 0 else self._origin
        self._origin = origin
        rows = (
            np.array(scheme.kicks),
            np.array(scheme.drifts),
            np.array([*np.cumsum((0.0, *scheme.drifts))[:-1], 1.0]),
            np.array(scheme.gradients) if scheme.gradients else None,
        )
        if scheme.gradients and self._probe is None:
            self._probe = probe_for(state)
        probe = self._probe if scheme.gradients else None
        model = self.model_for(scheme)
        if isinstance(model, Model):
            model = model.with_code()
        while status := advance(
            model, state, self.load, self._terms, thermostat, rows, probe, dt, origin, done + steps, progress
        ):
            self._answer(status, state)
        self._stale = self._stale and steps == 0

    def model_for(self, scheme: Scheme) -> Model | Body:
        """The model with the rotor that a scheme needs; only an asymmetric body turns differently by an exact one."""
        rotor = self.model.rotor
        if scheme.exact_rotor and isinstance(rotor, SplitRotor) and (rotor.symmetry == NONE).any():
            return self.model._replace(rotor=ExactRotor(*rotor))
        return self.model

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """Forces and torques at a state, fresh arrays, and each term's energy and virial. Raises SimulationError."""
        load = no_load(state)
        tallies = {}
        for k, name in enumerate(self.names):
            tally = np.zeros(TALLY_SIZE)
            while status := add_term(self._terms[k], state, load, tally):
                self._answer(status, state)
            tallies[name] = Tally(float(tally[0]), tally[1:].reshape(3, 3))
        return load, tallies

    def _answer(self, status: int, state: State) -> None:
        if status == LIST_FULL:
            self._terms = tuple(with_room(term) for term in self._terms)
        elif status == NOT_FINITE:
            raise NotFiniteError(state)
        elif status == ASK:
            for name, function in self._applied.items():
                answer(self.terms[name], function, state)


class NotFiniteError(SimulationError):
    """Positions or momenta that are no numbers any more, or positions that say nothing about forces."""

    def __init__(self, state: State):
        moving = [array for array in state[:4] if len(array)]
        rows = [np.abs(array).reshape(len(array), -1).max(axis=1, initial=0.0) for array in moving]
        size = np.max(np.where(np.isnan(rows), np.inf, rows), axis=0)
        if np.isfinite(size).all():
            self.molecule = int(rows[0].argmax())
            distance = rows[0][self.molecule]
            self.fault = f"it is {distance:.3g} Å from the origin, too far to tell in which image of the box"
        else:
            self.molecule = int(size.argmax())
            self.fault = "its position or momentum is no finite number"
        super().__init__(f"molecule {self.molecule + 1} is nowhere: {self.fault}")
