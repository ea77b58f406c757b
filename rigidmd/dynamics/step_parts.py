"""What the rows of a step read and write, and rows that a thermostat adds to a step."""

from typing import Generic, NamedTuple, Protocol, TypeVar, cast

import numpy as np

from rigidmd.compile import Code, Pass, Rows
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import Load, State
from rigidmd.dynamics.force_gradient import GradientWorkspace
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.registers import Registers, Timing
from rigidmd.forces.terms import TermTable

#: Bits of `Pass.when`: every step; the last step of a call, or before rows that act between two
#: steps; the first step of a call, or after a LAST one; every other step; steps without energies
#: and with them; the last step before an observation. INTERVAL and higher bits: the steps of an
#: interval.
EVERY, LAST, FIRST, REPEATED, PLAIN, ENERGIES, WATCHED, INTERVAL = (1 << n for n in range(8))


class StepCore(NamedTuple):
    """What all rows of a step of molecules read and write. A step that is only printed has no terms
    and no recovery."""

    model: Model
    state: State
    load: Load
    registers: Registers
    status: np.ndarray  # (1,) int64, into which rows write status codes
    terms: TermTable | None  # bound to the state and the load
    recovery: Rows | None = None  # rows after forces that failed


class StepParts(NamedTuple):
    """What the rows of a step of molecules are made from."""

    core: StepCore
    heat: np.ndarray  # see `thermostat_workspace`
    has_rates: bool  # whether there are time-dependent terms
    barostat: tuple | None  # its workspace
    gradient: GradientWorkspace | None
    extension: tuple | None  # its workspace
    code: Code | None = None  # see `thermostat_code`; None where a step is only printed


#: Workspace of an extension, a NamedTuple.
Workspace = TypeVar("Workspace", bound=tuple)


class StepExtension(Generic[Workspace]):
    """Rows that a thermostat adds to a step besides its flow, where a scheme has the flows BEGIN
    and END, and what they remember in a workspace."""

    def workspace(self, state: State) -> Workspace:
        """A new workspace."""
        raise NotImplementedError

    def begin(self, parts: StepParts, timing: Timing) -> list[Pass]:
        """Rows before the first of some steps. Forces are known there, and energies, or the row has
        kept what it needs of them (KEPT_BY_EXTENSION)."""
        return []

    def end(self, parts: StepParts, timing: Timing) -> list[Pass]:
        """Rows after the last of these steps. Forces, energies and virials are known there."""
        return []

    def after_barostat(self, parts: StepParts, timing: Timing) -> list[Pass]:
        """Rows after a move of the box."""
        return []

    def after_failure(self, parts: StepParts) -> list[Pass]:
        """Rows after forces that failed; the code is in `status` of the core. If they write OK
        there, the forces are computed once more."""
        return []

    def forget(self, workspace: Workspace) -> None:
        """Another scheme moves the state."""

    def arrays(self, workspace: Workspace) -> dict[str, np.ndarray]:
        """What a checkpoint keeps of a workspace."""
        return {}

    def restored(self, state: State, arrays: dict[str, np.ndarray]) -> Workspace:
        """The workspace with these arrays. Raises ValueError if they do not fit."""
        raise NotImplementedError

    def sums(self, workspace: Workspace) -> np.ndarray | None:
        """What its rows have counted and summed since the start."""
        return None

    def keeps_energy(self, workspace: Workspace) -> bool:
        """Whether a restored workspace has what its rows need of the energies of its state."""
        return False


class ExtendedThermostat(Protocol):
    """The record of a thermostat with an extension."""

    @property
    def extension(self) -> StepExtension: ...


NONE = StepExtension()


def extension_of(scheme: Scheme) -> StepExtension:
    """The extension of the thermostat of a scheme; without one, an extension that has no rows."""
    return cast(ExtendedThermostat, scheme.thermostat).extension if scheme.has_groups else NONE
