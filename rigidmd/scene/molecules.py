"""The scene of molecules: species, box, forces, stages."""

import re
from math import cos, inf, pi, radians, sqrt
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Strict, field_validator, model_validator

from rigidmd.core.schemes import AUTO, SCHEMES, Rotor, Scheme, auto_faults, rotor_fault
from rigidmd.molecules import Mixing, Site, SiteName, model_fault
from rigidmd.scene.base import Scene, file_name
from rigidmd.scene.watch import Watch
from rigidmd.validation import Count, Flag, NonNegative, Positive, Section

TRAJECTORY_FORMATS = (".xtc", ".trr", ".dcd", ".nc", ".xyz", ".pdb")
WITH_VELOCITIES = (".trr", ".nc")
TOPOLOGY_FORMATS = (".gro", ".pdb")

MOST_STEPS = 1e12
REMOVE_MOMENTUM_EVERY = 1.0  # ps, with pme: in it 216 waters at an accuracy of 1e-4 gained 26 u Å/ps; thermal were 980

#: Endings of LAMMPS' data files.
LAMMPS_DATA = (".data", ".lmp", ".lammps")

#: Keys of [[molecules]] that name a file.
SPECIES_FILES = ("file", "parameters")

Interval = Annotated[float, Strict(), Field(gt=0, le=1e9)]
Angle = Annotated[float, Strict(), Field(gt=0, lt=180)]
Permittivity = Annotated[float, Strict(), Field(ge=1)]
WaveNumber = Annotated[int, Strict(), Field(ge=0, le=1000)]
ResidueNumber = Annotated[int, Strict(), Field(ge=0)]
GridSize = Annotated[int, Strict(), Field(ge=8, le=4096)]

#: Keys of `Forces` that only some kinds of electrostatics know.
ELECTROSTATIC_KEYS = {
    "reaction_field_permittivity": ("reaction_field",),
    "damping_per_A": ("damped_shifted_force",),
    "ewald_accuracy": ("ewald", "pme"),
    "ewald_alpha_per_A": ("ewald", "pme"),
    "ewald_surface_permittivity": ("ewald", "pme"),
    "ewald_truncation": ("ewald", "pme"),
    "ewald_k_max": ("ewald",),
    "ewald_k2_max": ("ewald",),
    "ewald_k_radius_per_A": ("ewald",),
    "pme_order": ("pme",),
    "pme_grid": ("pme",),
}


class Structure(Section):
    """Where the molecules are at the start, from a file."""

    file: str
    """File that ASE reads (.gro, .pdb, .xyz, .cif, LAMMPS' .data, ...), Tinker's .arc, .cssr, or `final.npz` of an
    earlier run; beside or below the scene"""
    frame: Annotated[int, Strict()] | None = None
    """Which of several structures in the file: 1 is the first, -1 the last; needed where there are several"""
    repeat: tuple[Count, Count, Count] = (1, 1, 1)
    """How many times the file's cell stands side by side along a, b, c: from a crystal's cell to a crystal"""
    velocities: Flag = False
    """Use the velocities in the file instead of drawing them"""
    tolerance: Annotated[float, Strict(), Field(gt=0, lt=1)] = 0.15
    """Largest distance of an atom from its rigid template, as a fraction of the template's radius"""
    atom_types: dict[str, SiteName] | None = Field(default=None, min_length=1)
    """Of LAMMPS' data files: what each atom type is, { 1 = "O", 2 = "H" }, by a site's name or an element, X without
    mass. When not given, labels in the file tell, and else masses"""

    @model_validator(mode="after")
    def _has_types(self):
        if self.atom_types is not None and not self.file.lower().endswith(LAMMPS_DATA):
            raise ValueError(f"atom_types are of LAMMPS' data files ({' '.join(LAMMPS_DATA)}), not of {self.file}")
        return self


