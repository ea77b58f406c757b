"""Tables [structure], [box] and [start] of a scene of molecules."""

from math import cos, pi, radians, sqrt
from typing import Annotated

import numpy as np
from pydantic import Field, Strict, model_validator

from rigidmd.io.formats import extensions
from rigidmd.scene.models import SiteName
from rigidmd.scene.validation import Count, Flag, Line, NonNegative, Positive, Section

Angle = Annotated[float, Strict(), Field(gt=0, lt=180)]


class Structure(Section):
    """Positions at the start from a file."""

    file: Line
    """File that ASE reads (.gro, .pdb, .xyz, .cif, LAMMPS' .data, ...), a trajectory (.xtc .trr .gsd .traj .dcd .nc),
    or `final.npz` of an earlier run; in the folder of the scene or below"""
    topology: Line | None = None
    """Structure file with the names of the atoms, in the same order, for trajectories without names (all but .gsd).
    Default: topology.gro or topology.pdb in the folder of the trajectory"""
    frame: Annotated[int, Strict()] | None = None
    """Number of the structure in a file with several: 1 is the first, -1 the last. Required for such files, except
    trajectories; default for trajectories: the last"""
    repeat: tuple[Count, Count, Count] = (1, 1, 1)
    """Repetitions of the file's cell along a, b, c, to make a crystal of its unit cell"""
    velocities: Flag = False
    """Use the velocities in the file instead of drawing them"""
    tolerance: Annotated[float, Strict(), Field(gt=0, lt=1)] = 0.15
    """Largest distance of an atom from its position in the rigid template, as a fraction of the template's radius"""
    atom_types: dict[str, SiteName] | None = Field(default=None, min_length=1)
    """Site name or element of each atom type in LAMMPS data files, dumps and .xyz files: { 1 = "O", 2 = "H" }; X has no
    mass. Default: labels or elements in the file, else masses"""

    @model_validator(mode="after")
    def _needs_names(self):
        if self.topology is None:
            return self
        nameless = extensions(lambda form: form.read_arrays)
        if not self.file.lower().endswith(nameless):
            raise ValueError(f"topology is for trajectories without names ({' '.join(nameless)}), not for {self.file}")
        if self.topology.lower().endswith((*extensions(lambda form: form.is_trajectory), ".npz")):
            with_names = ", ".join(extensions(lambda form: form.write_topology))
            raise ValueError(f"topology = {self.topology!r}: name a structure file with names of atoms ({with_names})")
        return self


class Box(Section):
    """The periodic box."""

    lengths_A: Positive | tuple[Positive, Positive, Positive] | None = None
    """Lengths of the edges; one number for a cube"""
    angles_deg: tuple[Angle, Angle, Angle] | None = None
    """Angles between b and c, c and a, a and b; default: right angles"""
    density_g_cm3: Positive | None = None
    """Mass density, which sets the edge of a cube"""
    periodic: Flag = True
    """Periodic boundary conditions; false: molecules in vacuum without a box"""

    @model_validator(mode="after")
    def _one_size(self):
        if self.lengths_A is not None and self.density_g_cm3 is not None:
            raise ValueError("give lengths_A or density_g_cm3, not both")
        if self.angles_deg is not None and self.lengths_A is None:
            raise ValueError("angles_deg needs lengths_A")
        if self.angles_deg is not None and not _span_a_volume(*map(radians, self.angles_deg)):
            raise ValueError("angles_deg: three edges cannot form these angles")
        return self

    @property
    def cell(self) -> np.ndarray | None:
        """Rows (3, 3) a along x, b in the xy plane and c, Å; None if the scene does not set it."""
        if self.lengths_A is None:
            return None
        a, b, c = self.lengths_A if isinstance(self.lengths_A, tuple) else (self.lengths_A,) * 3
        alpha, beta, gamma = (0.0 if angle == 90 else cos(radians(angle)) for angle in self.angles_deg or (90,) * 3)
        across = sqrt(1 - gamma**2)
        y = (alpha - beta * gamma) / across
        return np.array([[a, 0, 0], [b * gamma, b * across, 0], [c * beta, c * y, c * sqrt(1 - beta**2 - y**2)]])


def _span_a_volume(alpha: float, beta: float, gamma: float) -> bool:
    """Whether three edges can form these angles (radians) without lying in one plane."""
    return 2 * max(alpha, beta, gamma) < alpha + beta + gamma < 2 * pi


class Start(Section):
    """Momenta at the start."""

    temperature_K: NonNegative | None = None
    """Temperature at which momenta are drawn; default: the temperature of the first stage in which time passes"""
