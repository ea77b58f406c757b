"""Runs of a single body: samples at regular times, columns at the end, figures."""

from collections.abc import Callable, Mapping
from itertools import pairwise
from math import ceil, inf
from pathlib import Path
from typing import Any, Unpack

from pydantic import PositiveFloat

from rigidmd.assemble.body import build_body
from rigidmd.compile.cache import describe_cache
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import NOW, ORIGIN
from rigidmd.engines.body_motion import Motion, Snapshot, motion
from rigidmd.engines.body_system import BodySystem, Pose
from rigidmd.engines.protocol import Engine
from rigidmd.errors import SceneError, SimulationError
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.run.body_observers import BodyWatch, Figures, MotionFiles, Sampler
from rigidmd.run.observers import Frames, Moment, Observer, SceneFile
from rigidmd.run.options import Options
from rigidmd.run.pilot.stable_step import fastest_body_rate, stable_angle
from rigidmd.run.pilot.trial_systems import choose_for_body
from rigidmd.run.provenance import plain
from rigidmd.run.report import body_summary_text
from rigidmd.run.resume import ResumeData, check_same_scene, read_as, state_from
from rigidmd.run.segments import RunTimes, Segment
from rigidmd.run.signals import interruptible
from rigidmd.run.simulation import Simulation
from rigidmd.run.summary import summarise_body
from rigidmd.scene import BodyScene
from rigidmd.scene.validation import not_none


class BodyResumeData(ResumeData):
    """Resume data of the run of a body."""

    stable: PositiveFloat | None = None  # the longest stable step, s


