"""Frames of a run as rigid bodies, fitted to the positions and velocities of sites: the input of all analyses."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.run.rigid_fit import Bodies, Kind, RigidFit, kinds_of
from rigidmd.scene.models import Molecule
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import did_you_mean
from rigidmd.units import BOLTZMANN

#: Two intervals between frames that differ by less than this fraction are equal.
EVEN = 1e-3
#: Largest fraction of the box that a wrapped molecule may move between two frames to be followed.
MAX_WRAPPED_MOVE = 0.4


@dataclass(frozen=True, eq=False)
class RigidFrames:
    """Frames of a part of a run, for analyses. Molecules are whole and their paths continuous.

    f frames, n molecules; Å, ps, u:
    time (f,), cell (f, 3, 3) rows a, b, c, infinite edges without a box
    positions (f, n, 3) centres of mass, lab frame; Q (f, n, 3, 3) body to lab, principal axes
    velocities (f, n, 3) lab frame, L (f, n, 3) angular momentum along the body's axes; None where no frame has them
    columns : samples of the same time by their names in `results[...]`
    tensor : (l, 7) rows of pressure_tensor.csv, ps and bar, of the same time; None if the run wrote none
    notes : on the choice and the correction of frames
    """

    system: System
    stage: Stage
    time: np.ndarray
    cell: np.ndarray
    positions: np.ndarray
    Q: np.ndarray
    velocities: np.ndarray | None
    L: np.ndarray | None
    columns: dict[str, np.ndarray]
    tensor: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        return f"<RigidFrames: {len(self)} frames over {self.span:g} ps>"

    @property
    def span(self) -> float:
        """Time from the first frame to the last, ps."""
        return float(self.time[-1] - self.time[0])

    @cached_property
    def interval(self) -> float | None:
        """Time between frames, ps; None if they are not evenly spaced."""
        gaps = np.diff(self.time)
        rounding = 2 * float(np.spacing(np.float32(np.abs(self.time).max())))  # files hold times in single precision
        if len(gaps) == 0 or gaps.min() <= 0 or np.ptp(gaps) > EVEN * gaps.max() + rounding:
            return None
        return self.span / len(gaps)

    @property
    def has_box(self) -> bool:
        return bool(np.isfinite(self.cell[0, 0, 0]))

    @property
    def volume(self) -> np.ndarray:
        """Volume of the cell in each frame (f,), Å³."""
        return np.linalg.det(self.cell)

    @cached_property
    def temperature(self) -> float:
        """Mean temperature of the samples, K."""
        return float(np.mean(self.columns["temperature"]))

    @property
    def thermal_energy(self) -> float:
        """kB T, u Å²/ps²."""
        return BOLTZMANN * self.temperature

    @cached_property
    def kinds(self) -> list[Kind]:
        """The molecules by species, frozen and mobile ones separately."""
        return kinds_of(self.system)

    @property
    def moving(self) -> list[Kind]:
        """The mobile molecules by species."""
        return [kind for kind in self.kinds if kind.moves]

    @cached_property
    def paths(self) -> np.ndarray:
        """Paths of centres (f, n, 3), Å, without scaling by a barostat: sums of displacements in each cell."""
        if not self.has_box or np.ptp(self.cell, axis=0).max() == 0.0:
            return self.positions
        inside = np.einsum("fni,fij->fnj", self.positions, np.linalg.inv(self.cell))
        moves = np.einsum("fni,fij->fnj", np.diff(inside, axis=0), self.cell[1:])
        return np.concatenate([self.positions[:1], self.positions[0] + np.cumsum(moves, axis=0)])

    def sites(self, name: str, frames: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Positions (f, k, 3) of the sites called `name`, and the indices (k,) of their molecules.

        name : of a site (HW1, or HW for HW1 and HW2), element, or species (centres of mass). Raises OutputError.
        """
        at, molecules = [], []
        for kind in self.kinds:
            chosen = np.array(sites_named(kind.molecule, name), int)
            centre = self.positions[frames][:, kind.index]
            if kind.name == name:
                at.append(centre)
                molecules.append(kind.index)
            elif len(chosen):
                offset = kind.molecule.positions_body[chosen]
                arms = np.zeros((1, 1, 1, 3))
                if self.Q.shape[1]:
                    arms = np.einsum("fnij,sj->fnsi", self.Q[frames][:, kind.index], offset)
                at.append((centre[:, :, None] + arms).reshape(len(centre), -1, 3))
                molecules.append(np.repeat(kind.index, len(chosen)))
        if not at:
            species = self.system.species
            known = [*dict.fromkeys([n for m in species for n in m.site_names] + [m.name for m in species])]
            raise OutputError(f"unknown site {name!r}{did_you_mean(name, known) or ';'} there are {', '.join(known)}")
        return np.concatenate(at, axis=1), np.concatenate(molecules)

    def __getitem__(self, frames: slice) -> "RigidFrames":
        """Some of the frames, with all samples."""
        return replace(
            self, time=self.time[frames], cell=self.cell[frames], positions=self.positions[frames], Q=self.Q[frames],
            velocities=None if self.velocities is None else self.velocities[frames],
            L=None if self.L is None else self.L[frames],
        )  # fmt: skip


def sites_named(molecule: Molecule, name: str) -> list[int]:
    """Sites of a molecule with this name, or else with this name before a number, or else of this element."""
    found = [k for k, site in enumerate(molecule.site_names) if site == name]
    found = found or [k for k, site in enumerate(molecule.site_names) if site.rstrip("0123456789") == name]
    return found or [k for k, element in enumerate(molecule.elements) if element == name and name != "X"]


def fit_frames(
    system: System, sites: np.ndarray, velocities: np.ndarray | None, cells: np.ndarray, wrapped: bool,
    progress: Callable[[float], object] = lambda fraction: None,
) -> tuple[Bodies, list[str]]:  # fmt: skip
    """Bodies of frames, each array with a first axis (f,), and notes. Raises OutputError.

    sites (f, s, 3); velocities alike or None; cells (f, 3, 3)
    wrapped : whether centres are wrapped into the box; their paths are made continuous
    progress : called with the fraction done
    """
    fit, n, f = RigidFit(system), len(system.model.species), len(sites)
    rotating = n if len(system.state.rotation) else 0
    position, Q = np.empty((f, n, 3)), np.empty((f, rotating, 3, 3))
    velocity, L = (None, None) if velocities is None else (np.empty((f, n, 3)), np.empty((f, rotating, 3)))
    for k, frame in enumerate(sites):
        try:
            found = fit.bodies(frame, None if velocities is None else velocities[k])
        except OutputError as error:
            raise OutputError(f"frame {k + 1}: {error}") from None
        for array, values in zip((position, Q, velocity, L), found, strict=True):
            if array is not None:
                array[k] = values
        progress((k + 1) / f)
    notes = []
    if wrapped and np.isfinite(cells[0, 0, 0]) and f > 1:
        inside = np.einsum("fni,fij->fnj", position, np.linalg.inv(cells))
        moves = np.diff(inside, axis=0)
        moves -= np.round(moves)
        if (far := float(np.abs(moves).max())) > MAX_WRAPPED_MOVE:
            raise OutputError(
                f"molecules move by {far:.2f} of the box between two frames, in which they are wrapped: their paths "
                "cannot be determined. Write output.positions = 'unwrapped', or frames more often"
            )
        inside[1:] = inside[0] + np.cumsum(moves, axis=0)
        position = np.einsum("fni,fij->fnj", inside, cells)
        notes.append("molecules are wrapped in the frames; their paths were made continuous")
    return Bodies(position, Q, velocity, L), notes
