"""Trajectories of molecules as GSD, which keep rotations and angular momenta: HOOMD's format.

A molecule of several sites is a rigid body as HOOMD has it: a central particle with mass, moments of inertia,
orientation and angular momentum, and its sites as constituent particles. A molecule of one site is a free particle.
"""

import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gsd.fl
import gsd.hoomd
import numpy as np

from rigidmd.core.files import atomic_file, create_empty_file, unreadable_reason
from rigidmd.core.state import State
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.io.connections import charges, connections
from rigidmd.io.formats.gsd import TIME, GsdReader, box_of, momentum_quaternion
from rigidmd.io.write import writing
from rigidmd.mechanics.rotation import to_quaternion
from rigidmd.scene.models import gather_per_molecule

#: Å; a viewer draws the central particle as a dot.
DOT = 0.1
#: What changes from frame to frame, as it is stored.
PLACES = {"position": np.float32, "image": np.int32, "orientation": np.float32}
MOMENTA = {"velocity": np.float32, "angmom": np.float32}


class GsdFile:
    """Writes frames to a file as they come; each is on the disk at once. See `TrajectoryFile` for the arguments.

    The library keeps a table of chunks that moves within the file as it grows. So a run goes on with a copy of the
    frames that a checkpoint knows, which has the bytes of a file that was never left.

    Raises OutputError, here and in every method.
    """

    def __init__(self, path: Path, system: System, velocities: bool, wrapped: bool, kept: Sequence[int] | None = None):
        self._path, self._system = path, system
        self._velocities, self._wrapped = velocities, wrapped
        self._changing = PLACES | MOMENTA if velocities else PLACES
        self._layout()
        self._sum, self._frames, self._kept = 0, 0, kept
        self._file: Any = None
        if kept is not None:
            for _ in self._kept_frames():
                pass
            return
        try:
            create_empty_file(path)
            self._file = gsd.hoomd.open(str(path), "w")
        except (OSError, RuntimeError) as error:
            raise OutputError(f"{path} cannot be written: {_reason(error)}") from None

    @property
    def kept(self) -> tuple[int, int]:
        """Checksum of all frames, which are on the disk, and their number."""
        return self._sum, self._frames

    def write(self, state: State, time: float, step: int) -> None:
        """Add a frame with its own time (ps) and the box."""
        frame = self._frame(state, time, step)
        try:
            self._append(self._file, frame)
        except (OSError, RuntimeError) as error:
            raise OutputError(f"{self._path} cannot be written: {_reason(error)}") from None
        self._sum, self._frames = self._summed(frame), self._frames + 1

    def cut(self) -> None:
        """Leave out the frames that came after the time of `kept`."""
        try:
            with atomic_file(self._path) as temporary, gsd.hoomd.open(str(temporary), "w") as new:
                for frame in self._kept_frames():
                    self._append(new, frame)
            self._file = gsd.hoomd.open(str(self._path), "r+")
        except (OSError, RuntimeError) as error:
            raise OutputError(f"{self._path} cannot be written: {_reason(error)}") from None

    def close(self) -> None:
        """Finish the file."""
        if self._file is not None:
            with writing(self._path):
                self._file.close()

    @staticmethod
    def _append(file: Any, frame: Any) -> None:
        file.append(frame)
        file.file.flush()  # after every frame, or the places of chunks would depend on when

    def _kept_frames(self) -> Iterator[Any]:
        """The frames that a checkpoint knows, one after the other. Raises OutputError if they have changed."""
        self._sum, (kept_sum, self._frames) = 0, self._kept or (0, 0)
        try:
            if fault := unreadable_reason(self._path):
                raise ValueError(fault)
            reader, sizes = GsdReader(self._path), {len(self._constant["mass"])}
            if reader.count < self._frames or not {reader.size(k) for k in range(self._frames)} <= sizes:
                raise ValueError(f"{self._frames} frames of {sizes.pop()} particles are needed")
            reader.close()
            with gsd.hoomd.open(str(self._path), "r") as old:
                for k in range(self._frames):
                    frame = old[k]
                    self._sum = self._summed(frame)
                    yield frame
        except (ValueError, RuntimeError, KeyError, OSError) as error:
            raise OutputError(f"{self._path} cannot be read to continue it: {_reason(error)}") from None
        if self._sum != kept_sum:
            raise OutputError(f"{self._path} has changed or is damaged: its checksum is not that of what was written")

    def _layout(self) -> None:
        """What is the same in every frame: molecules first, then the sites of those that have several."""
        system = self._system
        molecule, species = system.sites.molecule, system.model.species
        single = np.bincount(molecule) == 1
        n = len(single)
        constituent = ~single[molecule]
        self._constituent = np.flatnonzero(constituent)
        particle = np.where(constituent, n + np.cumsum(constituent) - 1, molecule)  # of each site
        of_site = self._labels()
        names = [m.name if m.name not in of_site else f"{m.name}_body" for m in system.species]
        label = np.array([names[k] for k in species] + [""] * len(self._constituent), dtype=object)
        label[particle] = of_site
        types = list(dict.fromkeys(label.tolist()))
        mass = np.array([m.mass for m in system.species])[species]
        moments = np.array([m.inertia for m in system.species])[species]
        charge = np.zeros(len(label))
        charge[particle] = charges(system)
        drawn = set(label[:n][~single])
        self._constant: dict[str, Any] = {
            "types": types,
            "typeid": np.array([types.index(name) for name in label]),
            "type_shapes": [{"type": "Sphere", "diameter": DOT} if name in drawn else {} for name in types],
            "body": np.concatenate([np.where(single, -1, np.arange(n)), molecule[constituent]]),
            "mass": np.concatenate([mass, system.sites.mass[constituent]]),
            "charge": charge,
            "moment_inertia": np.vstack([moments, np.zeros((len(self._constituent), 3))]),
        }
        self._bonds = particle[connections(system)]

    def _labels(self) -> np.ndarray:
        """Type of each site (s,): its element, or name without one; with the species if others interact otherwise."""
        names, of_scene, of_species = [], defaultdict(set), defaultdict(set)
        for m in self._system.species:
            names.append([name if e == "X" else e for e, name in zip(m.elements, m.site_names, strict=True)])
            for name, *kind in zip(names[-1], m.masses, m.charges, m.sigma, m.epsilon, strict=True):
                of_scene[name].add(tuple(kind))
                of_species[m.name, name].add(tuple(kind))

        def label(species: str, name: str, site: str) -> str:
            if len(of_scene[name]) == 1:
                return name
            return f"{species}.{name if len(of_species[species, name]) == 1 else site}"

        labels = [
            np.array([label(m.name, *both) for both in zip(own, m.site_names, strict=True)], dtype=object)
            for m, own in zip(self._system.species, names, strict=True)
        ]
        return gather_per_molecule(labels, self._system.model.species)

    def _frame(self, state: State, time: float, step: int) -> Any:
        system, sites = self._system, self._constituent
        owner, n = system.sites.molecule[sites], len(state.position)
        turned = to_quaternion(state.rotation) if len(state.rotation) else np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        where = np.vstack([system.centres(state, self._wrapped), system.site_positions(state, self._wrapped)[sites]])
        position, image = _inside(state.cell, where)
        found = {"position": position, "image": image}
        found["orientation"] = np.vstack([turned, turned[owner]])
        if self._velocities:
            found["velocity"] = np.vstack([state.velocity, system.site_velocities(state)[sites]])
            momentum = np.zeros((n + len(sites), 4))
            if len(state.rotation):
                momentum[:n] = momentum_quaternion(turned, state.angular_momentum_body)
            found["angmom"] = momentum
        frame: Any = gsd.hoomd.Frame()
        frame.configuration.step = step
        frame.configuration.dimensions = 3
        frame.configuration.box = np.array(box_of(state.cell), np.float32)
        frame.log[TIME] = np.array([time])
        frame.particles.N, frame.bonds.N = len(where), len(self._bonds)
        for name, values in found.items():
            # as it is stored: what is compared with the first frame, to be left out if it is the same
            setattr(frame.particles, name, values.astype(self._changing[name]))
        if self._frames == 0:
            for name, values in self._constant.items():
                setattr(frame.particles, name, values)
            frame.bonds.types, frame.bonds.group = ["bond"], self._bonds
            frame.bonds.typeid = np.zeros(len(self._bonds), int)
        return frame

    def _summed(self, frame: Any) -> int:
        """CRC-32 of the frames so far and this one."""
        found = zlib.crc32(np.asarray(frame.configuration.box, np.float32).tobytes(), self._sum)
        found = zlib.crc32(np.asarray(frame.log[TIME], float).tobytes(), found)
        for name, kind in self._changing.items():
            found = zlib.crc32(np.ascontiguousarray(getattr(frame.particles, name), kind).tobytes(), found)
        return found


def _inside(cell: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) in the box about the origin, and the numbers (N, 3) of their images."""
    if not np.isfinite(cell).all():
        return position, np.zeros(position.shape, np.int32)
    image = np.floor(np.linalg.solve(cell.T, position.T).T)
    return position - (image + 0.5) @ cell, image.astype(np.int32)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or " ".join(str(error).split())