class Box(Section):
    """The periodic box, if any."""

    lengths_A: Positive | tuple[Positive, Positive, Positive] | None = None
    """Edges; one number for a cube"""
    angles_deg: tuple[Angle, Angle, Angle] | None = None
    """Angles between b and c, c and a, a and b; right angles when not given"""
    density_g_cm3: Positive | None = None
    """Mass density, from which the edge of a cube follows"""
    periodic: Flag = True
    """False: no box; molecules in vacuum"""

    @model_validator(mode="after")
    def _one_size(self):
        if self.lengths_A is not None and self.density_g_cm3 is not None:
            raise ValueError("give lengths_A or density_g_cm3, not both")
        if self.angles_deg is not None and self.lengths_A is None:
            raise ValueError("angles_deg needs lengths_A")
        if self.angles_deg is not None and not _span_a_volume(*map(radians, self.angles_deg)):
            raise ValueError("angles_deg: three edges cannot stand at these angles")
        return self

    @property
    def cell(self) -> np.ndarray | None:
        """Rows (3, 3) a along x, b in the xy plane and c, Å; None where the scene does not say."""
        if self.lengths_A is None:
            return None
        a, b, c = self.lengths_A if isinstance(self.lengths_A, tuple) else (self.lengths_A,) * 3
        alpha, beta, gamma = (0.0 if angle == 90 else cos(radians(angle)) for angle in self.angles_deg or (90,) * 3)
        across = sqrt(1 - gamma**2)
        y = (alpha - beta * gamma) / across
        return np.array([[a, 0, 0], [b * gamma, b * across, 0], [c * beta, c * y, c * sqrt(1 - beta**2 - y**2)]])


def _span_a_volume(alpha: float, beta: float, gamma: float) -> bool:
    """Whether edges at these angles to one another (radians) can stand, and not in one plane."""
    return 2 * max(alpha, beta, gamma) < alpha + beta + gamma < 2 * pi


class Molecules(Section):
    """A species and how many of it."""

    model: str | None = None
    """A model that comes with rigidmd; `rigidmd models` lists them"""
    file: str | None = None
    """A molecule in a .toml file like those models, or a geometry in any file ASE reads, with `sites` for its atoms"""
    name: str | None = None
    """What to call the species; the model's or file's name when not given"""
    sites: tuple[Site, ...] | None = Field(default=None, min_length=1)
    """The sites of a molecule of one's own; with a geometry `file`, their parameters by atom name or element"""
    parameters: str | None = None
    """A .toml file with entries like those of `sites`, which several molecules may share: what they do not say
    themselves, by atom name or element"""
    masses_u: dict[str, Positive] | None = Field(default=None, min_length=1)
    """Other masses of sites, by name or element: other isotopes, { H = 2.014 } for heavy water"""
    residue_names: tuple[SiteName, ...] | None = None
    """Residue names by which structure files may call this species"""
    count: Count | None = None
    """How many; needed unless there is a structure file"""
    frozen: Flag | tuple[ResidueNumber, ...] | str = False
    """They stay put and act on the others; not on one another, so the potential energy lacks that constant. True for
    all, or numbers of some, [1, 2, 5] or "1-10, 15": all residues of such a number in the structure file; where its
    residues are not the molecules, or there is no file, 1, 2, ... among those of this species"""

    @field_validator("frozen")
    @classmethod
    def _are_numbers(cls, frozen: bool | tuple[int, ...] | str):
        if frozen == ():
            raise ValueError("is empty: list the numbers of molecules, or leave it out")
        if isinstance(frozen, str):
            if not re.fullmatch(r"\s*\d+\s*(-\s*\d+\s*)?(,\s*\d+\s*(-\s*\d+\s*)?)*", frozen):
                raise ValueError(f"is {frozen!r}, must be numbers of molecules such as '1-10' or '1-10, 15'")
            if turned := [f"{first}-{last}" for first, last in _spans(frozen) if first > last]:
                raise ValueError(f"is {frozen!r}: {', '.join(turned)} ends before it begins")
        return frozen

    @property
    def frozen_spans(self) -> list[tuple[int, int]]:
        """First and last of the numbers of frozen molecules; none where all or none are."""
        if isinstance(self.frozen, bool):
            return []
        return _spans(self.frozen) if isinstance(self.frozen, str) else [(number, number) for number in self.frozen]

    @field_validator("model")
    @classmethod
    def _is_known(cls, model: str | None):
        if model is not None and (fault := model_fault(model)):
            raise ValueError(fault)
        return model

    @model_validator(mode="after")
    def _one_source(self):
        if self.model is not None and (self.file is not None or self.sites is not None):
            raise ValueError("give a model, or a file and sites of your own, not both")
        whole = self.model is not None or (self.file is not None and self.file.endswith(".toml"))
        if self.parameters is not None and whole:
            raise ValueError("parameters would do nothing: a model or a .toml file has its own")
        if self.parameters is not None and not self.parameters.endswith(".toml"):
            raise ValueError(f"parameters = {self.parameters!r} must be a .toml file with [[sites]]")
        if self.model is None and self.file is None and self.sites is None:
            raise ValueError("needs one of model, file, sites")
        if self.file is not None and self.file.endswith(".toml") and self.sites is not None:
            raise ValueError("a .toml file has its own sites: leave out one of them")
        if self.file is not None and not whole and self.sites is None and self.parameters is None:
            raise ValueError("a geometry file needs sites, or a file of parameters, for its atoms")
        if self.sites is not None and self.file is None and self.name is None:
            raise ValueError("a molecule of one's own needs a name")
        return self

    @property
    def label(self) -> str:
        """Its name, or that of its model or file."""
        return self.name or self.model or Path(self.file or "").stem


