"""Runs of a single body: samples at regular times, columns at the end, figures."""

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import ceil, inf
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import PositiveFloat

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import NOW, ORIGIN, State, state_of
from rigidmd.core.toml import Json
from rigidmd.engines.protocol import NotFiniteError
from rigidmd.engines.samples import MATRIX
from rigidmd.errors import SimulationError, StructureError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.keys.body import MOTION
from rigidmd.features.bodies.motion import (
    Motion,
    energies_of,
    is_balanced,
    motion,
    stacked,
    states_of,
)
from rigidmd.features.bodies.stable_step import stable_step, step_errors, step_warnings
from rigidmd.features.bodies.summary import summarise_body, summary_text
from rigidmd.features.bodies.system import BodySystem, Pose
from rigidmd.formats import format_of
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.io.write import write_columns, write_npz
from rigidmd.mechanics.rotation import orthogonality_error
from rigidmd.run.failed_check import MIN_INERTIA_FRACTION, ROUNDING, FailedCheck
from rigidmd.run.observers import Frames, Moment, Observer, SceneFile
from rigidmd.run.part import RunPart
from rigidmd.run.resume import Arrays, NotNegative, RunRecord, check_same_scene, state_from
from rigidmd.run.schedule import Segment, interruptible
from rigidmd.scene import BodyScene
from rigidmd.scene.validation import not_none, number_of_steps

if TYPE_CHECKING:
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation


#: Maximum number of evaluations of forces between two checks, and most samples.
EVALUATIONS_PER_CHECK, SAMPLES_PER_CHECK = 1_000_000, 512


class Sampler(Observer):
    """Keeps states, of which columns are made at the end."""

    remembers: ClassVar[dict[str, object]] = {"stacked": Arrays}
    ends = True

    def __init__(self, interval: float):
        self.interval = interval
        self.states: list[State] = []

    @property
    def stacked(self) -> dict[str, np.ndarray]:
        """The arrays of all states, by name."""
        return stacked(self.states)

    @stacked.setter
    def stacked(self, arrays: dict[str, np.ndarray]) -> None:
        self.states = states_of(arrays)

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        super().resume(run, kept)
        for state in self.states:
            state_from(state._asdict(), run._part.state, exact=False)

    def observe(self, moment: Moment) -> None:
        self.states.append(moment.state)


class BodyWatch(Observer):
    """Checks the state against the limits of the scene, independent of the sample interval.

    exchanged : the largest energy exchanged so far (J), to which errors of the energy are relative
    """

    remembers: ClassVar[dict[str, object]] = {"exchanged": NotNegative}
    ends = True

    def __init__(self, run: "Simulation"):
        self._run, self._system, self._limits = run, run.system, run.scene.watch
        system = run.system
        every = number_of_steps(not_none(run.scene.output.interval_s), run.scene.run.timestep_s)
        # half a second of computing
        step_limit = EVALUATIONS_PER_CHECK // getattr(system.method, "force_evaluations", 1)
        self.steps = min(step_limit, SAMPLES_PER_CHECK * every)
        self._start = energies_of(system, system.state)
        swing = sum(
            np.linalg.norm(term.force) * np.linalg.norm(term.point) for term in system.steady_forces
        )
        self.exchanged = abs(self._start["kinetic"]) + (
            0.0 if system.translates else 2 * float(swing)
        )

    @np.errstate(over="ignore", invalid="ignore")
    def observe(self, moment: Moment) -> None:
        system, limits = self._system, self._limits
        state, dt = self._run._part.state, self._run._part.segment.dt
        largest = not_none(limits.orthogonality)
        if largest and not (worst := orthogonality_error(state.rotation)) <= largest:
            message = (
                f"Q is not a rotation: |QᵀQ - 1| is {worst:.2g} (watch.orthogonality = {largest:g})"
            )
            raise FailedCheck(message, rotation_not_orthogonal=True)
        if system.rotates and limits.turn_rad:
            omega = system.pose(float(state.time[0]), state).angular_velocity_body
            angle = dt * float(np.linalg.norm(omega))
            if angle > limits.turn_rad:
                message = (
                    f"the body rotates by {angle:.3g} rad in a step (watch.turn_rad ="
                    f" {limits.turn_rad:g})"
                )
                raise FailedCheck(message, factor=angle / limits.turn_rad)
        if not limits.energy or not is_balanced(system):
            return
        start = self._start
        now = energies_of(system, state)
        self.exchanged = max(
            self.exchanged, sum(abs(now[key] - start[key]) for key in ("potential", "work"))
        )
        error = abs(now["energy"] - now["work"] - start["energy"] + start["work"])
        scale = self.exchanged + ROUNDING * abs(now["energy"])
        if not error <= limits.energy * scale:
            raise FailedCheck(
                f"the energy minus the work done changed by {error:.3g} J,"
                f" {error / scale if scale else inf:.3g} of all energy exchanged (watch.energy ="
                f" {limits.energy:g})"
            )

    def explain(self, error: SimulationError, stable: float | None) -> str:
        """The message of a failed check in full: what was observed, the likely cause, what to try.

        stable : the longest stable step, s
        """
        system = self._system
        dt = self._run._part.segment.dt
        if isinstance(error, NotFiniteError):
            failed = FailedCheck("position or momentum of the body is not finite")
        elif isinstance(error, FailedCheck):
            failed = error
        else:
            return str(error)
        shorter = f"a shorter timestep_s than {dt:g}"
        if stable is not None and stable < dt:
            shorter = f"timestep_s below {stable:.2g}, where its spin and swing are stable"
        elif failed.factor is not None:
            shorter = f"timestep_s = {dt / failed.factor:.2g} or less"
        inertia = system.inertia
        advice = shorter
        if failed.rotation_not_orthogonal:
            likely = "Q was changed from outside: a run only multiplies rotations"
            if isinstance(system.method, Solver):
                likely = f"only accuracy keeps Q a rotation under {system.method.name}"
            advice = f"integrator = 'srkn_6', which keeps Q, or {shorter}"
        elif (
            system.rotates
            and (least := inertia[inertia > 0].min()) < MIN_INERTIA_FRACTION * inertia.max()
        ):
            likely = (
                f"bad inertia: the smallest moment, {least:.2g} kg m², is"
                f" {least / inertia.max():.1g} of the largest, and the body spins about that axis"
                " faster than the step can follow"
            )
            advice = f"{shorter}, or a moment of 0"
        else:
            likely = "timestep_s is too long for this motion, or a force grows without bound"
        return f"{failed}. Likely cause: {likely}. Try {advice}"


