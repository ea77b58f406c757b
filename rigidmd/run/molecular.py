"""Runs of molecules: removal of overlaps, stages of all ensembles, samples."""

from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from math import isfinite, nan
from typing import TYPE_CHECKING

import numpy as np
from pydantic import PositiveFloat

from rigidmd.assemble.build import build, integrator_of_stage
from rigidmd.assemble.harmonic import stable_angle
from rigidmd.assemble.start import rest_errors
from rigidmd.assemble.time_step import accuracy_warning, sentences_on_steps
from rigidmd.compile.machine import usable_threads
from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import NOW, ORIGIN, REMOVED, State, state_of
from rigidmd.core.toml import Json
from rigidmd.dynamics.model import remove_momentum
from rigidmd.dynamics.observables import largest_values
from rigidmd.engines.observables import Observation, describe_quantities, observe
from rigidmd.engines.protocol import Engine, NotFiniteError
from rigidmd.engines.samples import Samples
from rigidmd.engines.system import System
from rigidmd.errors import SceneError, SimulationError, StructureError
from rigidmd.features import acting_on, used_by
from rigidmd.formats import format_of
from rigidmd.formats.through_ase import atoms_of_system
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.io.progress import progress_of
from rigidmd.io.run_files import columns
from rigidmd.io.scene_file import input_names
from rigidmd.run import checks
from rigidmd.run.force_errors import coulomb_errors
from rigidmd.run.mean_box import scale_to_mean_box
from rigidmd.run.minimise import (
    Enthalpy,
    OverlapRemoval,
    minimise,
    precision_of_minimisation,
    remove_overlaps,
)
from rigidmd.run.molecular_observers import FinalState, LogFile, PressureTensor, Sampler, StepWatch
from rigidmd.run.observers import Frames, Moment, Observer, SceneFile
from rigidmd.run.part import RunPart
from rigidmd.run.report import short_summary, summary_text
from rigidmd.run.resume import Count, RunRecord, check_same_scene, plain, state_from
from rigidmd.run.schedule import Segment, interruptible
from rigidmd.run.stable_step import DIRECTIONS, SMALL_SYSTEM, stiffest_mode
from rigidmd.run.summary import Minimum, describe_minimum, summarise
from rigidmd.scene import MolecularScene
from rigidmd.scene.stage import Stage
from rigidmd.units import BOLTZMANN, FEMTOSECOND

if TYPE_CHECKING:
    import ase

    from rigidmd.run.simulation import Simulation


@dataclass
class MolecularRecord(RunRecord):
    """The record of a run of molecules. Dictionaries have the indices of stages."""

    stages: tuple[Stage, ...] = ()  # with the integrators that were chosen
    precision_reason: str = ""  # where the scene of the start has precision = "auto"
    removal: OverlapRemoval | None = None
    #: Integrators and steps that were chosen, with the reasons
    choices: dict[Count, str] = field(default_factory=dict)
    stable: dict[Count, PositiveFloat] = field(default_factory=dict)  # the longest stable step, ps
    #: Moves of the box, tried and accepted
    moves: dict[Count, tuple[Count, Count]] = field(default_factory=dict)
    minima: dict[Count, Minimum] = field(default_factory=dict)


#: Sites that fill a smaller fraction of the box fit into it: as spheres of diameter sigma they fill
#: 0.4 to 0.55 of a liquid.
LOOSE = 0.5
#: States between the last good one and a failure that are searched for its cause.
REPLAYED = 20


