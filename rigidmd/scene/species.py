"""Tables of a scene of molecules: [[molecules]], the species and their numbers. [structure], [box]
and [start]."""

import re
from math import pi, radians
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, Strict, field_validator

from rigidmd.formats import extensions
from rigidmd.formats.cells import cell_of
from rigidmd.scene.models import Site, SiteName, available_models, model_error
from rigidmd.scene.validation import (
    Count,
    Flag,
    Line,
    NonNegative,
    Positive,
    Section,
    ShortName,
    exact_names,
)

#: Keys of [[molecules]] that name a file.
SPECIES_FILES = ("file", "parameters")


def checked_numbers(numbers: tuple[int, ...] | str) -> tuple[int, ...] | str:
    """Numbers of molecules, [1, 2, 5] or "1-10, 15", unchanged. Raises ValueError."""
    if numbers == ():
        raise ValueError("is empty: list the numbers of molecules, or omit it")
    if isinstance(numbers, str):
        if not re.fullmatch(r"\s*\d+\s*(-\s*\d+\s*)?(,\s*\d+\s*(-\s*\d+\s*)?)*", numbers):
            raise ValueError(
                f"is {numbers!r}, must be numbers of molecules such as '1-10' or '1-10, 15'"
            )
        if reversed_ := [f"{first}-{last}" for first, last in spans(numbers) if first > last]:
            raise ValueError(f"is {numbers!r}: {', '.join(reversed_)} ends before it begins")
    return numbers


def spans(numbers: tuple[int, ...] | str) -> list[tuple[int, int]]:
    """Ranges (first, last) of "1-10, 15", or of the single numbers of a list."""
    if not isinstance(numbers, str):
        return [(number, number) for number in numbers]
    ends = [[int(number) for number in part.split("-")] for part in numbers.split(",")]
    return [(of_part[0], of_part[-1]) for of_part in ends]


ResidueNumber = Annotated[int, Strict(), Field(ge=0)]
Numbers = Annotated[tuple[ResidueNumber, ...] | str, AfterValidator(checked_numbers)]


class Molecules(Section):
    """A species and its number of molecules."""

    model: str | None = None
    """A shipped model. `rigidmd models` lists them"""
    file: Line | None = None
    """A .toml file with a molecule, like the shipped models, or a geometry in a format that ASE
    reads, with `sites` for its atoms"""
    name: ShortName | None = None
    """Name of the species. Default: the name of the model or file"""
    sites: tuple[Site, ...] | None = Field(default=None, min_length=1)
    """Sites of a custom molecule. With a geometry `file`, their parameters by atom name or
    element"""
    parameters: Line | None = None
    """A .toml file with entries like `sites` that several molecules may use. It supplies missing
    keys by atom name or element"""
    masses_u: dict[str, Positive] | None = Field(default=None, min_length=1)
    """Masses of sites by name or element, for other isotopes: { H = 2.014 } for heavy water"""
    residue_names: tuple[SiteName, ...] | None = None
    """Residue names of this species in structure files"""
    count: Count | None = None
    """Number of molecules. Required without a structure file"""
    repeat: tuple[Count, Count, Count] | None = None
    """Repetitions of the cell of a crystal `file` along a, b, c. Its atoms are one frozen body, a
    framework, and its repeated cell is the box"""
    frozen: Flag | Numbers = False
    """Molecules that do not move. They act on all other molecules but not on each other. Use true
    for all molecules of the species, or the numbers of some of them, [1, 2, 5] or "1-10, 15". These
    are residue numbers of the structure file. Without a file, or if its residues are not the
    molecules, they are 1, 2, ... within this species"""

    @field_validator("model")
    @classmethod
    def _is_known(cls, model: str | None):
        model = exact_names(model, Literal[tuple(available_models())])
        if model is not None and (error := model_error(model)):
            raise ValueError(error)
        return model

    def _errors(self):
        """The first error, which may explain the others."""
        model, file, sites, table = (
            key is not None for key in (self.model, self.file, self.sites, self.parameters)
        )
        is_complete = file and str(self.file).endswith(".toml")
        errors = {
            "give a model, or a custom file and sites, not both": model and (file or sites),
            "parameters would have no effect: a model or a .toml file contains parameters": (
                table and (model or is_complete)
            ),
            f"parameters = {self.parameters!r} must be a .toml file with [[sites]]": (
                table and not str(self.parameters).endswith(".toml")
            ),
            "needs one of model, file, sites": not (model or file or sites),
            "a .toml file has its own sites: leave out one of them": is_complete and sites,
            "a geometry file needs sites, or a file of parameters, for its atoms": (
                file and not (is_complete or sites or table)
            ),
            "a custom molecule needs a name": sites and not file and self.name is None,
            "repeat needs the file of a crystal": self.repeat and (is_complete or not file),
            "repeat makes a framework, which does not move: set frozen = true, and count = 1": (
                self.repeat and not (self.frozen is True and self.count in (None, 1))
            ),
        }
        return [error for error, is_there in errors.items() if is_there][:1]

    @property
    def label(self) -> str:
        """The name, else the name of the model or file."""
        return self.name or self.model or Path(self.file or "").stem