def _spans(text: str) -> list[tuple[int, int]]:
    """First and last number of each part of "1-10, 15"."""
    ends = [[int(number) for number in part.split("-")] for part in text.split(",")]
    return [(numbers[0], numbers[-1]) for numbers in ends]


class UnlikePair(Section):
    """Lennard-Jones parameters of two kinds of sites, in place of the mixing rule."""

    sites: tuple[str, str]
    """The two kinds: a site's name, else an element; `SPECIES.NAME` for those of one species"""
    sigma_A: Positive
    """Lennard-Jones diameter"""
    epsilon_kJ_mol: NonNegative
    """Lennard-Jones well depth"""


class Forces(Section):
    """What acts between sites of different molecules."""

    cutoff_A: Positive | None = None
    """Cut-off between sites; 9 Å in a periodic box, none without one"""
    truncation: Literal["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"] = "switch"
    """How forces end at the cut-off, Lennard-Jones and charges alike; smooth_switch for integrators of high order. The
    energy of a reaction field is first shifted to 0 there, then multiplied by switch or smooth_switch. What ewald and
    pme leave to pairs ends as ewald_truncation says"""
    switch_start_A: Positive | None = None
    """Where force_switch and switch begin: 1 Å before the cut-off, or at 0.9 of it if that is longer, when not given;
    and smooth_switch, at 0.6 of the cut-off"""
    mixing: Mixing = "lorentz-berthelot"
    """Lennard-Jones parameters between unlike sites"""
    pairs: tuple[UnlikePair, ...] = ()
    """Parameters of particular pairs, in place of the mixing rule"""
    tail_correction: Flag = False
    """Add the energy and pressure of Lennard-Jones beyond the cut-off; `pressure` is with it, `virial` without"""
    electrostatics: Literal["reaction_field", "ewald", "pme", "damped_shifted_force", "none"] = "reaction_field"
    """How charges act: ewald and pme with all periodic images, the others within the cut-off; none ignores them"""
    reaction_field_permittivity: Permittivity = inf
    """Permittivity of the continuum beyond the cut-off; inf for a conductor"""
    damping_per_A: Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)] = 0.2
    """Of damped_shifted_force; 0 for none"""
    ewald_accuracy: Annotated[float, Strict(), Field(gt=0, le=0.1)] = 1e-5
    """Of ewald and pme: rms error of the force on a site, over that between two charges e at 1 Å; sets what follows"""
    ewald_alpha_per_A: Positive | None = None
    """Splitting parameter: charges are screened by erfc(alpha r)"""
    ewald_k_max: WaveNumber | tuple[WaveNumber, WaveNumber, WaveNumber] | None = None
    """Of ewald: largest |n| of k = 2 pi n/L, for all axes or each, of the cell as box or file describe it"""
    ewald_k2_max: Count | None = None
    """Of ewald: largest n_x² + n_y² + n_z² besides"""
    ewald_k_radius_per_A: Positive | None = None
    """Of ewald: largest length of k"""
    ewald_truncation: Literal["plain", "shift"] | None = None
    """Of ewald and pme: whether the energy of what they leave to pairs, erfc(alpha r)/r, is shifted to 0 at the
    cut-off; forces are the same. When not given: plain where `truncation` is plain, else shift. coulomb_self then also
    holds -erfc(alpha R)/(2 R) times the square of each molecule's charge, R the cut-off: nothing for neutral ones"""
    ewald_surface_permittivity: Permittivity = inf
    """Permittivity around the periodic images as a whole; inf, a conductor, adds no surface term"""
    pme_order: Annotated[int, Strict(), Field(ge=3, le=8)] | None = None
    """Of pme: order of the B-splines, 4 is cubic"""
    pme_grid: tuple[GridSize, GridSize, GridSize] | None = None
    """Of pme: grid points along each edge of the cell as box or file describe it; three equal ones if it leans by more
    than half an edge, as another cell stands for it then"""
    skin_A: Annotated[float, Strict(), Field(gt=0, le=100)] = 1.6
    """Extra radius of the neighbour list; speed only, never the result"""

    @model_validator(mode="after")
    def _nothing_idle(self):
        if self.switch_start_A is not None and "switch" not in self.truncation:
            raise ValueError(f"switch_start_A would do nothing with truncation = {self.truncation!r}")
        fields, method = type(self).model_fields, self.electrostatics
        for key, methods in ELECTROSTATIC_KEYS.items():
            if getattr(self, key) != fields[key].default and method not in methods:
                raise ValueError(f"{key} would do nothing with electrostatics = {method!r}")
        if self.ewald_k2_max is not None and self.ewald_k_max is None:
            raise ValueError("ewald_k2_max needs ewald_k_max beside it")
        if self.ewald_k2_max is not None and self.ewald_k_radius_per_A is not None:
            raise ValueError("give ewald_k2_max or ewald_k_radius_per_A, not both")
        settled = self.gives_waves or (self.pme_grid is not None and self.pme_order is not None)
        if settled and self.ewald_alpha_per_A is not None and "ewald_accuracy" in self.model_fields_set:
            raise ValueError("ewald_accuracy would do nothing: alpha and what goes with it are all given")
        return self

    @property
    def shifts_ewald(self) -> bool:
        """Whether the real-space energy of an Ewald sum is shifted to 0 at the cut-off."""
        usual = "plain" if self.truncation == "plain" else "shift"
        return (self.ewald_truncation or usual) == "shift"

    @property
    def gives_waves(self) -> bool:
        """Whether the scene says which waves an Ewald sum takes."""
        return self.ewald_k_max is not None or self.ewald_k_radius_per_A is not None


