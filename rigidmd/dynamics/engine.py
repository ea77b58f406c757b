"""The Python side of the compiled code: it gives kernels room when they ask for it and tells apart what they report."""

from typing import NamedTuple

import numpy as np

from rigidmd.dynamics.advance import Model, advance, new_progress
from rigidmd.dynamics.schemes import Scheme
from rigidmd.errors import SimulationError
from rigidmd.forces.pairs import forget_list, with_room
from rigidmd.forces.terms import LIST_FULL, NOT_FINITE, TALLY_SIZE, Load, NoForce, State, add_term


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
    """

    def __init__(self, model: Model, terms: dict[str, NamedTuple]):
        self.model = model
        self.names = list(terms)
        self._terms = tuple(terms.values()) or (NoForce(),)
        for term in self._terms:
            forget_list(term)  # a list left by another engine has its pairs in another order, and sums other last bits
        n = len(model.species)
        turning = n if model.inertia.any() else 0
        self.load = Load(np.zeros((n, 3)), np.zeros((turning, 3)))
        self._stale = True

    @property
    def terms(self) -> dict[str, NamedTuple]:
        """The terms by name, with the neighbour lists as they are now."""
        return dict(zip(self.names, self._terms, strict=False))

    def forget(self) -> None:
        """Say that positions were changed from outside since the last step."""
        self._stale = True

    def advance(self, state: State, scheme: Scheme, dt: float, steps: int, thermostat: NamedTuple) -> None:
        """Move the state by `steps` steps of dt (ps), in place. Raises SimulationError."""
        progress = new_progress()
        progress.cursor[2] = 0 if self._stale else 1
        kicks, drifts = np.array(scheme.kicks), np.array(scheme.drifts)
        while status := advance(
            self.model, state, self.load, self._terms, thermostat, kicks, drifts, dt, steps, progress
        ):
            self._answer(status, state)
        self._stale = False

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """Forces and torques at a state, fresh arrays, and each term's energy and virial. Raises SimulationError."""
        load = Load(np.zeros_like(self.load.force), np.zeros_like(self.load.torque_body))
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


class NotFiniteError(SimulationError):
    """Positions or momenta that are no numbers any more."""

    def __init__(self, state: State):
        rows = [np.abs(array).reshape(len(array), -1).max(axis=1, initial=0.0) for array in state if len(array)]
        size = np.max(np.where(np.isnan(rows), np.inf, rows), axis=0)
        self.molecule = int(size.argmax())
        super().__init__(f"molecule {self.molecule + 1} is nowhere: its position or momentum is no finite number")
