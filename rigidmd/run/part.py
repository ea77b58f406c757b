"""The part of a simulation that depends on the kind of its system; `molecular` and `body` implement
it."""

from math import isclose
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import NOW, ORIGIN, State
from rigidmd.run.observers import Moment
from rigidmd.run.resume import RunRecord
from rigidmd.run.schedule import Segment

if TYPE_CHECKING:
    from rigidmd.run.simulation import Simulation


class RunPart:
    """What a `Simulation` moves: system, engine, state, the present segment, and the record of the
    run. Subclasses have

    time_unit, record_type : "ps" or "s"; a dataclass, the type of `record`
    headline : first line of the introduction
    prepare() : do everything before the first step, including compilation
    durations() : of all segments, ps or s; 0 without steps
    enter_segment(k), reenter_segment(k) : prepare segment k and return it; return it, when the run
    is resumed in it restore(kept) : return to a checkpoint, whose record is read; CheckpointError
    if it is of another scene, ValueError
        if it is invalid
    observe(moment) : the observation, which `Moment.observation` keeps
    observe_now(), energy_now(), forces_now() : of the present state, for `Simulation`
    default_observers() : the observers that sample, check and write
    samples(), summary(samples, preparing, wall), summary_text(summary, known) : the samples; the
        summary, with seconds of preparing (compiling, removal of overlaps) and of segments with
        observers and output; the latter as text without the notes in `known`
    explain(error) : an error in full: what was seen, the likely cause, what to try
    start_energy(...) : energies and forces at the start
    """

    record_type: type[RunRecord]
    engine_version = "rigidmd"
    threads: Any = 1

    system: Any
    engine: Any
    state: State
    record: Any
    segment: Segment
    durations: Any
    reenter_segment: Any
    time_unit: str

    scene: Any = property(attrgetter("system.scene"))

    def __init__(self, simulation: "Simulation"):
        self.simulation = simulation

    def take_threads(self, count: int) -> None:
        """Set the number of threads; a single body always has one."""

    def reset(self) -> None:
        """Return to the start, so that repeated runs are identical: a new engine, state and
        record."""
        self.record = self.record_type()
        self.segment = Segment(SCHEMES["velocity_verlet"], 1.0, 0)  # before the first segment

    def check_position(self) -> None:
        """Compare the position of a checkpoint with the scene and the state. Raises ValueError."""
        position, state, count = self.record.position, self.state, len(self.durations())
        if position.segment >= count or len(position.computing) != position.segment:
            raise ValueError(f"it is of stage {position.segment} of {count}")
        first, time = 0, 0.0
        for before in map(self.reenter_segment, range(position.segment)):
            first, time = first + before.steps, time + before.steps * before.dt
        segment = self.reenter_segment(position.segment)
        step, done = state.step.tolist(), int(state.step[NOW]) - first
        if position.first != first or step[ORIGIN] != first or not 0 <= done <= segment.steps:
            raise ValueError(
                f"step {step[NOW]} is not in a stage of {segment.steps} steps after"
                f" {position.first}"
            )
        now, origin = state.time.tolist()
        if not (isclose(origin, time, abs_tol=1e-6 * segment.dt) and position.time == time):
            raise ValueError(
                f"its stage began at {origin:g} {self.time_unit}, not at {time:g} {self.time_unit}"
            )
        if now != origin + done * segment.dt:
            raise ValueError(f"step {step[NOW]} is not at {now:g} {self.time_unit}")

    def is_replaced(self, moment: Moment) -> bool:
        """Whether the present moment is followed by another one of the same time."""
        return False

    def is_finite(self) -> bool:
        """Whether all variables of the state are finite."""
        return self.state.is_finite