class Start(Section):
    """The first moment."""

    temperature_K: NonNegative | None = None
    """Temperature of the momenta that are drawn; that of the first stage when not given"""


class Stage(Section):
    """A stretch of time under one ensemble and one step."""

    name: str | None = None
    """What to call it; the ensemble's name when not given"""
    ensemble: Literal["nve", "nvt"] = "nve"
    """nve keeps the energy, nvt the temperature"""
    duration_ps: Positive
    """How long"""
    timestep_fs: Positive = 2.0
    """Time step"""
    temperature_K: Positive | None = None
    """Temperature of the thermostat"""
    thermostat: Literal["velocity_rescaling"] = "velocity_rescaling"
    """velocity_rescaling is the stochastic one of Bussi et al."""
    thermostat_time_ps: Positive = 0.1
    """Time constant of the thermostat"""
    integrator: Literal[(*SCHEMES, AUTO)] = "velocity_verlet"  # type: ignore[valid-type]
    """Scheme of kicks and drifts; auto: the one, and its step, that keep the error asked for with the fewest forces"""
    energy_error_kT: Positive | None = None
    """With auto: rms error of the energy, in kT per degree of freedom"""
    trajectory_error: Positive | None = None
    """With auto: largest error of Q (of X in Å, of points) at the end of the pilot run, ten radians of libration"""
    rotor: Rotor | None = None
    """Free rotation by the split or the exact flow; the one that the integrator needs when not given"""

    @field_validator("ensemble", mode="before")
    @classmethod
    def _is_there(cls, ensemble: Any):
        if isinstance(ensemble, str) and ensemble.lower() in ("npt", "nph"):
            raise ValueError(f"is {ensemble!r}, must be 'nve' or 'nvt': there is no pressure coupling yet")
        return ensemble

    @model_validator(mode="after")
    def _makes_sense(self):
        if self.ensemble == "nvt" and self.temperature_K is None:
            raise ValueError("an nvt stage needs temperature_K")
        if self.ensemble == "nve":
            fields = type(self).model_fields
            thermal = ("temperature_K", "thermostat", "thermostat_time_ps")
            if idle := [key for key in thermal if getattr(self, key) != fields[key].default]:
                raise ValueError(f"{', '.join(idle)} would do nothing in an nve stage")
        if fault := rotor_fault(self.integrator, self.rotor):
            raise ValueError(fault)
        decided = [
            key for key in ("timestep_fs", "rotor") if getattr(self, key) != type(self).model_fields[key].default
        ]
        asked = {"energy_error_kT": self.energy_error_kT, "trajectory_error": self.trajectory_error}
        if faults := auto_faults(self.integrator, asked, decided):
            raise ValueError("; ".join(faults))
        if not self.duration_ps * 1000 / self.timestep_fs < MOST_STEPS:
            raise ValueError(f"duration_ps / timestep_fs is more than {MOST_STEPS:g} steps")
        if self.duration_ps * 1000 < 0.5 * self.timestep_fs:
            raise ValueError(f"duration_ps = {self.duration_ps:g} is less than one step of {self.timestep_fs:g} fs")
        return self

    @property
    def steps(self) -> int:
        """Number of steps: the duration in steps, rounded."""
        return round(self.duration_ps * 1000 / self.timestep_fs)

    @property
    def is_open(self) -> bool:
        """Whether integrator and step are still to be chosen."""
        return self.integrator == AUTO

    def decided(self, integrator: str, timestep_fs: float) -> "Stage":
        """This stage with what a pilot has chosen."""
        none = {"energy_error_kT": None, "trajectory_error": None}
        return self.model_copy(update={"integrator": integrator, "timestep_fs": timestep_fs} | none)

    @property
    def scheme(self) -> Scheme:
        """The integrator with its rotor."""
        return SCHEMES[self.integrator].with_rotor(self.rotor)

    @property
    def label(self) -> str:
        """Its name, or its ensemble."""
        return self.name or self.ensemble


