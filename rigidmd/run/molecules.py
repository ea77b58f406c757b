"""Molecules: relief of overlaps, stages with thermostats, samples, log, trajectory."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from math import nan
from typing import Any

import numba
import numpy as np

from rigidmd.assemble.momenta import Removed
from rigidmd.assemble.system import System, build
from rigidmd.core.schemes import Scheme
from rigidmd.core.state import NOW, Load, State, state_of
from rigidmd.core.state_file import write_state
from rigidmd.dynamics.baths import VelocityRescaling
from rigidmd.dynamics.noise import BATH, key_of
from rigidmd.errors import SceneError, SimulationError
from rigidmd.measure import watch
from rigidmd.measure.accuracy import accuracy
from rigidmd.measure.meanings import meanings
from rigidmd.measure.observables import Observation, Reading, observe
from rigidmd.measure.samples import Sample, Samples
from rigidmd.measure.stable_step import is_worth_it, stable_angle, stiffest
from rigidmd.measure.subjects import choose_for_molecules
from rigidmd.measure.summary import summarise
from rigidmd.output.folder import SCENE_FILE
from rigidmd.run.loop import Every, Moment, Phase, Results, Simulation
from rigidmd.run.relief import Relief, relieve
from rigidmd.scene import MolecularScene
from rigidmd.scene.molecules import WITH_VELOCITIES
from rigidmd.units import BOLTZMANN, COULOMB, FEMTOSECOND, KJ_PER_MOL

LAST_GOOD_STATE = "last_good_state.npz"


class MolecularSimulation(Simulation):
    """A scene of molecules, ready to run."""

    time_unit = "ps"

    scene: MolecularScene
    system: System

    def __init__(self, scene: MolecularScene, *arguments: Any, **options: Any):
        super().__init__(scene, *arguments, **options)
        self._built = build(scene)
        self.threads = min(scene.threads or numba.config.NUMBA_NUM_THREADS, numba.config.NUMBA_NUM_THREADS)
        self._reset()

    def observe(self, moment: Moment) -> Reading:
        """Energies, temperatures, pressure, in the units of the log."""
        return moment._seen.reading

    def _look(self, moment: Moment) -> Observation:
        stage = self.scene.stages[moment.stage]
        step = stage.timestep_fs * FEMTOSECOND if stage.integrator == "velocity_verlet" else nan
        return observe(self.system, self.engine, self.state, step)

    def _no_samples(self) -> Samples:
        return Samples()

    def _reset(self) -> None:
        self.system = self._built  # a run may have decided what its scene leaves open
        self.scene = self.system.scene
        self.engine = self.system.engine()
        self.state = self.system.state.copy()
        numba.set_num_threads(self.threads)

    def _file_names(self) -> list[str]:
        """Every file that `run` may write."""
        from rigidmd.output.scene_file import input_names

        output = self.scene.output
        names = [SCENE_FILE, output.topology, "log.csv", "final.npz", "energy.png", "summary.json", LAST_GOOD_STATE]
        return [*names, *input_names(self.scene).values(), *([output.trajectory] if output.trajectory else [])]

    def start_from(self, state: State) -> None:
        """Let runs begin at positions and momenta of one's own, as they are: no overlaps are relieved."""
        begun = state_of(*state[:5])
        self._built = replace(self._built, state=begun, from_lattice=False)
        self._reset()

    def start(self) -> Relief | None:
        """Go to the moment before the first step, from which `run` starts; the relief it took to get there."""
        self._reset()
        self._prepare()
        return self._relief

    def _prepare(self) -> None:
        """Compile, and move apart what a lattice put too close."""
        self._say("compiling (kept on disk: the next run starts at once)")
        _, tallies = self.engine.evaluate(self.state)
        if not all(np.isfinite(tally.energy) for tally in tallies.values()):
            raise SceneError(
                self.scene.source, ["the start has no finite energy: sites of different molecules coincide"]
            )
        first = self.scene.stages[0]
        relief = None
        if self.system.from_lattice:
            radius = np.array([m.radius for m in self.system.species])
            temperature = self.scene.start.temperature_K or first.temperature_K or 0.0
            # At 0 K the scale is the deepest well between two sites.
            thermal = BOLTZMANN * temperature or max((m.epsilon.max() for m in self.system.species), default=0.0)
            if thermal > 0:
                scale = self.system.smallest_diameter
                relief = relieve(self.engine, self.state, radius, scale, thermal, first.timestep_fs * FEMTOSECOND)
                if relief.excess > 1:
                    raise SceneError(
                        self.scene.source,
                        [
                            f"the molecules cannot be packed at {self.system.density:.3g} g/cm³ without overlap: after "
                            f"{relief.steps} steps of relief the first time step would still change a momentum by "
                            f"{relief.excess:.2g} times its thermal size. Lower the density, enlarge the box or "
                            "shorten timestep_fs of the first stage"
                        ],
                    )
        for k in range(len(self.scene.stages)):
            if not self.scene.stages[k].is_open:
                self.engine.advance(self.state, self._row(k), 0.0, 0)
        self.engine.forget()
        self._relief = relief
        self._choices: dict[int, str] = {}
        self._stable: dict[int, float] = {}
        self._stage = 0
        self._last_good: tuple[int, float, State] | None = None
        self._thermal = 0.0
        self._removed = Removed()

    def _row(self, k: int) -> Scheme:
        """The scheme of a stage, with its thermostat."""
        stage = self.scene.stages[k]
        idle = stage.ensemble == "nve"
        if all(stage.ensemble == "nve" for stage in self.scene.stages):
            return stage.scheme
        # a stage without a thermostat among others with one has one that rests: all then run the same machine code
        return stage.scheme.with_bath(
            VelocityRescaling(
                0.0 if idle else BOLTZMANN * stage.temperature_K,
                np.inf if idle else stage.thermostat_time_ps,
                self.system.freedom.total,
                key_of(self.scene.seed, BATH, k),
            )
        )

    def _durations(self) -> list[float]:
        return [stage.duration_ps for stage in self.scene.stages]

    def _begin(self, k: int) -> Phase:
        if self.scene.stages[k].is_open:
            self._choose(k)
        self._stage = k
        if self.scene.removes_momentum_every is not None:
            self._removed.remove(self.system.model, self.state)
        self._estimate(k)
        # a pilot leaves other neighbour lists behind: with new ones at every stage, the resolved scene repeats the bits
        self.engine = self.system.engine()
        self.state.begin_stretch()
        stage = self.scene.stages[k]
        return Phase(stage.timestep_fs * FEMTOSECOND, stage.steps)

    def _estimate(self, k: int) -> None:
        """Longest stable step (ps) of stage k from where it starts, and a warning where its own is longer."""
        stage = self.scene.stages[k]
        if not self.scene.watch.stable_step or not is_worth_it(
            self.system, stage.steps * stage.scheme.force_evaluations
        ):
            return
        found = stiffest(self.system, self.state)
        if found is None:
            return
        self._stable[k] = stable_angle(stage.scheme) / found.rate
        if stage.timestep_fs * FEMTOSECOND > self._stable[k]:
            self._note(
                f"stages.{k}: timestep_fs = {stage.timestep_fs:g} is longer than what is stable: the stiffest motion "
                f"at its start, of {watch.named(self.system, found.molecule)}, has a period of "
                f"{2 * np.pi / found.rate / FEMTOSECOND:.3g} fs, which {stage.integrator} follows up to "
                f"{self._stable[k] / FEMTOSECOND:.3g} fs"
            )

    def _choose(self, k: int) -> None:
        """Find integrator and step of a stage on the present state, and put them into the scene."""
        stage = self.scene.stages[k]
        self._say("choosing integrator and step by pilot runs")
        integrator, timestep, reason = choose_for_molecules(self.system, self.state, stage)
        self._choices[k] = f"{integrator} at {timestep:g} fs chosen: {reason}"
        stages = list(self.scene.stages)
        stages[k] = stage.decided(integrator, timestep)
        self.scene = self.scene.model_copy(update={"stages": tuple(stages)})
        self.system = replace(self.system, scene=self.scene)
        if self.folder is not None:
            from rigidmd.output.scene_file import write_scene

            write_scene(self.folder, self.scene, self.system)

    def _advance(self, k: int, steps: int, done: int) -> None:
        dt = self.scene.stages[k].timestep_fs * FEMTOSECOND
        row, interval = self._row(k), self.scene.removes_momentum_every
        every = steps + done if interval is None else max(1, round(interval / dt))
        end = done + steps
        while done < end:
            to = min(end, done + every - done % every)
            self.engine.advance(self.state, row, dt, int(self.state.step[NOW]) + to - done)
            done = to
            if interval is not None and done % every == 0:
                self._removed.remove(self.system.model, self.state)

    def _own_observers(self, stack: contextlib.ExitStack, results: Results) -> list[Every]:
        log, writers = self._writers(stack, results)
        return [Every(self.scene.output.log_interval_ps, self._sampler(results.samples, log)), *writers]

    def _sampler(self, samples: Samples, log: Callable[[Sample], None]) -> Callable[[Moment], None]:
        """An observer that turns moments into samples, logs and checks them, and keeps the last good state."""
        begins: dict[int, int] = {}  # of each stage, the row of the sample at which it began

        def sample(moment: Moment) -> None:
            seen: Reading = moment.observation
            conserved = seen.energy - float(self.state.books.sum()) / KJ_PER_MOL
            begin = begins.setdefault(moment.stage, max(0, len(samples.rows) - 1))
            origin = samples.rows[begin].conserved if samples.rows else conserved
            boxed = self.system.density > 0
            samples.rows.append(
                Sample(
                    step=moment.step,
                    time=moment.time,
                    potential=seen.potential,
                    kinetic=seen.kinetic,
                    energy=seen.energy,
                    temperature=seen.temperature,
                    volume=self.system.space.volume * 1e-3 if boxed else nan,
                    density=self.system.density if boxed else nan,
                    stage_name=self.scene.stages[moment.stage].label,
                    temperature_translation=seen.temperature_translation,
                    temperature_rotation=seen.temperature_rotation,
                    temperature_translation_unbiased=seen.temperature_translation_unbiased,
                    temperature_rotation_unbiased=seen.temperature_rotation_unbiased,
                    pressure_bar=seen.pressure_bar,
                    drift=conserved - origin,
                    momentum=float(np.linalg.norm(seen.momentum)),
                    orthogonality=seen.orthogonality,
                    conserved=conserved,
                    stage=moment.stage,
                )
            )
            log(samples.rows[-1])
            self._check_sample(samples.rows, begin, moment._seen)
            self._last_good = (moment.step, moment.time, self.state.copy())

        return sample

    def _check_sample(self, rows: list[Sample], begin: int, seen: Observation) -> None:
        now = rows[-1]
        since = begin
        if self.scene.stages[now.stage].ensemble == "nvt":
            memory = self.scene.stages[now.stage].thermostat_time_ps
            since = len(rows) - 1
            while since > begin and rows[since].time > now.time - memory:
                since -= 1
        self._thermal = self._thermal or watch.thermal_energy(self.system, seen.kinetic)
        self._check_step(now.stage, seen.load)
        if finding := watch.sample_finding(self.system, self.scene.watch, rows[since], now):
            raise finding
        self._thermal = watch.thermal_energy(self.system, seen.kinetic)

    def _check_step(self, k: int, load: Load) -> None:
        stage = self.scene.stages[k]
        finding = watch.step_finding(
            self.system,
            self.scene.watch,
            self.state,
            load,
            stage.scheme,
            stage.timestep_fs * FEMTOSECOND,
            self._thermal,
        )
        if finding:
            raise finding

    def _patience(self, k: int) -> int:
        return watch.patience(self.system)

    def _check(self, k: int, dt: float) -> None:
        self._check_step(k, self.engine.load)

    def _writers(self, stack: contextlib.ExitStack, results: Results) -> tuple[Callable[[Sample], None], list[Every]]:
        """What logs a sample, and the observers that write frames, or keep them where there is no folder."""
        output = self.scene.output
        wrapped = output.positions == "wrapped"
        if self.folder is None:

            def keep(moment: Moment) -> None:
                results._times.append(moment.time)
                results._frames.append(self.system.site_positions(moment.state, wrapped).astype(np.float32))

            return lambda sample: None, [Every(output.trajectory_interval_ps, keep)] if output.trajectory else []
        from rigidmd.output.log import Log
        from rigidmd.output.scene_file import write_scene
        from rigidmd.output.trajectory import TrajectoryFile, write_topology

        write_scene(self.folder, self.scene, self.system)
        write_topology(self.folder / output.topology, self.system, self.state, wrapped)
        log = Log(self.folder / "log.csv")
        stack.callback(log.close)
        results.files += [self.folder / name for name in (SCENE_FILE, output.topology, "log.csv")]
        writers = []
        if output.trajectory:
            path = self.folder / output.trajectory
            velocities = path.suffix in WITH_VELOCITIES if output.velocities is None else output.velocities
            file = TrajectoryFile(path, self.system, output.trajectory_interval_ps, velocities, wrapped)
            stack.callback(file.close)
            results.files.append(path)

            def write(moment: Moment) -> None:
                file.write(moment.state, moment.time, moment.step)
                results._times.append(moment.time)

            writers.append(Every(output.trajectory_interval_ps, write))
        return log.write, writers

    def _conclude(self, results: Results, prepared: float, wall: float, computing: list[float]) -> None:
        results.summary = summarise(
            self.system, results.samples, self.state, self._relief.steps if self._relief else 0, self.threads,
            prepared, wall, computing,
            self._interrupted, self._choices, self._stable, self._warnings, self._removed,
        )  # fmt: skip
        if self.folder is None:
            return
        from rigidmd.output.report import draw_energy, write_summary

        self._write_state("final.npz", self.state)
        results.files.append(self.folder / "final.npz")
        if self.scene.output.figure and len(results.samples.rows) > 1:
            draw_energy(self.folder / "energy.png", self.system, results.samples, results.summary)
            results.files.append(self.folder / "energy.png")
        results.files.append(self.folder / "summary.json")
        results.summary["files"] = [str(path) for path in results.files]
        write_summary(self.folder / "summary.json", results.summary)

    def _explain(self, error: SimulationError, dt: float) -> str:
        states = [("", self.state)]
        if self._last_good is not None:
            states.append((f"at step {self._last_good[0]}, ", self._last_good[2]))
        return watch.explained(self.system, error, states, dt, self._stable.get(self._stage))

    def _write_state(self, name: str, state: State) -> None:
        write_state(self.folder / name, self.system.saved(state))

    def _save(self) -> str:
        if self.folder is None or self._last_good is None:
            return ""
        step, time, state = self._last_good
        self._write_state(LAST_GOOD_STATE, state)
        return f". Last good state, of step {step} ({time:g} ps): {self.folder / LAST_GOOD_STATE}"

    def introduction(self) -> str:
        """What is about to run."""
        system, asked = self.system, self.scene.threads or 0
        more = f" (the scene asks for {asked}; this machine has no more)" if asked > self.threads else ""
        first = (
            f"{self.scene.name}: {len(system.model.species)} molecules, {len(system.sites.molecule)} sites, "
            f"{system.freedom.total} degrees of freedom; {self.threads} threads{more}"
        )
        return "\n".join([first, *(f"  {note}" for note in system.notes)])

    def conclusion(self, results: Results) -> str:
        """The summary as a person reads it."""
        from rigidmd.output.report import summary_text

        return summary_text(results.summary)

    def start_energy(self, size: float, unit: str, measure_accuracy: bool = False) -> dict:
        """Energies, virial, pressure and largest force of the start; energies in a unit of `size` u Å²/ps².

        measure_accuracy : also how far Coulomb forces are from those of a longer Ewald sum
        """
        relief = self.start()
        seen = observe(self.system, self.engine, self.state)
        force, molecule = seen.largest_force
        found = {
            "unit": unit,
            "molecules": len(self.system.model.species),
            "relief_steps": relief.steps if relief else 0,
            "notes": list(self.system.notes),
            "components": {name: energy / size for name, energy in seen.components.items()},
            "potential": seen.potential / size,
            "kinetic": seen.kinetic / size,
            "virial": float(seen.virial.trace()) / size,
            "virial_tensor": (seen.virial / size).tolist(),
            "pressure_bar": None if np.isnan(seen.pressure_bar) else seen.pressure_bar,
            "largest_force_per_A": force / size,
            "largest_force_molecule": molecule + 1,
            "meaning": meanings(self.system),
        }
        if measure_accuracy:
            error = accuracy(self.system, self.state)
            found["accuracy"] = {
                "reference": error.reference,
                "rms_force_per_A": error.force / size,
                "rms_error_per_A": error.measured / size,
                "relative": error.relative,
                "in_e2_per_A2": error.measured / COULOMB,
                "estimated_per_A": error.estimated / size,
                "largest_error_per_A": error.largest / size,
                "energy_error": error.energy / size,
            }
        return found
