"""The part of a simulation that depends on the kind of its scene."""

from abc import ABC, abstractmethod
from collections.abc import Container
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from rigidmd.core.integrators import SCHEMES
from rigidmd.core.process import FairLock
from rigidmd.core.state import State
from rigidmd.core.toml import Json
from rigidmd.engines.protocol import Engine
from rigidmd.errors import SimulationError
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.run.observers import Moment, Observer
from rigidmd.run.resume import RunRecord, restored
from rigidmd.run.schedule import Segment

if TYPE_CHECKING:
    from rigidmd.engines.observables import Observation
    from rigidmd.engines.samples import SampleTable
    from rigidmd.engines.sites import AnySystem
    from rigidmd.run.simulation import Simulation
    from rigidmd.scene import OneScene


SystemT = TypeVar("SystemT", bound="AnySystem")
RecordT = TypeVar("RecordT", bound=RunRecord)
SamplesT = TypeVar("SamplesT", bound="SampleTable")


class RunPart(ABC, Generic[SystemT, RecordT, SamplesT]):
    """What a `Simulation` moves: system, engine, state, the current segment, and the record of the
    run.

    record_type : a dataclass, the type of `record`
    """

    record_type: type[RecordT]
    engine_version = "rigidmd"

    system: SystemT
    engine: Engine
    state: State
    record: RecordT
    segment: Segment

    def __init__(self, simulation: "Simulation"):
        self.simulation = simulation
        #: Held while the engine computes: other threads may read observables.
        self.lock = FairLock()

    @property
    def scene(self) -> "OneScene":
        """The scene as it runs."""
        return self.system.scene

    @property
    def threads(self) -> int:
        """Number of threads. Default: one."""
        return 1

    @property
    @abstractmethod
    def headline(self) -> str:
        """First line of the introduction."""

    # the run

    @abstractmethod
    def prepare(self) -> None:
        """Do everything before the first step, including compilation."""

    @abstractmethod
    def durations(self) -> list[float]:
        """Durations of all segments, ps or s, 0 without steps."""

    @abstractmethod
    def enter_segment(self, k: int) -> Segment:
        """Prepare segment k."""

    @abstractmethod
    def reenter_segment(self, k: int) -> Segment:
        """Segment k of a run that is resumed in it or after it."""

    @abstractmethod
    def restore(self, kept: Checkpoint) -> None:
        """Return to a checkpoint, whose record is read. Raises CheckpointError if it is of another
        scene, ValueError if it is invalid."""

    # observation

    @abstractmethod
    def observe(self, moment: Moment) -> "Observation | NamedTuple":
        """The observation that `Moment.observation` keeps."""

    @abstractmethod
    def observe_now(self) -> "Observation | NamedTuple":
        """The observation of the current state."""

    @abstractmethod
    def energy_now(self) -> float:
        """Potential plus kinetic energy of the current state, in the unit of the samples."""

    @abstractmethod
    def forces_now(self) -> np.ndarray:
        """Forces (n, 3) at the current state, kJ/mol/Å or N."""

    @abstractmethod
    def default_observers(self) -> list[Observer]:
        """The observers that sample, check and write."""

    # results

    @abstractmethod
    def samples(self) -> SamplesT:
        """What the observers have sampled."""

    @abstractmethod
    def summary(self, samples: SamplesT, preparing: float, wall: float) -> Json:
        """The summary of the run.

        preparing : seconds of compiling and removal of overlaps
        wall : seconds of the run, with observers and output
        """

    @abstractmethod
    def summary_text(self, summary: Json, known: Container[str], *, is_short: bool) -> str:
        """The summary as text, without the notes in `known`, or its main results."""

    @abstractmethod
    def explain(self, error: SimulationError) -> str:
        """An error in full: what was seen, the likely cause, what to try."""

    @abstractmethod
    def start_energy(
        self, size: float = 1.0, unit: str = "J", *, measure_accuracy: bool = False
    ) -> Json:
        """Energies and forces at the start."""

    @abstractmethod
    def take_threads(self, count: int) -> None:
        """Set the number of threads."""

    @abstractmethod
    def start_from(self, state: State) -> None:
        """Let runs start at a state. Raises StructureError for one that the scene cannot have."""

    def reset(self) -> None:
        """Return to the start, so that repeated runs are identical: a new engine, state and
        record."""
        self.record = self.record_type()
        self.segment = Segment(SCHEMES["velocity_verlet"], 1.0, 0)  # before the first segment

    def restore_record(self, kept: Checkpoint) -> None:
        """Read the record of a checkpoint. Raises ValueError or KeyError."""
        values = restored(kept, self.record_type.types(), self.scene.rows)
        self.record = self.record_type(**values)
        position, count = self.record.position, len(self.durations())
        if position.segment >= count or len(position.computing) != position.segment:
            raise ValueError(f"it is of stage {position.segment} of {count}")

    def is_replaced(self, moment: Moment) -> bool:
        """Whether the current moment is followed by another one of the same time."""
        return False

    def is_finite(self) -> bool:
        """Whether all variables of the state are finite."""
        return self.state.is_finite
