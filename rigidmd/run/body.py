"""A single body: samples at even times, columns at the end, figures."""

import contextlib
from collections.abc import Callable, Mapping
from itertools import pairwise
from math import ceil
from typing import Any

import numpy as np

from rigidmd.assemble.body import BodySystem, Pose, build_body
from rigidmd.core.state import NOW
from rigidmd.errors import SimulationError
from rigidmd.forces.body.frame import Inertial
from rigidmd.measure.body_summary import summarise_body
from rigidmd.measure.motion import Motion, Snapshot, drawn_axis, motion
from rigidmd.measure.stable_step import body_rate, stable_angle
from rigidmd.measure.subjects import decided_for_body
from rigidmd.measure.watch import BODY_PATIENCE, LOOKS, BodyCheck
from rigidmd.mechanics.rotor import SplitRotor
from rigidmd.output.folder import SCENE_FILE
from rigidmd.run.loop import Every, Moment, Phase, Results, Simulation
from rigidmd.scene import BodyScene

MOTION_FILE = "motion.csv"


class BodySimulation(Simulation):
    """A scene of a single body, ready to run. Besides the parameters of `Simulation`:

    applied : name -> function of a `Pose` that gives a force (3,) in N along the lab's axes, at the centre of mass, and
        a torque (3,) in N m along the body's axes. It is asked once wherever the body has moved; what depends on the
        velocity is held for a step, which makes that step of order 1
    """

    time_unit = "s"

    scene: BodyScene
    system: BodySystem

    def __init__(
        self,
        scene: BodyScene,
        *arguments: Any,
        applied: Mapping[str, Callable[[Pose], tuple]] | None = None,
        **options: Any,
    ):
        super().__init__(scene, *arguments, **options)
        self._choice = None
        applied = dict(applied or {})
        if scene.run.is_open:
            self._say("choosing integrator and step by pilot runs")
            self.scene, self._choice = decided_for_body(scene, applied)
        self.system = build_body(self.scene, applied)
        self.threads = 1
        self._reset()

    def observe(self, moment: Moment) -> Pose:
        """Position and motion in the body's own axes, in SI units."""
        return moment._seen

    def _look(self, moment: Moment) -> Pose:
        return self.system.pose(moment.time, moment.state)

    def _no_samples(self) -> Motion:
        return Motion({}, [])

    def _reset(self) -> None:
        self.engine = self.system.engine()
        self.state = self.engine.begin(self.system.state, self.system.method)

    def _prepare(self) -> None:
        self._say("compiling (kept on disk: the next run starts at once)")
        self.engine.advance(self.state, self.system.method, self.scene.run.timestep_s, 0)
        self._reset()
        self._stretches = self._phases()
        self._watch = BodyCheck(self.system, self.scene.watch)
        rate = body_rate(self.system)
        self._stable = stable_angle(self.system.method) / rate if self.scene.watch.stable_step and rate else None
        if self._stable is not None and self.scene.run.timestep_s > self._stable:
            self._note(
                f"timestep_s = {self.scene.run.timestep_s:g} is longer than what is stable: at its start the body "
                f"swings or spins at {rate:.3g} rad/s, which {self.scene.run.integrator} can follow "
                f"up to {self._stable:.3g} s"
            )

    def _durations(self) -> list[float]:
        return [phase.steps * phase.dt for phase in self._stretches]

    def _begin(self, k: int) -> Phase:
        if k > 0:
            self.state.begin_stretch(self.system.breaks()[k - 1])
            self.engine.change(*self.system.during(float(self.state.time[NOW])))
        return self._stretches[k]

    def _phases(self) -> list[Phase]:
        """From break to break of what follows time as told, in steps that end there, none longer than the scene's."""
        run = self.scene.run
        phases, steps = [], 0
        for begin, end in pairwise((0.0, *self.system.breaks(), run.steps * run.timestep_s)):
            exact = (end - begin) / run.timestep_s
            whole = round(exact)
            if abs(exact - whole) > 1e-9 * max(1.0, exact):
                whole = ceil(exact)
            # two breaks that are one to rounding leave nothing between them
            phases.append(Phase((end - begin) / whole if whole not in (0, exact) else run.timestep_s, whole, steps))
            steps += whole
        return phases

    def _advance(self, k: int, steps: int, done: int) -> None:
        until = int(self.state.step[NOW]) + steps
        self.engine.advance(self.state, self.system.method, self._stretches[k].dt, until)

    def _patience(self, k: int) -> int:
        """Half a second or less of computing."""
        return BODY_PATIENCE // getattr(self.system.method, "force_evaluations", 1)

    def _check(self, k: int, dt: float) -> None:
        if finding := self._watch.finding(self.state, dt):
            raise finding

    def _file_names(self) -> list[str]:
        from rigidmd.output.body_figures import FIGURES

        output = self.scene.output
        names = [SCENE_FILE, MOTION_FILE, "motion.npz", "summary.json", output.topology]
        figures = [f"{figure}.{ending}" for figure in FIGURES for ending in ("png", "svg")]
        return [*names, *figures, *([output.trajectory] if output.trajectory else [])]

    def _own_observers(self, stack: contextlib.ExitStack, results: Results) -> list[Every]:
        self._snapshots = []

        def sample(moment: Moment) -> None:
            self._snapshots.append(Snapshot(moment.time, self.state.copy()))
            if len(self._snapshots) % LOOKS == 0:
                self._check(moment.stage, self._stretches[moment.stage].dt)

        interval = self.scene.interval
        return [Every(interval, sample), *(Every(interval, write) for write in self._writers(stack, results))]

    def _writers(self, stack: contextlib.ExitStack, results: Results) -> list[Callable[[Moment], None]]:
        output = self.scene.output
        if self.folder is None:

            def keep(moment: Moment) -> None:
                results._times.append(moment.time)
                results._frames.append(moment.site_positions.astype("float32"))

            return [keep] if output.trajectory else []
        from rigidmd.output.scene_file import write_body_scene
        from rigidmd.output.trajectory import TrajectoryFile, write_topology

        write_body_scene(self.folder, self.scene)
        results.files.append(self.folder / SCENE_FILE)
        if not output.trajectory:
            return []
        write_topology(self.folder / output.topology, self.system, self.state, False)
        path = self.folder / output.trajectory
        file = TrajectoryFile(path, self.system, self.scene.interval, path.suffix in (".trr", ".nc"), False)
        stack.callback(file.close)
        results.files += [self.folder / output.topology, path]

        def write(moment: Moment) -> None:
            file.write(moment.state, moment.time, moment.step)
            results._times.append(moment.time)

        return [write]

    def _conclude(self, results: Results, prepared: float, wall: float, computing: list[float]) -> None:
        results.samples = motion(self.system, self._snapshots)
        results.summary = summarise_body(
            self.system, results.samples, sum(p.steps for p in self._stretches), prepared, wall, sum(computing),
            self._interrupted,
        )  # fmt: skip
        results.summary["stable_timestep_s"] = self._stable
        results.summary["notes"] += self._warnings
        if self._choice:
            results.summary["notes"].insert(0, self._choice)
        if self.folder is None:
            return
        from rigidmd.output.body_figures import draw_motion
        from rigidmd.output.motion_file import write_csv, write_npz
        from rigidmd.output.report import write_summary

        columns = results.samples.columns
        write_csv(self.folder / MOTION_FILE, columns)
        results.files.append(self.folder / MOTION_FILE)
        if self.scene.output.npz:
            write_npz(self.folder / "motion.npz", columns)
            results.files.append(self.folder / "motion.npz")
        if self.scene.output.figures and len(columns["t"]) > 2:
            results.files += draw_motion(self.folder, self.scene.name, **self._drawn(results.samples))
        results.files.append(self.folder / "summary.json")
        results.summary["files"] = [str(path) for path in results.files]
        write_summary(self.folder / "summary.json", results.summary)

    def _drawn(self, samples: Motion) -> dict:
        """What the figures show: omega along the principal axes, where it lies on ellipsoids that stay."""
        system = self.system
        omega = np.stack([samples[f"omega_body_{k}"] for k in (1, 2, 3)], axis=-1) @ system.axes if system.turns else []
        own = {f"omega_body_{k + 1}": omega[:, k] for k in range(3)} if system.turns else {}
        constant = isinstance(system.body.rotor, SplitRotor) and isinstance(system.body.frame, Inertial)
        return {
            "columns": samples.columns | own,
            "axis_body": drawn_axis(system),
            "inertia": system.inertia if constant else None,
            "invariants": samples.invariants,
            "gravity": self.scene.gravity and self.scene.gravity.acceleration_m_s2,
        }

    def _explain(self, error: SimulationError, dt: float) -> str:
        return self._watch.explained(error, dt, self._stable)

    def _save(self) -> str:
        if self.folder is None:
            return ""
        from rigidmd.output.motion_file import write_csv

        write_csv(self.folder / MOTION_FILE, motion(self.system, self._snapshots).columns)
        return f". The motion so far: {self.folder / MOTION_FILE}"

    def introduction(self) -> str:
        """One line, before the run."""
        system, run = self.system, self.scene.run
        pinned = "" if system.flies else ", pinned"
        return (
            f"{self.scene.name}: one body ({system.kind}{pinned}), {system.degrees_of_freedom} degrees of freedom; "
            f"{run.steps} steps of {run.timestep_s:g} s, {run.integrator.replace('_', ' ')}"
        )

    def conclusion(self, results: Results) -> str:
        """The summary as a person reads it."""
        from rigidmd.output.report import body_summary_text

        return body_summary_text(results.summary)

    def start_energy(self) -> dict:
        """Energies of the start in J, force in N along the lab's axes, torque in N m along the body's."""
        self._prepare()
        load, _ = self.engine.evaluate(self.state)
        seen = motion(self.system, [Snapshot(0.0, self.state)])
        torque = load.torque_body @ self.system.axes.T
        return {
            "unit": "J",
            "kinetic": float(seen["kinetic"][0]),
            "potential": float(seen["potential"][0]),
            "energy": float(seen["energy"][0]),
            "force_N": load.force[0].tolist() if len(load.force) else None,
            "torque_body_N_m": torque[0].tolist() if len(torque) else None,
        }