class MolecularRun(RunPart[System, MolecularRecord, Samples]):
    """The part of a simulation of molecules."""

    record_type = MolecularRecord

    def __init__(
        self,
        simulation: "Simulation",
        scene: MolecularScene,
        forces: object = None,
        thermostat: object = None,
    ):
        super().__init__(simulation)
        user_forces = (
            forces if isinstance(forces, Sequence) and not hasattr(forces, "_fields") else (forces,)
        )
        self._start = build(scene.with_user_code(() if forces is None else user_forces, thermostat))
        if errors := rest_errors(self._start):
            raise SceneError(scene.source, errors)
        self.reset()

    @property
    def scene(self) -> MolecularScene:
        return self.system.scene

    @property
    def threads(self) -> int:
        return usable_threads(self.scene.threads)

    def start_from(self, state: State) -> None:
        if errors := self._start.state_errors(state):
            raise StructureError("start_from", errors)
        self._start = replace(self._start, state=state_of(*state[:5]), from_lattice=False)
        self.reset()

    def take_threads(self, count: int) -> None:
        self._start = replace(
            self._start, scene=self._start.scene.model_copy(update={"threads": count})
        )
        self.reset()

    def atoms(self) -> "ase.Atoms":
        return atoms_of_system(
            self.system, self.state, wrapped=self.scene.output.positions == "wrapped"
        )

    def start(self) -> OverlapRemoval | None:
        """Go to the state before the first step, from which a run starts. Returns the removal of
        overlaps."""
        self.reset()
        with interruptible():
            self._remove_overlaps()
        return self.record.removal

    def settle(self) -> State:
        """Go to the state after removal of overlaps and the minimisations that come first, from
        which time passes."""
        self.start()
        for k, stage in enumerate(self.scene.stages):
            if not stage.is_minimisation:
                break
            self.enter_segment(k)
            self._minimise(progress=False)
        return self.state

    def reset(self) -> None:
        super().reset()
        self.record.precision_reason = self._start.precision_reason
        self._is_sampled = False  # whether `_sampler` belongs to the current state
        self._set_stages(self._start.scene.stages)  # an earlier run may have chosen an integrator
        self.engine = self.system.engine()
        self.state = self.system.state.copy()

    def _set_stages(self, stages: Iterable[Stage]) -> None:
        """Set the stages of the run, some of which may have been chosen by pilot runs."""
        self.record.stages = tuple(stages)
        self.system = replace(
            self._start, scene=self._start.scene.model_copy(update={"stages": self.record.stages})
        )
        # the integrator of a stage with its thermostat and barostat, made once
        self._integrator = cache(partial(integrator_of_stage, self.system))

    def prepare(self) -> None:
        """Remove overlaps, and compile the steps, or compare the start with an external engine."""
        if program := self.scene.engine.program:
            feature = program.feature.load()
            # first: the error of a missing program comes before compilation
            other = feature.engine(self.system, 0)
            try:
                self._remove_overlaps()
                feature.compare_start(self.system, self.state, other)
            finally:
                other.close()
        else:
            self._remove_overlaps()
            with self._explained():
                for k, stage in enumerate(self.scene.stages):
                    if stage.is_minimisation:
                        self._compile_stage(k)
                    elif not stage.is_auto:
                        method = self._integrator(k)
                        self.engine.advance(self._state_for(method), method, 0.0, 0)
        self.engine.forget()
        for feature in acting_on(self.scene):
            for note in feature.notes_on_start(self.system, self.state):
                self.simulation._note(note)
        for warning in sentences_on_steps(self.scene, accuracy_warning):
            self.simulation._note(warning)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Errors of features as errors of the scene."""
        with ExitStack() as stack:
            for feature in acting_on(self.scene):
                stack.enter_context(feature.explained(self.system))
            yield

    def _remove_overlaps(self) -> None:
        """Compile the forces, and remove overlaps of a lattice."""
        system = self.system
        scene = self.scene
        first = self.scene.stages[0]
        for feature in acting_on(scene):
            for note in feature.check_start(system, self.state):
                self.simulation._note(note)
        with self._explained():
            _, tallies = self.engine.evaluate(self.state)
        if not all(np.isfinite(tally.energy) for tally in tallies.values()):
            raise SceneError(
                scene.source,
                ["the start has no finite energy: sites of different molecules coincide"],
            )
        # At 0 K the scale is the deepest well between two sites.
        deepest = max((m.epsilon.max() for m in system.species), default=0.0)
        thermal = BOLTZMANN * (scene.start.temperature_K or 0.0) or deepest
        if system.from_lattice and not first.is_minimisation and thermal > 0:
            dt = first.step
            removal = self.record.removal = remove_overlaps(
                system, self.engine, self.state, thermal, dt
            )
            if removal.excess > 1:
                raise SceneError(scene.source, [self._why_too_strong(removal, thermal, dt)])
        for feature in acting_on(scene):
            feature.check_forces(system, self.state)
        self.engine.forget()

    def _why_too_strong(self, removal: OverlapRemoval, thermal: float, dt: float) -> str:
        """Why forces are too strong for the first step after a removal of overlaps, with advice."""
        system = self.system
        fields = {name: system.terms[name] for name in system.external}
        if fields:
            load, _ = system.engine_of(fields, "double").evaluate(self.state)
            if (excess := float(checks.kicks(system.model, load, thermal, dt).max())) > 1:
                return (
                    f"timestep_fs of the first stage is too long for {' and '.join(fields)}: the"
                    f" first time step would change a momentum by {excess:.2g} times its thermal"
                    " size. Shorten it, or weaken the field"
                )
        kick = (
            f"after {removal.steps} steps of overlap removal the first time step would change a"
            f" momentum by {removal.excess:.2g} times its thermal size"
        )
        diameters = system.of_sites(lambda m: np.where(m.epsilon > 0, m.sigma, 0.0))
        packed = np.pi / 6 * float((diameters**3).sum()) / self.state.volume
        overlapping = checks.most_overlapping_pair(system, self.state, None)
        if overlapping is None or packed < LOOSE:
            return (
                f"{kick}, though the molecules fit into the box: for the forces between them"
                f" {thermal / BOLTZMANN:.3g} K are too low, or {dt / FEMTOSECOND:.3g} fs too long."
                " Are charges and epsilon right? If so, begin with a stage with ensemble ="
                " 'minimise', raise start.temperature_K or shorten timestep_fs of the first stage"
            )
        return (
            f"the molecules cannot be packed at {system.density:.3g} g/cm³ without overlap: {kick}."
            " Lower the density, enlarge the box or shorten timestep_fs of the first stage"
        )

    def _compile_stage(self, k: int) -> None:
        """Compile what stage k runs, so that its computing time does not contain it."""
        stage = self.scene.stages[k]
        state = self.state
        if stage.is_minimisation:
            precision = precision_of_minimisation(self.system, stage)
            enthalpy = Enthalpy(self.system, stage, state, precision)
            point = enthalpy.at(state.copy())
            enthalpy.moved(point.state, np.zeros(len(point.gradient)))
        elif not self.scene.engine.is_external:
            method = self._integrator(k)
            self.system.engine().advance(self._state_for(method).copy(), method, 0.0, 0)

    def _state_for(self, method: Scheme | Solver) -> State:
        """The current state, without copies, with the additional variables of an integrator."""
        return self.state._replace(extra_variables=self.engine.variables(self.state, method))

    def _engine_of(self, k: int) -> Engine:
        """The engine of stage k. Minimisations are always by rigidmd."""
        program = self.scene.engine.program
        if program is None or self.scene.stages[k].is_minimisation:
            return self.system.engine()
        other = program.feature.load().engine(self.system, k)
        self.engine_version = other.version
        return other

    def restore(self, kept: Checkpoint) -> None:
        record = self.record
        before = record.scene["stages"]
        k = record.position.segment
        # integrators that were chosen stand in the scene of the folder
        decided = [
            then if now.is_auto else plain(chosen)
            for now, then, chosen in zip(self.scene.stages, before, record.stages, strict=False)
        ]
        step = int(kept.arrays["state/step"][NOW])
        check_same_scene(
            self.scene, record.scene | {"stages": decided or before}, record.inputs, step
        )
        last = record.stages[-1].model_copy(
            update={"duration_ps": self.scene.stages[-1].duration_ps}
        )
        self._set_stages((*record.stages[:-1], last))
        method = self.reenter_segment(k).method
        self.engine = self._engine_of(k)
        start = self.system.state
        like = start._replace(extra_variables=self.engine.variables(start, method))
        self.state = state_from(kept.of("state").arrays, like)
        self.engine.recall(self.state, kept.of("engine").arrays)
        self._compile_stage(k)

    def reenter_segment(self, k: int) -> Segment:
        stage = self.scene.stages[k]
        step = self.scene.stages[k].step
        for force in self.system.python_forces.values():
            force.may_diverge = stage.in_trajectories
        if stage.is_minimisation:
            return Segment(
                stage.scheme, step, 0, action=None if k in self.record.minima else self._minimise
            )
        return Segment(self._integrator(k), step, stage.steps, together=stage.steps_together)

    def durations(self) -> list[float]:
        return [stage.duration for stage in self.scene.stages]

    def enter_segment(self, k: int) -> Segment:
        record = self.record
        record.moves[record.position.segment] = self.engine.moves or (0, 0)
        record.position.segment = k
        was_auto = self.scene.stages[k].is_auto
        moves = not self.scene.stages[k].is_minimisation
        if self.scene.stages[k].volume:
            scale_to_mean_box(self.system, self.state, self.samples(), k)
        if was_auto:
            self._choose(k)
            self._compile_stage(k)
        if moves:
            self._estimate(k)
        # Pilot runs change the neighbour lists. With new lists at every stage the resolved scene
        # repeats the run to the bit. The lists of the start, if nothing has moved since, are what
        # new ones would be.
        as_at_start = k == 0 and moves and not was_auto and not self.scene.engine.is_external
        if not as_at_start or (record.removal and record.removal.steps):
            self.engine = self._engine_of(k)
        segment = self.reenter_segment(k)
        self.state = self._state_for(segment.method)
        self.state.begin_segment()
        before = [other for other in range(k) if not self.scene.stages[other].is_minimisation]
        keeps = self.system.keeps_momentum_in
        if moves and before and keeps(k) and not keeps(before[-1]):
            self.state.energy_ledger[REMOVED] -= remove_momentum(
                self.system.model, self.state.velocity
            )
        return segment

    def _minimise(self, progress: bool | None) -> None:
        """Run the current stage, a minimisation, with a warning if it does not converge."""
        k = self.record.position.segment
        stage = self.scene.stages[k]
        with progress_of(
            stage.max_iterations, "iterations", shown=progress, spot=self.simulation._spot
        ) as bar:

            def advance(count: float) -> None:
                if bar.n:
                    bar.update(count)
                else:  # the first iteration compiles
                    bar.unpause()
                    bar.skip(count)

            minimum = minimise(self.system, self.state, stage, self.simulation._must_end, advance)
        self.engine.forget()
        self.record.minima[k] = minimum
        if not minimum.converged:
            self.simulation._note(f"stages.{k}: {describe_minimum(minimum, stage)}")

    def _estimate(self, k: int) -> None:
        """Estimate the longest stable step (ps) of stage k at its start, and warn if its step is
        longer."""
        stage = self.scene.stages[k]
        evaluations = stage.steps * stage.scheme.force_evaluations
        is_cheap = len(self.system.model.species) <= SMALL_SYSTEM or evaluations >= 100 * DIRECTIONS
        if not self.scene.watch.stable_step or not is_cheap:
            return
        mode = stiffest_mode(
            self.system, self.state, self.engine if self.engine.is_repeatable else None
        )
        if mode is None:
            return
        stable = self.record.stable[k] = stable_angle(stage.scheme) / mode.rate
        if stage.step > stable:
            self.simulation._note(
                f"stages.{k}: timestep_fs = {stage.step_fs:g} is longer than what is stable:"
                " the stiffest motion at its start, of"
                f" {checks.molecule_label(self.system, mode.molecule)}, has a period of"
                f" {2 * np.pi / mode.rate / FEMTOSECOND:.3g} fs, which {stage.integrator} follows"
                f" up to {stable / FEMTOSECOND:.3g} fs"
            )

    def _choose(self, k: int) -> None:
        """Choose integrator and step of a stage by pilot runs from the current state, and set them
        in the scene."""
        from rigidmd.run.pilot.stages import choose_for_stage

        self.simulation._announce("choosing integrator and step by pilot runs")
        try:
            decided, reason = choose_for_stage(self.system, self.state, k)
        except NotFiniteError as error:
            raise SimulationError(
                f"a pilot run of integrator = 'auto' diverges: {error}. Let a stage with a"
                " thermostat come first, or set integrator and timestep_fs"
            ) from None
        self.record.choices[k] = f"{decided.integrator} at {decided.step_fs:g} fs chosen: {reason}"
        stages = self.record.stages
        self._set_stages((*stages[:k], decided, *stages[k + 1 :]))
        for sentence in self.scene.rounded_times([k]):
            self.simulation._note(sentence)
        if self.simulation.folder is not None:
            self.simulation._write_scene(self.simulation.folder)

    def is_replaced(self, moment: Moment) -> bool:
        stages = self.scene.stages
        k = moment.stage
        if stages[k].is_minimisation and k not in self.record.minima:
            return True  # the start
        ended = moment.step == sum(stage.steps for stage in stages[: k + 1])
        # an interrupted minimisation is repeated by a run that resumes, which also has another
        # frame for it
        ends_here = stages[k].is_minimisation and self.simulation._is_interrupted
        return ended and not ends_here and k + 1 < len(stages) and stages[k + 1].is_minimisation

    def is_finite(self) -> bool:
        state = self.state
        extent = self.engine.extent(self.state) or largest_values(self.state)
        return all(
            map(
                isfinite,
                [*extent[:4], *state.energy_ledger.tolist(), *state.extra_variables.tolist()],
            )
        )

    def observe(self, moment: Moment) -> Observation:
        """The observation at a moment. The drift of its stage is counted from the last sample
        before the stage."""
        stage = self.scene.stages[moment.stage]
        correction = 0.0
        # other programs give the velocities where their thermostats act
        is_given = stage.has_thermostat and self.scene.engine.is_external
        if not (stage.is_minimisation or stage.is_auto or is_given):
            step = stage.step
            correction = self._integrator(moment.stage).kinetic_correction * step**2
        # an external engine may not report the heat of its thermostat
        conserves = not stage.is_minimisation and self.engine.conserves_energy
        sums = self.engine.extension_sums
        samples = self._sampler.samples
        if sums is not None and len(samples) and samples.row(-1).stage == moment.stage:
            sums -= self._sampler.trajectories
        return observe(
            self.system,
            self.engine,
            self.state,
            moment.stage,
            time=moment.time,
            moved=True,
            extension_sums=sums,
            origin=self._sampler.origin(moment.stage) if conserves else nan,
            correction=correction,
        )

    def observe_now(self) -> Observation:
        with interruptible(), self._explained():
            if not self._is_sampled:
                return observe(self.system, self.engine, self.state)
            now = self.state
            position = self.record.position
            moment = Moment(
                self.simulation, int(now.step[NOW]), float(now.time[NOW]), position.segment
            )
            return self.observe(moment)

    def energy_now(self) -> float:
        return self.observe_now().energy

    def forces_now(self) -> np.ndarray:
        return self.observe_now().force

    def default_observers(self) -> list[Observer]:
        output = self.scene.output
        interval = self.scene.output.log_interval_ps
        check = checks.StepCheck(self.system, self.scene.watch)
        self._sampler, self._is_sampled = Sampler(self.simulation, interval, check), True
        # external engines check their steps themselves
        watch = [] if self.scene.engine.is_external else [StepWatch(self.simulation, check)]
        files: list[Observer] = []
        if output.trajectory:
            velocities = bool(output.velocities)
            wrapped = output.positions == "wrapped"
            files = [
                Frames(
                    output.trajectory_interval_ps,
                    output.topology,
                    output.trajectory,
                    velocities,
                    wrapped,
                )
            ]
        if output.pressure_tensor_interval_ps:
            files.append(PressureTensor(output.pressure_tensor_interval_ps))
        if self.simulation.folder is not None:
            names = input_names(self.scene)
            files = [
                SceneFile(names.values()),
                *files,
                LogFile(interval, columns(self.system.quantities, tensor=output.pressure_tensor)),
                FinalState(),
            ]
            for row in used_by(self.scene):
                files += row.load().observers(self.system) if row.is_installed else []
        return [*files, self._sampler, *watch]

    def samples(self) -> Samples:
        return self._sampler.samples

    def summary(self, samples: Samples, preparing: float, wall: float) -> Json:
        self.record.moves[self.record.position.segment] = self.engine.moves or (0, 0)
        return summarise(
            self.system,
            self.record,
            samples,
            self.state,
            preparing,
            wall,
            interrupted=self.simulation._is_interrupted,
        )

    def summary_text(self, summary: Json, known: Container[str], *, is_short: bool) -> str:
        text_of = short_summary if is_short else summary_text
        return text_of(summary, known, self.system.quantities)

    def explain(self, error: SimulationError) -> str:
        stable = self.record.stable.get(self.record.position.segment)
        return checks.explain(self.system, error, self._states_to_search(), self.segment.dt, stable)

    def _states_to_search(self) -> Iterator[tuple[str, State]]:
        """States of a run that failed, with words for their times: now. The last good one. States
        in between, which are computed again if this is cheap, because a collapse has moved
        everything by now."""
        yield "", self.state
        if (good := self._sampler.last_good) is None:
            return
        first = int(good.step[NOW])
        system = self.system
        method = self.segment.method
        yield f"at step {first}, ", good
        steps = int(self.state.step[NOW]) - first
        short = 0 < steps * len(system.model.species) <= REPLAYED * checks.MOVES_PER_CHECK
        if (
            short
            and self.engine.is_repeatable
            and not (self.segment.action or system.python_forces)
        ):
            state = good.copy()
            if state.step[ORIGIN] != self.state.step[ORIGIN]:  # it is the end of the stage before
                scale_to_mean_box(system, state, self.samples(), self.record.position.segment)
                state = self.engine.begin(state, method)
                state.begin_segment()
            self.engine.forget()
            for to in sorted({first + steps * k // REPLAYED for k in range(1, REPLAYED)} - {first}):
                try:
                    self.engine.advance(state, method, self.segment.dt, to)
                except SimulationError:
                    return
                yield f"at step {to}, ", state

    @property
    def headline(self) -> str:
        system = self.system
        asked = self.scene.threads or 0
        if asked > self.threads:
            hint = f" (the scene requests {asked}; this machine has no more)"
        else:
            hint = ""
        return (
            f"{self.scene.name}: {len(system.model.species)} molecules, {system.site_count} sites, "
            f"{system.last_freedom.total} degrees of freedom; {self.threads} threads{hint}"
        )

    @property
    def _is_crystal(self) -> bool:
        """Whether the start is a crystal that only interactions of its molecules hold: from a CIF
        or a repeated cell, without fields and user-defined forces."""
        scene = self.scene
        structure = self.scene.structure
        if (
            structure is None
            or not scene.box.periodic
            or scene.fields.entries
            or self.system.user_terms
        ):
            return False
        if any(entry.frozen for entry in scene.molecules):  # which do not interact with each other
            return False
        form = format_of(structure.file)
        return (form is not None and form.crystals) or structure.repeat != (1, 1, 1)

    def start_energy(self, size: float, unit: str, *, measure_accuracy: bool = False) -> dict:
        """Energies, virial, pressure and largest force at the start. Energies in a unit of `size` u
        Å²/ps².

        measure_accuracy : also the errors of Coulomb forces against a more accurate Ewald sum
        """
        if self._start.precision_reason:  # precision = "auto" is for runs
            self._start = replace(
                self._start, scene=self._start.scene.model_copy(update={"precision": "double"})
            )
        removal = self.start()
        moving = [k for k, stage in enumerate(self.scene.stages) if not stage.is_minimisation]
        observation = observe(
            self.system, self._engine_of(moving[0] if moving else 0), self.state, energy_unit=1.0
        )
        forces = np.linalg.norm(observation.load.force, axis=1)
        n = len(self.system.model.species)
        meaning = describe_quantities(self.system)
        lattice_energy = observation.potential / size / n if self._is_crystal else None
        if lattice_energy is not None:
            meaning["lattice_energy"] = (
                "the potential energy per molecule at the positions of the structure file, relative"
                " to the same rigid molecules far from each other; static: without zero-point and"
                " thermal energy"
            )
        energies = {
            "unit": unit,
            "molecules": n,
            "overlap_removal_steps": removal.steps if removal else 0,
            "before_minimisation": self.scene.stages[0].is_minimisation,
            "notes": [*self.system.notes, *self.system.warnings],
            "components": {name: energy / size for name, energy in observation.components.items()},
            "potential": observation.potential / size,
            "potential_per_molecule": observation.potential / size / n,
            "lattice_energy_per_molecule": lattice_energy,
            "kinetic": observation.kinetic / size,
            "virial": float(observation.virial.trace()) / size,
            "virial_tensor": (observation.virial / size).tolist(),
            "pressure_bar": None if np.isnan(observation.pressure) else observation.pressure,
            "largest_force_per_A": float(forces.max()) / size,
            "largest_force_molecule": int(forces.argmax()) + 1,
            "meaning": meaning,
        }
        if measure_accuracy:
            energies["accuracy"] = coulomb_errors(self.system, self.state, size)
        return energies