MOTION_NPZ = "motion.npz"


class MotionFiles(Observer):
    """motion.csv and motion.npz."""

    _names = (MOTION, MOTION_NPZ)

    def __init__(self, sampler: Sampler, *, npz: bool):
        self._sampler, self._npz = sampler, npz

    def end(self, run: "Simulation", results: "Results") -> None:
        samples = results.samples
        write_columns(run.path(MOTION), samples.written)
        results.files.append(run.path(MOTION))
        if self._npz:
            write_npz(
                run.path(MOTION_NPZ),
                {name: samples[name] for name in samples.described if name != MATRIX},
            )
            results.files.append(run.path(MOTION_NPZ))

    def failed(self, run: "Simulation") -> str:
        if not self._sampler.states:
            return ""
        write_columns(run.path(MOTION), motion(run.system, self._sampler.states).written)
        return f". The motion so far: {run.path(MOTION)}"


@dataclass
class BodyRecord(RunRecord):
    """The record of a run of a body."""

    stable: PositiveFloat | None = None  # the longest stable step, s
    start: Arrays = field(default_factory=dict)  # the state of `Simulation.start_from`, if any


class BodyRun(RunPart[BodySystem, BodyRecord, Motion]):
    """The part of a simulation of a single body."""

    record_type = BodyRecord

    def __init__(
        self,
        simulation: "Simulation",
        scene: BodyScene,
        applied: Mapping[str, Callable[[Pose], tuple]] | None = None,
    ):
        super().__init__(simulation)
        self._choice = None
        applied = dict(applied or {})
        if scene.run.is_auto:
            from rigidmd.features.bodies.trials import choose_for_body

            simulation._announce("choosing integrator and step by pilot runs")
            scene, self._choice = choose_for_body(scene, applied)
        self.system = self._scene_system = build_body(scene, applied)
        self._segments = self._equal_step_segments()
        self._given: dict[str, np.ndarray] = {}  # the state of `start_from`
        self.reset()

    @property
    def scene(self) -> BodyScene:
        return self.system.scene

    def take_threads(self, count: int) -> None:
        """A body has one thread."""

    def start_from(self, state: State) -> None:
        if errors := self._scene_system.state_errors(state):
            raise StructureError("start_from", errors)
        if self._choice is not None:
            why = "integrator = 'auto' has chosen for the start of the scene"
            raise StructureError("start_from", [f"{why}: set integrator and timestep_s"])
        self._given = state_of(*state[:5])._asdict()
        self.reset()

    def _set_start(self, given: dict[str, np.ndarray]) -> None:
        """Let the system start at a given state, by default at the start of the scene."""
        state = State(**given) if given else self._scene_system.state
        self.system = replace(self._scene_system, state=state)

    def reset(self) -> None:
        super().reset()
        self.record.start = self._given
        self._set_start(self._given)
        self.engine = self.system.engine()
        self.engine.stop_requested = self.simulation._must_end
        self.state = self.engine.begin(self.system.state, self.system.method)

    def prepare(self) -> None:
        system = self.system
        run = self.scene.run
        compiled, method = system.engine(), system.method
        compiled.advance(compiled.begin(system.state, method), method, run.timestep_s, 0)
        if run.has_scheme and (names := system.velocity_dependent_functions()):
            self.simulation._note(
                f"{' and '.join(names)}: depends on velocities, so that {run.integrator} is of"
                " order 1. For friction and resistance use [friction] and [fluid], which keep"
                " order 2. Otherwise integrator = 'dop853'"
            )
        self.record.stable = stable_step(system)
        for sentence in (*step_errors(system), *step_warnings(system)):
            self.simulation._note(sentence)

    def durations(self) -> list[float]:
        return [segment.steps * segment.dt for segment in self._segments]

    def enter_segment(self, k: int) -> Segment:
        if k > 0:
            self.state.begin_segment(self.system.breaks()[k - 1])
            self.engine.change(*self.system.terms_at(float(self.state.time[NOW])))
        return self._segments[k]

    def restore(self, kept: Checkpoint) -> None:
        arrays = kept.of("state").arrays
        method = self.system.method
        k = self.record.position.segment
        check_same_scene(self.scene, self.record.scene, {}, int(arrays["step"][NOW]))
        if start := self.record.start:
            start = state_from(start, self._scene_system.state)._asdict()
        self._set_start(start)
        self.state = state_from(arrays, self.state, exact=isinstance(method, Scheme))
        if k > 0:
            self.engine.change(*self.system.terms_at(float(self.state.time[ORIGIN])))
        self.engine.recall(self.state, kept.of("engine").arrays)

    def reenter_segment(self, k: int) -> Segment:
        return self._segments[k]

    def _equal_step_segments(self) -> list[Segment]:
        """Segments between the breaks in functions of time, in equal steps no longer than the
        timestep of the scene."""
        run = self.scene.run
        segments = []
        steps = 0
        for begin, end in pairwise((0.0, *self.system.breaks(), run.steps * run.timestep_s)):
            exact = (end - begin) / run.timestep_s
            step_count = round(exact)
            if abs(exact - step_count) > 1e-9 * max(1.0, exact):
                step_count = ceil(exact)
            # nothing lies between two breaks that are equal to rounding
            is_whole = step_count == exact
            dt = run.timestep_s if step_count == 0 or is_whole else (end - begin) / step_count
            segments.append(Segment(self.system.method, dt, step_count, steps))
            steps += step_count
        return segments

    def observe(self, moment: Moment) -> Pose:
        return self.system.pose(moment.time, moment._state)

    def observe_now(self) -> Pose:
        return self.system.pose(float(self.state.time[NOW]), self.state)

    def energy_now(self) -> float:
        return energies_of(self.system, self.state)["energy"]

    def forces_now(self) -> np.ndarray:
        with interruptible():
            return self.engine.evaluate(self.state)[0].force

    def default_observers(self) -> list[Observer]:
        output = self.scene.output
        interval = not_none(output.interval_s)
        self._sampler, self._watch = Sampler(interval), BodyWatch(self.simulation)
        files: list[Observer] = []
        if output.trajectory:
            velocities = not_none(format_of(output.trajectory)).velocities
            files = [Frames(interval, not_none(output.topology), output.trajectory, velocities)]
        if self.simulation.folder is not None:
            files = [SceneFile(), *files, MotionFiles(self._sampler, npz=output.npz)]
            if output.figures:  # which others need not import
                from rigidmd.features.bodies.figures import FIGURES
                from rigidmd.features.view.figures.run import Figures

                files.append(Figures(FIGURES, ("png", "svg")))
        return [*files, self._sampler, self._watch]

    def samples(self) -> Motion:
        return motion(self.system, self._sampler.states)

    def summary(self, samples: Motion, preparing: float, wall: float) -> Json:
        steps = sum(segment.steps for segment in self._segments)
        computing = sum(self.record.position.computing)
        interrupted = self.simulation._is_interrupted
        summary = summarise_body(
            self.system, samples, steps, preparing, wall, computing, interrupted=interrupted
        )
        summary["stable_timestep_s"] = self.record.stable
        if self.engine.is_stiff:
            self.simulation._note(
                "the motion is stiff: stability, not accuracy, limits the steps of dop853."
                " integrator = 'radau' takes much longer ones"
            )
        summary["notes"] = [
            *([self._choice] if self._choice else []),
            *summary["notes"],
            *self.record.notes,
        ]
        return summary

    def summary_text(self, summary: Json, known: Container[str], *, is_short: bool) -> str:
        return summary_text(summary, known)

    def explain(self, error: SimulationError) -> str:
        return self._watch.explain(error, self.record.stable)

    @property
    def headline(self) -> str:
        system = self.system
        run = self.scene.run
        pinned = "" if system.translates else ", pinned"
        return (
            f"{self.scene.name}: one body ({system.kind}{pinned}), {system.degrees_of_freedom}"
            f" degrees of freedom; {run.steps} steps of {run.timestep_s:g} s,"
            f" {run.integrator}"
        )

    def start_energy(
        self, size: float = 1.0, unit: str = "J", *, measure_accuracy: bool = False
    ) -> Json:
        """Energies at the start in J, force in N along the lab's axes, torque in N m along the
        body's."""
        self.reset()
        with interruptible():
            self.prepare()
        load, _ = self.engine.evaluate(self.state)
        columns = motion(self.system, [self.state])
        torque = load.torque_body @ self.system.axes.T
        return {
            "unit": "J",
            **{name: float(columns[name][0]) for name in ("kinetic", "potential", "energy")},
            "force_N": load.force[0].tolist() if len(load.force) else None,
            "torque_body_N_m": torque[0].tolist() if len(torque) else None,
        }
