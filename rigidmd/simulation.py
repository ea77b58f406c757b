"""The loop between observations: everything from a scene to its results. All steps between two looks are compiled."""

import contextlib
import signal
import threading
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np

from rigidmd.build.relief import Relief, relieve
from rigidmd.build.system import System, build
from rigidmd.dynamics.engine import Engine, NotFiniteError
from rigidmd.dynamics.schemes import SCHEMES
from rigidmd.dynamics.thermostats import NoThermostat, VelocityRescaling
from rigidmd.errors import SceneError, SimulationError
from rigidmd.forces.terms import State
from rigidmd.measure.observables import Observation, observe
from rigidmd.measure.samples import Sample, Samples
from rigidmd.measure.summary import summarise
from rigidmd.output.folder import SCENE_FILE, check_folder, make_folder
from rigidmd.scene import WITH_VELOCITIES, Scene
from rigidmd.units import BOLTZMANN, FEMTOSECOND

STREAM_THERMOSTAT = 3  # see build.system for the others
LAST_GOOD_STATE = "last_good_state.npz"


class Moment:
    """What an observer is given: where the run is, its state (read-only), and what can be measured there.

    step : steps since the start; time : ps; stage : index of the stage that led here
    """

    def __init__(self, simulation: "Simulation", step: int, time: float, stage: int, heat: float):
        self._simulation = simulation
        self.step = step
        self.time = time
        self.stage = stage
        self.heat = heat
        self.state = State(*(_read_only(array) for array in simulation.state))

    @cached_property
    def observation(self) -> Observation:
        """Energies, temperatures, pressure; evaluated at the first use and shared by all observers."""
        return observe(self._simulation.system, self._simulation.engine, self._simulation.state)

    @property
    def site_positions(self) -> np.ndarray:
        """Positions (s, 3) of all sites, lab frame, Å, as they travelled."""
        return self._simulation.system.site_positions(self.state)


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


@dataclass
class Every:
    """An observer: call `function(moment)` every `interval` ps."""

    interval: float
    function: Callable[[Moment], None]


