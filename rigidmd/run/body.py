"""Runs of a single body: samples at regular times, columns at the end, figures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf
from typing import TYPE_CHECKING, Any

from pydantic import PositiveFloat

from rigidmd.assemble.body import build_body
from rigidmd.compile.cache import describe_cache
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import NOW, ORIGIN
from rigidmd.engines.body_motion import Motion, Snapshot, motion
from rigidmd.engines.body_system import BodySystem, Pose
from rigidmd.engines.protocol import Engine
from rigidmd.errors import SimulationError
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.io.formats import format_of
from rigidmd.run.body_observers import BodyWatch, Figures, MotionFiles, Sampler
from rigidmd.run.observers import Frames, Moment, Observer, SceneFile
from rigidmd.run.part import RunPart
from rigidmd.run.pilot.stable_step import fastest_body_rate, stable_angle
from rigidmd.run.report import body_summary_text
from rigidmd.run.resume import RunRecord, check_same_scene, state_from
from rigidmd.run.segments import RunTimes, Segment
from rigidmd.run.signals import interruptible
from rigidmd.run.summary import summarise_body
from rigidmd.scene import BodyScene
from rigidmd.scene.validation import not_none

if TYPE_CHECKING:
    from rigidmd.run.simulation import Simulation


@dataclass
class BodyRecord(RunRecord):
    """The record of a run of a body."""

    stable: PositiveFloat | None = None  # the longest stable step, s


class BodyRun(RunPart):
    """The part of a simulation of a single body."""

    time_unit = "s"
    record_type = BodyRecord
    summary_text = staticmethod(body_summary_text)

    system: BodySystem
    engine: Engine
    record: BodyRecord

    def __init__(
        self, simulation: "Simulation", scene: BodyScene, applied: Mapping[str, Callable[[Pose], tuple]] | None
    ):
        super().__init__(simulation)
        self._choice = None
        applied = dict(applied or {})
        if scene.run.is_auto:
            from rigidmd.run.pilot.trial_systems import choose_for_body

            simulation.announce("choosing integrator and step by pilot runs")
            scene, self._choice = choose_for_body(scene, applied)
        self.system = build_body(scene, applied)
        self._segments = self._equal_step_segments()
        self.reset()

    def reset(self) -> None:
        super().reset()
        self.engine = self.system.engine()
        self.engine.stop_requested = self.simulation.must_end
        self.state = self.engine.begin(self.system.state, self.system.method)

    def prepare(self) -> None:
        self.simulation.announce(f"compiling ({describe_cache()})")
        system, run, compiled = self.system, self.scene.run, self.system.engine()
        compiled.advance(compiled.begin(system.state, system.method), system.method, run.timestep_s, 0)
        rate, angle = fastest_body_rate(system), stable_angle(system.method)
        if not self.scene.watch.stable_step or rate == 0 or angle == inf:  # some solvers choose their own steps
            return
        stable = self.record.stable = angle / rate
        if run.timestep_s > stable:
            self.simulation.note(
                f"timestep_s = {run.timestep_s:g} is longer than what is stable: at its start the body swings or spins "
                f"at {rate:.3g} rad/s, which {run.integrator} can follow up to {stable:.3g} s"
            )

    def durations(self) -> list[float]:
        return [segment.steps * segment.dt for segment in self._segments]

    def enter_segment(self, k: int) -> Segment:
        if k > 0:
            self.state.begin_segment(self.system.breaks()[k - 1])
            self.engine.change(*self.system.terms_at(float(self.state.time[NOW])))
        return self._segments[k]

    def restore(self, kept: Checkpoint) -> None:
        arrays, method, k = kept.of("state").arrays, self.system.method, self.record.position.segment
        check_same_scene(self.scene, self.record.scene, {}, int(arrays["step"][NOW]))
        self.state = state_from(arrays, self.state, exact=isinstance(method, Scheme))
        if k > 0:
            self.engine.change(*self.system.terms_at(float(self.state.time[ORIGIN])))
        self.engine.recall(self.state, kept.of("engine").arrays)
        self.engine.check(self.state, method, self._segments[k].dt, self.system.state if k == 0 else None)

    def reenter_segment(self, k: int) -> Segment:
        return self._segments[k]

    def _equal_step_segments(self) -> list[Segment]:
        """Segments between the breaks of functions of time, in equal steps no longer than the timestep of the scene."""
        run = self.scene.run
        segments, steps = [], 0
        for begin, end in pairwise((0.0, *self.system.breaks(), run.steps * run.timestep_s)):
            exact = (end - begin) / run.timestep_s
            whole = round(exact)
            if abs(exact - whole) > 1e-9 * max(1.0, exact):
                whole = ceil(exact)
            # nothing lies between two breaks that are equal to rounding
            dt = (end - begin) / whole if whole not in (0, exact) else run.timestep_s
            segments.append(Segment(self.system.method, dt, whole, steps))
            steps += whole
        return segments

    def observe(self, moment: Moment) -> Pose:
        return self.system.pose(moment.time, moment._state)

    def default_observers(self) -> list[Observer]:
        output, interval = self.scene.output, not_none(self.scene.output.interval_s)
        self._sampler, self._watch = Sampler(interval), BodyWatch(self.simulation)
        files: list[Observer] = []
        if output.trajectory:
            velocities = not_none(format_of(output.trajectory)).velocities
            files = [Frames(interval, not_none(output.topology), output.trajectory, velocities)]
        if self.simulation.folder is not None:
            files = [SceneFile(), *files, MotionFiles(self._sampler, output.npz)]
            files += [Figures()] if output.figures else []
        return [*files, self._sampler, self._watch]

    def samples(self) -> Motion:
        return motion(self.system, self._sampler.snapshots)

    def summary(self, samples: Motion, times: RunTimes) -> dict[str, Any]:
        steps = sum(segment.steps for segment in self._segments)
        found = summarise_body(self.system, samples, steps, times, self.simulation.is_interrupted)
        found["stable_timestep_s"] = self.record.stable
        if self.engine.is_stiff:
            self.simulation.note(
                "the motion is stiff: stability, not accuracy, limits the steps of dop853; integrator = 'radau' takes "
                "much longer ones"
            )
        found["notes"] = [*([self._choice] if self._choice else []), *found["notes"], *self.record.notes]
        return found

    def explain(self, error: SimulationError) -> str:
        return self._watch.check.explain(error, self.segment.dt, self.record.stable)

    @property
    def headline(self) -> str:
        system, run = self.system, self.scene.run
        pinned = "" if system.translates else ", pinned"
        return (
            f"{self.scene.name}: one body ({system.kind}{pinned}), {system.degrees_of_freedom} degrees of freedom; "
            f"{run.steps} steps of {run.timestep_s:g} s, {run.integrator.replace('_', ' ')}"
        )

    def start_energy(self) -> dict:
        """Energies at the start in J, force in N along the lab's axes, torque in N m along the body's."""
        self.reset()
        with interruptible():
            self.prepare()
        load, _ = self.engine.evaluate(self.state)
        seen = motion(self.system, [Snapshot(0.0, self.state)])
        torque = load.torque_body @ self.system.axes.T
        return {
            "unit": "J",
            **{name: float(seen[name][0]) for name in ("kinetic", "potential", "energy")},
            "force_N": load.force[0].tolist() if len(load.force) else None,
            "torque_body_N_m": torque[0].tolist() if len(torque) else None,
        }