class BodySimulation(Simulation):
    """A scene of a single body, ready to run. Besides the parameters of `Simulation`:

    applied : name -> function of a `Pose` that gives a force (3,) in N along the lab's axes, at the centre of mass, and
        a torque (3,) in N m along the body's axes. It is called once for each position of the body. Forces that
        depend on the velocity are constant within a step, which reduces its order to 1
    """

    time_unit = "s"
    _summary_text = staticmethod(body_summary_text)

    scene: BodyScene
    system: BodySystem
    engine: Engine

    def __init__(
        self, scene: BodyScene, folder: str | Path | None = None, force: bool = False, *,
        applied: Mapping[str, Callable[[Pose], tuple]] | None = None, **options: Unpack[Options],
    ):  # fmt: skip
        if of_molecules := [key for key in ("forces", "thermostat") if key in options]:
            raise SceneError(
                scene.source,
                [f"{' and '.join(of_molecules)}: for molecules; a single body takes applied={{name: function}}"],
            )
        super().__init__(scene, folder, force, **options)
        self._choice = None
        applied = dict(applied or {})
        if scene.run.is_auto:
            self._announce("choosing integrator and step by pilot runs")
            self.scene, self._choice = choose_for_body(scene, applied)
        self.system = build_body(self.scene, applied)
        self.scene = self.system.scene
        self.threads = 1
        self._reset()

    def _reset(self) -> None:
        self.engine = self.system.engine()
        self.engine.stop_requested = self._must_end
        self.state = self.engine.begin(self.system.state, self.system.method)

    def _prepare(self) -> None:
        self._announce(f"compiling ({describe_cache()})")
        self.engine.advance(self.state, self.system.method, self.scene.run.timestep_s, 0)
        self._reset()
        self._segments = self._equal_step_segments()
        rate, angle = fastest_body_rate(self.system), stable_angle(self.system.method)
        followed = self.scene.watch.stable_step and rate > 0 and angle < inf  # some solvers choose their own steps
        self._resume_data = BodyResumeData(stable=angle / rate if followed else None)
        if (stable := self._resume_data.stable) is not None and self.scene.run.timestep_s > stable:
            self.note(
                f"timestep_s = {self.scene.run.timestep_s:g} is longer than what is stable: at its start the body "
                f"swings or spins at {rate:.3g} rad/s, which {self.scene.run.integrator} can follow "
                f"up to {stable:.3g} s"
            )

    def _durations(self) -> list[float]:
        return [segment.steps * segment.dt for segment in self._segments]

    def _enter_segment(self, k: int) -> Segment:
        if k > 0:
            self.state.begin_segment(self.system.breaks()[k - 1])
            self.engine.change(*self.system.terms_at(float(self.state.time[NOW])))
        return self._segments[k]

    def _resume_json(self) -> dict[str, Any]:
        return self._resume_data.to_json(scene=plain(self.scene), notes=self.notes)

    def _restore(self, kept: Checkpoint) -> None:
        self._resume_data = read_as(BodyResumeData, kept.values["run"])
        self._warnings.extend(self._resume_data.notes)
        self._segments = self._equal_step_segments()
        arrays, method = kept.of("state").arrays, self.system.method
        check_same_scene(self.scene, self._resume_data.scene, {}, int(arrays["step"][NOW]))
        self.state = state_from(arrays, self.state, exact=isinstance(method, Scheme))
        k = kept.values["place"]["stretch"]
        if k > 0:
            self.engine.change(*self.system.terms_at(float(self.state.time[ORIGIN])))
        self.engine.recall(self.state, kept.of("engine").arrays)
        self.engine.check(self.state, method, self._segments[k].dt, self.system.state if k == 0 else None)

    def _reenter_segment(self, k: int) -> Segment:
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

    def _observe(self, moment: Moment) -> Pose:
        return self.system.pose(moment.time, moment._state)

    def _default_observers(self) -> list[Observer]:
        output, interval = self.scene.output, not_none(self.scene.output.interval_s)
        self._sampler, self._watch = Sampler(interval), BodyWatch(self)
        files: list[Observer] = []
        if output.trajectory:
            with_velocities = output.trajectory.endswith((".trr", ".nc"))
            files = [Frames(interval, not_none(output.topology), output.trajectory, with_velocities)]
        if self.folder is not None:
            files = [SceneFile(), *files, MotionFiles(self._sampler, output.npz)]
            files += [Figures()] if output.figures else []
        return [*files, self._sampler, self._watch]

    def _samples(self) -> Motion:
        return motion(self.system, self._sampler.snapshots)

    def _summary(self, samples: Motion, times: RunTimes) -> dict[str, Any]:
        steps = sum(segment.steps for segment in self._segments)
        found = summarise_body(self.system, samples, steps, times, self._interrupted)
        found["stable_timestep_s"] = self._resume_data.stable
        if self.engine.is_stiff:
            self.note(
                "the motion is stiff: stability, not accuracy, limits the steps of dop853; integrator = 'radau' takes "
                "much longer ones"
            )
        found["notes"] = [*([self._choice] if self._choice else []), *found["notes"], *self.notes]
        return found

    def _explain(self, error: SimulationError) -> str:
        return self._watch.check.explain(error, self.segment.dt, self._resume_data.stable)

    @property
    def _headline(self) -> str:
        system, run = self.system, self.scene.run
        pinned = "" if system.translates else ", pinned"
        return (
            f"{self.scene.name}: one body ({system.kind}{pinned}), {system.degrees_of_freedom} degrees of freedom; "
            f"{run.steps} steps of {run.timestep_s:g} s, {run.integrator.replace('_', ' ')}"
        )

    def start_energy(self) -> dict:
        """Energies at the start in J, force in N along the lab's axes, torque in N m along the body's."""
        with interruptible():
            self._prepare()
        load, _ = self.engine.evaluate(self.state)
        seen = motion(self.system, [Snapshot(0.0, self.state)])
        torque = load.torque_body @ self.system.axes.T
        return {
            "unit": "J",
            **{name: float(seen[name][0]) for name in ("kinetic", "potential", "energy")},
            "force_N": load.force[0].tolist() if len(load.force) else None,
            "torque_body_N_m": torque[0].tolist() if len(torque) else None,
        }