class Throughout(Section):
    """What holds for all stages."""

    remove_momentum_interval_ps: Interval | Literal[False] | None = None
    """Time between removals of the total momentum; false for never. When not given: 1 ps with pme, whose forces do not
    add up to zero exactly, and never otherwise. Its energy is booked like the heat of a thermostat"""


class Output(Section):
    """What is written, all into the run's own folder."""

    log_interval_ps: Interval = 0.05
    """Time between lines of log.csv"""
    trajectory: str | Literal[False] = "trajectory.xtc"
    """Trajectory file; the ending chooses the format (.xtc .trr .dcd .nc .xyz .pdb); false for none"""
    trajectory_interval_ps: Interval = 0.5
    """Time between frames"""
    topology: str = "topology.gro"
    """File with names and first positions that viewers need beside the trajectory (.gro or .pdb)"""
    positions: Literal["wrapped", "unwrapped"] = "unwrapped"
    """unwrapped: as molecules travelled, from which displacements follow; wrapped: centres of mass inside the box.
    Molecules are whole in both"""
    velocities: Flag | None = None
    """Write velocities; where the format holds them when not given"""
    figure: Flag = True
    """Draw energy.png"""

    @field_validator("trajectory")
    @classmethod
    def _trajectory_name(cls, name):
        return name if name is False else file_name(name, TRAJECTORY_FORMATS)

    @field_validator("topology")
    @classmethod
    def _topology_name(cls, name: str):
        return file_name(name, TOPOLOGY_FORMATS)

    @model_validator(mode="after")
    def _holds_velocities(self):
        if self.velocities and (self.trajectory is False or not self.trajectory.endswith(WITH_VELOCITIES)):
            raise ValueError(
                f"velocities = true, but {self.trajectory or 'no trajectory'} holds none; "
                f"use one ending in {' or '.join(WITH_VELOCITIES)}"
            )
        if self.topology == self.trajectory:
            raise ValueError(f"topology and trajectory are both {self.topology}; name them apart")
        return self