Angle = Annotated[float, Strict(), Field(gt=0, lt=180)]


class Structure(Section):
    """Positions at the start from a file."""

    file: Line
    """Structure file that ASE reads (.gro, .pdb, .xyz, .cif, LAMMPS' .data, ...), a trajectory
    (.xtc .trr .gsd .traj .dcd .nc), or `final.npz` of an earlier run. It must be in the folder of
    the scene or below"""
    topology: Line | None = None
    """Structure file with the names of the atoms, in the same order. It is needed for trajectories
    without names (all formats but .gsd). Default: topology.gro or topology.pdb in the folder of the
    trajectory"""
    frame: Annotated[int, Strict()] | None = None
    """Number of the structure in a file with several structures: 1 is the first, -1 the last.
    Required for such files, except for trajectories, whose default is the last frame"""
    repeat: tuple[Count, Count, Count] = (1, 1, 1)
    """Repetitions of the file's cell along a, b, c. Use it to make a crystal from its unit cell"""
    velocities: Flag = False
    """Use the velocities in the file instead of drawing them"""
    tolerance: Annotated[float, Strict(), Field(gt=0, lt=1)] = 0.15
    """Largest distance of an atom from its position in the rigid template, as a fraction of the
    template's radius"""
    atom_types: dict[str, SiteName] | None = Field(default=None, min_length=1)
    """Site name or element of each atom type in LAMMPS data files, dumps and .xyz files: { 1 = "O",
    2 = "H" }. X has no mass. Default: labels or elements in the file, else masses"""

    def _errors(self):
        if self.topology is None:
            return
        nameless = extensions(lambda form: form.read_arrays)
        if not self.file.lower().endswith(nameless):
            yield (
                f"topology is for trajectories without names ({' '.join(nameless)}), not for"
                f" {self.file}"
            )
        if self.topology.lower().endswith((*extensions(lambda form: form.is_trajectory), ".npz")):
            with_names = ", ".join(extensions(lambda form: form.topology))
            yield (
                f"topology = {self.topology!r}: name a structure file with names of atoms"
                f" ({with_names})"
            )


class Box(Section):
    """The periodic box."""

    lengths_A: Positive | tuple[Positive, Positive, Positive] | None = None
    """Edge lengths. One number for a cube"""
    angles_deg: tuple[Angle, Angle, Angle] | None = None
    """Angles between b and c, c and a, a and b. Default: right angles"""
    density_g_cm3: Positive | None = None
    """Mass density, which sets the edge of a cube"""
    vacuum_A: Positive | None = None
    """Empty length that is added to an edge, half of it on each side of the molecules. The
    molecules then form a slab"""
    vacuum_axis: Literal["x", "y", "z"] = "z"
    """The edge a, b or c to which vacuum_A is added"""
    periodic: Flag = True
    """Periodic boundary conditions. false: molecules in vacuum without a box"""

    def _errors(self):
        if self.lengths_A is not None and self.density_g_cm3 is not None:
            yield "give lengths_A or density_g_cm3, not both"
        if self.angles_deg is not None and self.lengths_A is None:
            yield "angles_deg needs lengths_A"
        if self.vacuum_A is not None and not self.periodic:
            yield "vacuum_A would have no effect: periodic is false"
        angles = [radians(angle) for angle in self.angles_deg or (90, 90, 90)]
        # the edges would be in one plane, or could not meet
        if not 2 * max(angles) < sum(angles) < 2 * pi:
            yield "angles_deg: three edges cannot form these angles"

    @property
    def cell(self) -> np.ndarray | None:
        """Rows (3, 3) a along x, b in the xy plane and c, Å. None if the scene does not set it."""
        if self.lengths_A is None:
            return None
        lengths = self.lengths_A if isinstance(self.lengths_A, tuple) else (self.lengths_A,) * 3
        return (
            np.diag(lengths) if self.angles_deg is None else cell_of([*lengths, *self.angles_deg])
        )


class Start(Section):
    """Momenta at the start."""

    temperature_K: NonNegative | None = None
    """Temperature at which momenta are drawn. Default: the temperature of the first stage that is
    not a minimisation"""