@dataclass
class Results:
    """What a run leaves: samples as arrays, a summary, the final state, the files."""

    system: System
    state: State
    samples: Samples
    summary: dict = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    interrupted: bool = False
    _frames: tuple[list[float], list[np.ndarray]] = ((), ())

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of the samples as an array, by the name of a field of `Sample`: results["energy"]."""
        return self.samples[column]

    def universe(self):
        """The trajectory as an MDAnalysis Universe: from the files if there are any, else from memory."""
        from rigidmd.output import trajectory

        output = self.system.scene.output
        if self.files:
            by_name = {path.name: path for path in self.files}
            if output.trajectory not in by_name:
                raise ValueError("this run wrote no trajectory (output.trajectory = false)")
            return trajectory.from_files(by_name[output.topology], by_name[output.trajectory])
        return trajectory.in_memory(self.system, *self._frames)


class Simulation:
    """A scene, ready to run.

    Parameters
    ----------
    scene : what to run
    folder : where to write; None writes nothing and keeps the frames in memory
    force : replace an earlier run in that folder
    observers : `Every` objects of your own, called between steps
    say : called with a sentence when something begins that takes a moment (compiling, relieving)
    """

    def __init__(
        self,
        scene: Scene,
        folder: str | Path | None = None,
        force: bool = False,
        observers: tuple[Every, ...] | list[Every] = (),
        say: Callable[[str], None] = lambda sentence: None,
    ):
        self.scene = scene
        self.system = build(scene)
        self.threads = min(scene.threads or numba.config.NUMBA_NUM_THREADS, numba.config.NUMBA_NUM_THREADS)
        self._folder = None if folder is None else Path(folder)
        self._force = force
        self._observers = list(observers)
        self._say = say
        self._reset()

    def run(self, progress: bool = False) -> Results:
        """Run all stages. Raises OutputError before anything is computed, SimulationError when numbers go bad."""
        scene_file = Path(self.scene.source)
        inputs = [*self.scene.inputs.values(), *([scene_file] if scene_file.is_file() else [])]
        if self._folder is not None:
            check_folder(self._folder, self._force, inputs)
        self._reset()
        results = Results(self.system, self.state, Samples())
        began = clock.perf_counter()
        relief = self._prepare()
        prepared = clock.perf_counter() - began
        if self._folder is not None:
            make_folder(self._folder, self._force, self._file_names(), inputs)
        with contextlib.ExitStack() as stack:
            log, writers = self._writers(stack, results)
            sampler = Every(self.scene.output.log_interval_ps, self._sampler(results.samples, log))
            observers = [sampler, *writers, *self._observers]
            stack.enter_context(self._stops_at_ctrl_c())
            began = clock.perf_counter()
            try:
                computing = self._run_stages(observers, results, progress)
            except NotFiniteError as error:
                raise self._explain(error) from None
            wall = clock.perf_counter() - began
        results.interrupted = self._interrupted
        results.summary = summarise(
            self.system, results.samples, self.state, relief, self.threads, prepared, wall, computing, self._interrupted
        )
        if self._folder is not None:
            self._finish(results)
        return results

    def _reset(self) -> None:
        """Back to the start: every run of a simulation is the same run."""
        self.engine = Engine(self.system.model, self.system.terms)
        self.state = self.system.state.copy()
        self._interrupted = False
        numba.set_num_threads(self.threads)

    def _file_names(self) -> list[str]:
        """Every file that `run` may write."""
        from rigidmd.output.scene_file import input_names

        output = self.scene.output
        names = [SCENE_FILE, output.topology, "log.csv", "final.npz", "energy.png", "summary.json", LAST_GOOD_STATE]
        return [*names, *input_names(self.scene).values(), *([output.trajectory] if output.trajectory else [])]

    def start(self) -> tuple[Observation, Relief | None]:
        """The moment before the first step: what `run` starts from, measured, and the relief it took to get there."""
        self._reset()
        relief = self._prepare()
        return observe(self.system, self.engine, self.state), relief

    def _prepare(self) -> Relief | None:
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
            self.engine.advance(self.state, SCHEMES["velocity_verlet"], 0.0, 0, self._thermostat(k))
        self.engine.forget()
        return relief

    def _thermostat(self, k: int) -> NamedTuple:
        stage = self.scene.stages[k]
        if stage.ensemble == "nve":
            return NoThermostat()
        seed = np.random.SeedSequence([self.scene.seed, STREAM_THERMOSTAT, k])
        return VelocityRescaling(
            BOLTZMANN * stage.temperature_K,
            stage.thermostat_time_ps,
            self.system.freedom.total,
            np.random.Generator(np.random.Philox(seed)),
            np.zeros(1),
        )

    def _run_stages(self, observers: list[Every], results: Results, progress: bool) -> list[float]:
        """Advance through all stages; seconds of computing in each."""
        computing = []
        step, time = 0, 0.0
        with _bar(self.scene, progress) as bar:
            self._show(observers, Moment(self, 0, 0.0, 0, 0.0), [True] * len(observers))
            for k, stage in enumerate(self.scene.stages):
                dt = stage.timestep_fs * FEMTOSECOND
                scheme, thermostat = SCHEMES[stage.integrator], self._thermostat(k)
                intervals = [max(1, round(observer.interval / dt)) for observer in observers]
                seconds, done = 0.0, 0
                while done < stage.steps and not self._interrupted:
                    to = min([stage.steps, *((done // interval + 1) * interval for interval in intervals)])
                    began = clock.perf_counter()
                    self.engine.advance(self.state, scheme, dt, to - done, thermostat)
                    seconds += clock.perf_counter() - began
                    if not all(np.isfinite(array).all() for array in self.state):
                        raise NotFiniteError(self.state)
                    done = to
                    heat = float(thermostat.heat[0]) if isinstance(thermostat, VelocityRescaling) else 0.0
                    moment = Moment(self, step + done, time + done * dt, k, heat)
                    last = done == stage.steps or self._interrupted
                    due = [done % interval == 0 for interval in intervals]
                    due[0] = due[0] or last  # the log always has the end of a stage
                    self._show(observers, moment, due)
                    bar.update(stage.timestep_fs * FEMTOSECOND * (moment.step - step - bar.done_in_stage))
                    bar.done_in_stage = moment.step - step
                bar.done_in_stage = 0
                computing.append(seconds)
                step, time = step + done, time + done * dt
                if self._interrupted:
                    break
        return computing

    @staticmethod
    def _show(observers: list[Every], moment: Moment, due: list[bool]) -> None:
        for observer, now in zip(observers, due, strict=True):
            if now:
                observer.function(moment)

    def _sampler(self, samples: Samples, log: Callable[[Sample], None]) -> Callable[[Moment], None]:
        """An observer that turns moments into samples, logs them, and keeps the last good state."""
        origin = {}

        def sample(moment: Moment) -> None:
            seen = moment.observation
            conserved = seen.energy - moment.heat
            if moment.stage not in origin:  # the stage began where the last sample was taken
                origin[moment.stage] = samples.rows[-1].energy if samples.rows else conserved
            samples.rows.append(
                Sample(
                    moment.step,
                    moment.time,
                    moment.stage,
                    self.scene.stages[moment.stage].label,
                    seen.potential,
                    seen.kinetic,
                    seen.energy,
                    seen.temperature,
                    seen.temperature_translation,
                    seen.temperature_rotation,
                    seen.pressure_bar,
                    conserved,
                    conserved - origin[moment.stage],
                    float(np.linalg.norm(seen.momentum)),
                    seen.orthogonality,
                )
            )
            log(samples.rows[-1])
            self._last_good = (moment.step, moment.time, self.state.copy())

        return sample

    def _writers(self, stack: contextlib.ExitStack, results: Results) -> tuple[Callable[[Sample], None], list[Every]]:
        """What logs a sample, and the observers that write frames, or keep them where there is no folder."""
        output = self.scene.output
        wrapped = output.positions == "wrapped"
        if self._folder is None:
            times, frames = [], []
            results._frames = (times, frames)

            def keep(moment: Moment) -> None:
                times.append(moment.time)
                frames.append(self.system.site_positions(moment.state, wrapped).astype(np.float32))

            return lambda sample: None, [Every(output.trajectory_interval_ps, keep)] if output.trajectory else []
        from rigidmd.output.log import Log
        from rigidmd.output.scene_file import write_scene
        from rigidmd.output.trajectory import TrajectoryFile, write_topology

        write_scene(self._folder, self.scene, self.system)
        write_topology(self._folder / output.topology, self.system, self.state, wrapped)
        log = Log(self._folder / "log.csv", self.system.space.volume, self.system.density)
        stack.callback(log.close)
        results.files += [self._folder / name for name in (SCENE_FILE, output.topology, "log.csv")]
        writers = []
        if output.trajectory:
            path = self._folder / output.trajectory
            velocities = path.suffix in WITH_VELOCITIES if output.velocities is None else output.velocities
            file = TrajectoryFile(path, self.system, output.trajectory_interval_ps, velocities, wrapped)
            stack.callback(file.close)
            results.files.append(path)
            writers.append(
                Every(output.trajectory_interval_ps, lambda moment: file.write(moment.state, moment.time, moment.step))
            )
        return log.write, writers

    def _finish(self, results: Results) -> None:
        from rigidmd.output.report import draw_energy, write_summary
        from rigidmd.output.state import write_state

        write_state(self._folder / "final.npz", self.system, self.state)
        results.files.append(self._folder / "final.npz")
        if self.scene.output.figure and len(results.samples.rows) > 1:
            draw_energy(self._folder / "energy.png", self.system, results.samples, results.summary)
            results.files.append(self._folder / "energy.png")
        results.files.append(self._folder / "summary.json")
        results.summary["files"] = [str(path) for path in results.files]
        write_summary(self._folder / "summary.json", results.summary)

    def _explain(self, error: NotFiniteError) -> SimulationError:
        """When, where and what to do; the last good state is saved."""
        step, time, state = self._last_good
        where = ""
        if self._folder is not None:
            from rigidmd.output.state import write_state

            write_state(self._folder / LAST_GOOD_STATE, self.system, state)
            where = f" Last good state: {self._folder / LAST_GOOD_STATE}"
        return SimulationError(
            f"after step {step} ({time:g} ps): {error}. Molecules overlap or timestep_fs is too long; "
            f"try a shorter one, or an nvt stage first.{where}"
        )

    @contextlib.contextmanager
    def _stops_at_ctrl_c(self) -> Iterator[None]:
        """The first Ctrl-C ends the run at the next observation, the second at once."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(signum, frame):
            if self._interrupted:
                raise KeyboardInterrupt
            self._interrupted = True

        before = signal.signal(signal.SIGINT, stop)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _bar(scene: Scene, progress: bool):
    """A progress bar in ps; only where asked for, and only on a terminal."""
    from tqdm import tqdm

    total = sum(stage.steps * stage.timestep_fs * FEMTOSECOND for stage in scene.stages)
    form = "{l_bar}{bar}| {n:.1f}/{total:.1f} ps [{elapsed}<{remaining}]"
    with tqdm(total=total, disable=None if progress else True, bar_format=form, leave=False, mininterval=0.2) as bar:
        bar.done_in_stage = 0
        yield bar


def start_energy(scene: Scene, size: float, unit: str) -> dict:
    """Energies, virial, pressure and largest force of a scene's start; energies in a unit of `size` u Å²/ps²."""
    simulation = Simulation(scene)
    seen, relief = simulation.start()
    force, molecule = seen.largest_force
    return {
        "unit": unit,
        "molecules": len(simulation.system.model.species),
        "relief_steps": relief.steps if relief else 0,
        "components": {name: energy / size for name, energy in seen.components.items()},
        "potential": seen.potential / size,
        "kinetic": seen.kinetic / size,
        "virial": float(seen.virial.trace()) / size,
        "virial_tensor": (seen.virial / size).tolist(),
        "pressure_bar": None if np.isnan(seen.pressure_bar) else seen.pressure_bar,
        "largest_force_per_A": force / size,
        "largest_force_molecule": molecule + 1,
    }