class MolecularScene(Scene):
    """Molecules that move."""

    seed: Annotated[int, Strict(), Field(ge=0)] = 1
    """Everything random follows from it"""
    precision: Literal["double", "mixed"] = "double"
    """Arithmetic of the forces between sites; mixed: single, summed and moved in double"""
    threads: Count | None = None
    """Threads; all cores when not given. Results do not depend on it"""
    structure: Structure | None = None
    box: Box = Box()
    molecules: tuple[Molecules, ...] = Field(min_length=1)
    forces: Forces = Forces()
    start: Start = Start()
    stages: tuple[Stage, ...] = Field(min_length=1)
    run: Throughout = Throughout()
    output: Output = Output()
    watch: Watch = Watch()

    @property
    def removes_momentum_every(self) -> float | None:
        """Time between removals of the total momentum, ps; None for never."""
        asked = self.run.remove_momentum_interval_ps
        if asked is not None:
            return asked or None
        held = any(species.frozen for species in self.molecules)
        return REMOVE_MOMENTUM_EVERY if self.forces.electrostatics == "pme" and not held else None

    @property
    def in_short(self) -> str:
        """Species, where they come from, stages."""
        species = ", ".join(f"{entry.count or ''} {entry.label}".strip() for entry in self.molecules)
        origin = "" if self.structure is None else f" of {self.structure.file}"
        stages = ", ".join(f"{stage.label} {stage.duration_ps:g} ps" for stage in self.stages)
        return f"{self.name}: {species}{origin}; {stages}"

    @property
    def inputs(self) -> dict[str, Path]:
        """Every file it reads besides itself: dotted key -> path."""
        found = {} if self.structure is None else {"structure.file": self.path(self.structure.file)}
        for k, species in enumerate(self.molecules):
            for key in SPECIES_FILES:
                if (name := getattr(species, key)) is not None:
                    found[f"molecules.{k}.{key}"] = self.path(name)
        return found

    @model_validator(mode="after")
    def _whole(self):
        faults = []
        if self.structure is None:
            faults += [
                f"molecules.{k}.count is missing (there is no structure file to count in)"
                for k, species in enumerate(self.molecules)
                if species.count is None
            ]
            if self.box.lengths_A is None and self.box.density_g_cm3 is None:
                faults.append("box needs lengths_A or density_g_cm3, or there must be a structure file")
        elif self.box.density_g_cm3 is not None:
            faults.append("box.density_g_cm3 and a structure file contradict each other: leave one out")
        elif self.structure.repeat != (1, 1, 1) and (self.box.lengths_A is not None or not self.box.periodic):
            faults.append("structure.repeat repeats the file's cell: leave out box.lengths_A and periodic = false")
        if self.start.temperature_K is None and self.stages[0].temperature_K is None:
            from_file = self.structure is not None and self.structure.velocities
            if not from_file:
                faults.append("start.temperature_K is missing: the first stage is nve and no velocities are read")
        if self.start.temperature_K is not None and self.structure is not None and self.structure.velocities:
            faults.append("start.temperature_K would do nothing: the velocities are read from the structure file")
        if self.start.temperature_K == 0 and self.stages[0].ensemble == "nvt":
            faults.append("start.temperature_K is 0: a thermostat that rescales momenta cannot warm what is at rest")
        if self.forces.tail_correction and any(species.frozen for species in self.molecules):
            faults.append("forces.tail_correction is that of a liquid all around; with frozen molecules leave it out")
        if self.run.remove_momentum_interval_ps and any(species.frozen for species in self.molecules):
            faults.append(
                "run.remove_momentum_interval_ps: frozen molecules hold the others, and no total momentum is kept; "
                "leave it out"
            )
        cutoff, start = self.forces.cutoff_A, self.forces.switch_start_A
        if start is not None and cutoff is not None and start >= cutoff:
            faults.append(f"forces.switch_start_A = {start:g} is not below cutoff_A = {cutoff:g}")
        faults += self._uneven_frames()
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def _uneven_frames(self) -> list[str]:
        """DCD stores one interval for all frames: stages that would make them uneven."""
        if not self.output.trajectory or not self.output.trajectory.endswith(".dcd"):
            return []
        wanted = self.output.trajectory_interval_ps
        faults = []
        for k, stage in enumerate(self.stages):
            if stage.is_open:
                faults.append(f"output.trajectory: a .dcd file cannot follow the step of stages.{k}; use .xtc")
                continue
            every = max(1, round(wanted * 1000 / stage.timestep_fs))
            uneven = stage.steps % every and k < len(self.stages) - 1
            if abs(every * stage.timestep_fs / 1000 - wanted) > 1e-9 * wanted or uneven:
                faults.append(
                    f"output.trajectory: a .dcd file stores one time between frames, and stages.{k} cannot keep "
                    f"{wanted:g} ps: make it a multiple of timestep_fs and a divisor of duration_ps, or use .xtc"
                )
        return faults

    @classmethod
    def strange_paths(cls, data: dict[str, Any], folder: Path) -> list[str]:
        """Files named in a scene that are not in its folder."""
        named = []
        if isinstance(structure := data.get("structure"), dict):
            named.append(("structure.file", structure.get("file")))
        if isinstance(species := data.get("molecules"), list):
            named += [
                (f"molecules.{k}.{key}", entry.get(key))
                for k, entry in enumerate(species)
                if isinstance(entry, dict)
                for key in SPECIES_FILES
            ]
        return [
            f"{key}: {file!r} lies outside the scene's folder; move it there, or name it with --set {key}=PATH"
            for key, file in named
            if isinstance(file, str) and not (folder / file).resolve().is_relative_to(folder.resolve())
        ]
