"""The scene of molecules: species, box, forces, stages, output."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple

from pydantic import Field, PrivateAttr, Strict

from rigidmd.core.plain_text import distinct
from rigidmd.core.toml import Json
from rigidmd.errors import SceneError, option
from rigidmd.formats import BY_EXTENSION, TOPOLOGY, TRAJECTORY, format_of, topologies, written
from rigidmd.scene.base import Scene, file_name, is_inside
from rigidmd.scene.engine import EngineChoice
from rigidmd.scene.ensemble_methods import default_interval
from rigidmd.scene.fields import Fields, field_errors
from rigidmd.scene.forces import Forces
from rigidmd.scene.models import SIZES
from rigidmd.scene.of_features import CouplingKeys, CouplingSettings
from rigidmd.scene.species import SPECIES_FILES, Box, Molecules, Start, Structure
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import (
    MOST_STEPS,
    MOST_TABLES,
    Count,
    Flag,
    Limit,
    LimitOfEnergy,
    LimitOfRounding,
    LimitOfVolume,
    Section,
)


class UserForce:
    """A force of Python for a scene, see `MolecularScene.with_user_code`."""


class UserCode(NamedTuple):
    """Forces and a thermostat, of which a feature makes terms."""

    forces: tuple[object, ...] = ()
    thermostat: object = None

    @property
    def names(self) -> tuple[str, ...]:
        """Distinct names of all objects."""
        thermostat = () if self.thermostat is None else (f"thermostat {name_of(self.thermostat)}",)
        return (*distinct(map(name_of, self.forces)), *thermostat)


def name_of(thing: object) -> str:
    """The attribute `name` of an object, else the name of its class in snake_case."""
    named = getattr(thing, "name", None)
    if isinstance(named, str) and named:
        return re.sub(r"\W+", "_", named)
    return (
        re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(thing).__qualname__.rpartition(".")[2])
        .lower()
        .strip("_")
    )


def missing_user_code(wanted: Sequence[str], given: Sequence[str]) -> str:
    """The error message of a scene without the user code that its `from_python` lists."""
    hint = f". This has {', '.join(given)}" if given else ""
    advice = "Run it from Python with the same: Simulation(scene, forces=[...], thermostat=...)"
    return (
        f"from_python: this run had {', '.join(wanted)} from Python, which no file holds{hint}."
        f" {advice}"
    )


Interval = Annotated[float, Strict(), Field(gt=0, le=1e9)]
Minutes = Interval | Literal[False]


class RunSettings(Section):
    """Settings for all stages."""

    remove_momentum_interval_ps: Interval | Literal[False] | None = None
    """Time between removals of the total momentum, or false for never. Default: 1 ps with pme,
    because its forces do not add up to exactly zero, and with a thermostat that scales all
    velocities, because rounding errors of the momentum can then grow. Otherwise never. The removed
    energy counts as heat, as with a thermostat"""


class Output(Section):
    """Files in the folder of the run."""

    log_interval_ps: Interval = 0.1
    """Time between lines of log.csv"""
    pressure_tensor: Flag = False
    """Write the six components of the pressure into log.csv"""
    pressure_tensor_interval_ps: Interval | Literal[False] = False
    """Time between lines of pressure_tensor.csv, which a viscosity needs. For example, 0.01 ps for
    water, or false for none. Each line needs a force evaluation with the virial"""
    trajectory: Annotated[
        str | Literal[False], file_name(lambda form: form.encoder or form.writer)
    ] = TRAJECTORY
    """Trajectory file, or false for none. The extension sets the format (.xtc .trr .gsd .traj .dcd
    .nc .xyz .pdb). .gsd stores rotations and angular momenta. .traj is ASE's format and has double
    precision"""
    trajectory_interval_ps: Interval = 0.5
    """Time between frames"""
    topology: Annotated[str, file_name(lambda form: form.topology)] = TOPOLOGY
    """Topology file (.gro or .pdb) with the names and first positions that viewers need for the
    trajectory"""
    positions: Literal["wrapped", "unwrapped"] = "unwrapped"
    """unwrapped: continuous paths, for displacements. wrapped: centres of mass inside the box.
    Molecules are whole in both cases"""
    velocities: Flag | None = None
    """Write velocities. Default: true if the format can store them"""
    figures: Flag = True
    """Draw energy.png"""
    checkpoint_minutes: Minutes = 5.0
    """Wall time between checkpoints, or false for none. `rigidmd resume` continues a run from a
    checkpoint"""

    def _errors(self):
        if self.velocities and not self.can_store_velocities:
            formats = f"use a {' or '.join(written(lambda form: form.velocities))} file"
            yield (
                f"velocities = true, but {self.trajectory or 'no trajectory'} cannot store them;"
                f" {formats}"
            )
        if self.topology == self.trajectory:
            yield f"topology and trajectory are both {self.topology}. Give them different names"

    @property
    def can_store_velocities(self) -> bool:
        return bool(self.trajectory) and BY_EXTENSION[Path(self.trajectory).suffix].velocities


class Watch(Section):
    """Limits beyond which a run stops, relative to scales of the system, false switches a check
    off."""

    move: Limit = 0.25
    """Largest displacement of a molecule between two force evaluations, in units of the smallest
    site diameter"""
    turn_rad: Limit = 2.0
    """Largest rotation of a molecule between two force evaluations"""
    kick: Limit = 20.0
    """Largest change of a momentum by one kick, in units of the thermal momentum"""
    energy: LimitOfEnergy = 0.5
    """Largest change of the conserved energy, in units of the kinetic energy. It is checked over an
    nve stage, and over each thermostat_time_ps of an nvt stage"""
    volume: LimitOfVolume = 8.0
    """Largest volume of the box under a barostat, in units of the initial volume"""
    orthogonality: LimitOfRounding = 1e-9
    """Largest entry of abs(QᵀQ - 1)"""
    stable_step: Flag = True
    """Estimate the longest stable time step at the start of each stage, and warn if timestep_fs is
    longer"""


class Settings(CouplingSettings, total=False):
    """Keywords of `scene_from_atoms`: the tables and keys of a scene file except [[molecules]]."""

    name: str
    seed: int
    precision: Literal["auto", "double", "mixed"]
    threads: int
    engine: Json
    structure: Json
    box: Json
    forces: Json
    fields: Json
    start: Json
    integrators: list[Json]
    stages: list[Json]
    run: Json
    output: Json
    watch: Json


class MatterKeys(Scene):
    """The keys of what there is and what acts on it."""

    seed: Annotated[int, Strict(), Field(ge=0)] = 1
    """Seed of all random numbers"""
    precision: Literal["auto", "double", "mixed"] = "auto"
    """Arithmetic of the forces between sites. mixed: pairs in single precision, sums and motion in
    double precision. auto: mixed if the time-step error hides the error of single precision, else
    double. Minimisations with tight limits, or with a pressure, use double precision"""
    threads: Count | None = None
    """Number of threads. Default: all cores. Results do not depend on it"""
    engine: EngineChoice = EngineChoice.model_construct()
    structure: Structure | None = None
    box: Box = Box.model_construct()
    molecules: tuple[Molecules, ...] = Field(min_length=1, max_length=MOST_TABLES)
    forces: Forces = Forces.model_construct()
    fields: Fields = Fields.model_construct()


class MolecularScene(CouplingKeys, MatterKeys):
    """A scene of moving molecules."""

    _internal: ClassVar[tuple[str, ...]] = (
        *Scene._internal,
        "errors_of_steps",
        "first_moving",
        "rounded_times",
        "structure_source",
        "user_code",
        "with_user_code",
    )
    kind: ClassVar[str] = "molecules"
    subject: ClassVar[str] = "molecules"
    SIZES: ClassVar[tuple[float, float]] = SIZES

    start: Start = Start.model_construct()
    stages: tuple[Stage, ...] = Field(min_length=1, max_length=MOST_TABLES)
    run: RunSettings = RunSettings.model_construct()
    output: Output = Output.model_construct()
    watch: Watch = Watch.model_construct()
    from_python: tuple[str, ...] = Field(default=(), max_length=MOST_TABLES)
    """Names of forces and a thermostat that Python added, set by the run. Such a scene runs only
    from Python, with the same forces and thermostat"""

    _user_code: UserCode = PrivateAttr(UserCode())

    @property
    def user_code(self) -> UserCode:
        """The forces and the thermostat that Python added."""
        return self._user_code

    def with_user_code(
        self, forces: Sequence[object] = (), thermostat: object = None
    ) -> "MolecularScene":
        """The same scene with forces and a thermostat from Python, see `Simulation`.

        Raises
        ------
        SceneError
        """
        thermostat = self._user_code.thermostat if thermostat is None else thermostat
        user_code = UserCode((*self._user_code.forces, *forces), thermostat)
        if self.from_python not in ((), user_code.names):
            raise SceneError(self.source, [missing_user_code(self.from_python, user_code.names)])
        scene = self.model_copy(update={"from_python": user_code.names})
        scene._user_code = user_code
        return scene

    def with_end(self, time: float) -> "MolecularScene":
        """The same scene with a last stage that ends at a time of the run.

        Parameters
        ----------
        time : float
            End of the last stage, ps since the start of the run

        Returns
        -------
        MolecularScene
            A copy with another end

        Raises
        ------
        SceneError
            If the end cannot be set.
        """
        before = sum(stage.duration for stage in self.stages[:-1])
        last = self.stages[-1]
        if last.is_minimisation or last.ramps:
            if last.is_minimisation:
                what = "is a minimisation"
            else:
                what = "changes temperature or pressure over its duration"
            raise SceneError(
                self.source, [f"the last stage {what}: {option('until')} cannot set its end"]
            )
        if not time > before:
            raise SceneError(
                self.source,
                [f"{option('until')} {time:g} ps: the last stage begins at {before:g} ps"],
            )
        if not (time - before) / last.step < MOST_STEPS:
            raise SceneError(
                self.source,
                [f"{option('until')} {time:g} ps is more than {MOST_STEPS:g} steps away"],
            )
        stages = (*self.stages[:-1], last.model_copy(update={"duration_ps": time - before}))
        return self.model_copy(update={"stages": stages})

    @property
    def in_short(self) -> str:
        """Species, their origin and stages."""
        species = ", ".join(
            f"{entry.count or ''} {entry.label}".strip() for entry in self.molecules
        )
        origin = "" if self.structure is None else f" of {self.structure.file}"
        stages = ", ".join(
            s.label if s.is_minimisation else f"{s.label} {s.duration:g} ps" for s in self.stages
        )
        return f"{self.name}: {species}{origin}; {stages}"

    @property
    def first_moving(self) -> Stage | None:
        """The first stage that is not a minimisation, if there is one."""
        return next((stage for stage in self.stages if not stage.is_minimisation), None)

    @property
    def inputs(self) -> dict[str, Path]:
        names: dict[str, str | None] = {}
        if self.structure is not None and "structure.file" not in self.embedded_files:
            names["structure.file"] = self.structure.file
        names["structure.topology"] = self.topology
        for k, species in enumerate(self.molecules):
            names |= {f"molecules.{k}.{key}": getattr(species, key) for key in SPECIES_FILES}
        for where, force in self.forces.added.items():
            names |= {f"{where}.{key}": file for key, file in force.files.items()}
        return {key: self.path(name) for key, name in names.items() if name is not None}

    @property
    def structure_source(self) -> str:
        """Path of the structure file, or "atoms", for messages. Empty without a structure."""
        if self.structure is None:
            return ""
        if "structure.file" in self.embedded_files:
            return "atoms"
        return str(self.path(self.structure.file))

    @property
    def topology(self) -> str | None:
        """The topology file of a trajectory as structure: as given, or else as found in the
        trajectory's folder."""
        if (start := self.structure) is None:
            return None
        if (
            start.topology is not None
            or (form := format_of(start.file)) is None
            or form.read_arrays is None
        ):
            return start.topology
        candidates = [str(Path(start.file).with_name(name)) for name in topologies()]
        topology = next((name for name in candidates if self.path(name).is_file()), None)
        if topology is None:
            return None
        path = self.path(topology)
        if not any(is_inside(path, folder) for folder in (self.path("."), path.parent)):
            problem = (
                f"{topology} next to the trajectory is a link out of the scene's folder. Name it by"
                " --set"
            )
            raise SceneError(
                self.source, [f"structure.topology: {problem} structure.topology=PATH"]
            )
        return topology

    def _errors(self) -> Iterator[str]:
        yield from self._errors_of_box()
        yield from self._errors_of_start()
        yield from self._errors_of_box_changes()
        yield from self._errors_of_frozen()
        cutoff, start = self.forces.cutoff_A, self.forces.switch_start_A
        if start is not None and cutoff is not None and start >= cutoff:
            yield f"forces.switch_start_A = {start:g} is not below cutoff_A = {cutoff:g}"
        yield from field_errors(self)
        yield from self._uneven_frames()

    def _errors_of_box(self) -> Iterator[str]:
        """Messages on a box that is given twice or not at all."""
        frameworks = [species for species in self.molecules if species.repeat is not None]
        if frameworks and (
            len(frameworks) > 1
            or self.structure is not None
            or not self.box.periodic
            or self.box.lengths_A is not None
            or self.box.density_g_cm3 is not None
        ):
            yield (
                "molecules.repeat: the cell of one framework is the box: omit [structure], other"
                " frameworks, box.lengths_A, box.density_g_cm3 and periodic = false"
            )
        elif self.structure is None:
            missing = [
                k
                for k, species in enumerate(self.molecules)
                if species.count is None and species.repeat is None
            ]
            yield from [
                f"molecules.{k}.count is missing (required without a structure file)"
                for k in missing
            ]
            if self.box.lengths_A is None and self.box.density_g_cm3 is None and not frameworks:
                yield "box needs lengths_A or density_g_cm3, or there must be a structure file"
        elif self.box.density_g_cm3 is not None:
            yield "box.density_g_cm3 and a structure file contradict each other: omit one"
        elif self.structure.repeat != (1, 1, 1) and (
            self.box.lengths_A is not None or not self.box.periodic
        ):
            yield (
                "structure.repeat repeats the file's cell: omit box.lengths_A and periodic = false"
            )
        if self.box.vacuum_A and self.box.vacuum_axis in [
            walls.axis for walls in self.fields.walls
        ]:
            yield (
                "box.vacuum_A and fields.walls across the same axis contradict each other: omit one"
            )

    def _errors_of_start(self) -> Iterator[str]:
        """Messages on the velocities of the start."""
        first = self.first_moving
        from_file = self.structure is not None and self.structure.velocities
        if (
            self.start.temperature_K is None
            and first is not None
            and first.temperature_K is None
            and not from_file
        ):
            if first is self.stages[0]:
                which = "the first stage"
            else:
                which = "the first stage that is not a minimisation"
            yield (
                f"start.temperature_K is missing: {which} is {first.ensemble} and no velocities are"
                " read"
            )
        if self.start.temperature_K is not None and from_file:
            yield (
                "start.temperature_K would have no effect: velocities are read from the structure"
                " file"
            )
        if (
            self.start.temperature_K == 0
            and first is not None
            and first.has_thermostat
            and first.keeps_momentum
        ):
            yield (
                "start.temperature_K is 0: a thermostat that rescales momenta cannot heat molecules"
                " at rest"
            )

    def _errors_of_box_changes(self) -> Iterator[str]:
        """Messages on stages that change a box that must stay, or need the mean of one that did not
        change."""
        reasons = {
            "box.periodic is false": not self.box.periodic,
            "frozen molecules do not move: release them, or keep the volume": any(
                m.frozen for m in self.molecules
            ),
            "fields.walls do not move: keep the volume": self.fields.walls,
            "fields.restraints fix positions: keep the volume": any(
                entry.between is None for entry in self.fields.restraints
            ),
        }
        if (slab := self.forces.ewald_slab) is not None:
            rigid = {"lateral"} if slab == "z" else set()
            why = (
                f"forces.ewald_slab = {slab!r} needs a constant edge along {slab}: keep the volume"
            )
            why += ", or set pressure_coupling = 'lateral'" if rigid else ""
            moving = [
                k
                for k, s in enumerate(self.stages)
                if s.changes_box and s.pressure_coupling not in rigid
            ]
            yield from [f"stages.{k}: {why}" for k in moving]
        for k, stage in enumerate(self.stages):
            what = (
                f"stages.{k}: {stage.ensemble}{' with pressure_bar' * stage.is_minimisation}"
                " changes the box"
            )
            yield from [
                f"{what}, but {why}"
                for why, applies in reasons.items()
                if stage.changes_box and applies
            ]
            before = self.stages[k - 1] if k else None
            if stage.volume and (before is None or not before.has_barostat or before.ramps):
                changes = ", and its set point changes" if before and before.ramps else ""
                if before:
                    preceding = f"stages.{k - 1} is {before.ensemble}{changes}"
                else:
                    preceding = "it is the first stage"
                why = (
                    "needs an npt or nph stage just before it, at constant temperature and pressure"
                )
                yield f"stages.{k}.volume = 'mean' {why}; {preceding}. Add one, or leave volume out"

    def _errors_of_frozen(self) -> Iterator[str]:
        """Messages on keys that contradict frozen molecules."""
        if not any(species.frozen for species in self.molecules):
            return
        if self.forces.tail_correction:
            yield "forces.tail_correction assumes a uniform liquid: omit it with frozen molecules"
        if self.forces.dispersion != "cutoff":
            yield (
                "forces.dispersion: sums over images also act between frozen molecules: use cutoff,"
                " or freeze none"
            )
        if self.run.remove_momentum_interval_ps:
            yield (
                "run.remove_momentum_interval_ps: the total momentum is not conserved with frozen"
                " molecules. Omit it"
            )

    def errors_of_steps(self) -> list[str]:
        """Messages on default time steps that contradict other keys. Without them a scene has no
        errors."""
        of_stages = [
            f"stages.{k}: {error}"
            for k, stage in enumerate(self.stages)
            for error in stage._errors()
        ]
        return [*of_stages, *self._errors()]

    def rounded_times(self, stages: Sequence[int] | None = None) -> list[str]:
        """Notes on intervals and durations that are not a whole number of steps, of all stages or
        these."""
        output = self.output
        stages_of = {}
        of_run = [
            ("output.log_interval_ps", output.log_interval_ps),
            ("output.trajectory_interval_ps", output.trajectory and output.trajectory_interval_ps),
            ("output.pressure_tensor_interval_ps", output.pressure_tensor_interval_ps),
        ]
        for k in range(len(self.stages)) if stages is None else stages:
            stage = self.stages[k]
            if stage.is_minimisation or stage.is_auto:
                continue
            of_stage = [(f"stages.{k}.duration_ps", stage.duration_ps)]
            if stage.barostat_interval_ps != default_interval(stage):
                of_stage.append((f"stages.{k}.barostat_interval_ps", stage.barostat_interval_ps))
            if stage.keeps_momentum:  # elsewhere nothing is removed
                of_stage.insert(
                    0, ("run.remove_momentum_interval_ps", self.run.remove_momentum_interval_ps)
                )
            for key, duration in [*of_run, *of_stage]:
                taken = duration and stage.steps_of(duration) * stage.step
                if (
                    duration
                    and taken < MOST_STEPS * stage.step
                    and abs(taken - duration) > 1e-9 * duration
                ):
                    together = (
                        f"trajectories of {stage.steps_together} " if stage.in_trajectories else ""
                    )
                    unit = f"a whole number of {together}steps of {stage.step_fs:g} fs"
                    stages_of.setdefault((key, duration, unit, taken), []).append(f"stages.{k}")
        return [
            f"{key} = {duration:g} is not {unit} ({', '.join(where)}): it is {taken:g} ps"
            for (key, duration, unit, taken), where in stages_of.items()
        ]

    def _uneven_frames(self) -> Iterator[str]:
        """Messages on stages with other intervals between frames, for a file with one interval for
        all frames."""
        kind = Path(self.output.trajectory or "").suffix
        if not kind or not BY_EXTENSION[kind].even:
            return
        interval = self.output.trajectory_interval_ps
        other = f"use {Path(TRAJECTORY).suffix}"
        for k, stage in enumerate(self.stages):
            if stage.is_minimisation:
                continue
            every = stage.steps_of(interval)
            uneven = stage.steps % every and k < len(self.stages) - 1
            if stage.is_auto:
                yield (
                    f"output.trajectory: a {kind} file cannot follow the step of stages.{k};"
                    f" {other}"
                )
            elif abs(every * stage.step - interval) > 1e-9 * interval or uneven:
                error = (
                    f"a {kind} file stores one time between frames, and stages.{k} cannot keep"
                    f" {interval:g} ps"
                )
                advice = (
                    f"make it a multiple of timestep_fs and a divisor of duration_ps, or {other}"
                )
                yield f"output.trajectory: {error}: {advice}"
