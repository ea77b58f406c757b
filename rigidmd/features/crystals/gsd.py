"""GSD, the format of HOOMD: trajectories of molecules with rotations and angular momenta.

A molecule of several sites is a rigid body as in HOOMD: a central particle with mass, moments of
inertia, orientation and angular momentum, and its sites as constituent particles. A molecule of one
site is a free particle. In a file the box is centred at the origin and particles are wrapped, with
their image numbers. Here the box starts at the origin and positions are unwrapped. Files are read
chunk by chunk by `gsd.fl`, and sizes are checked before arrays are allocated: `gsd.hoomd` allocates
what a damaged file states, and has defaults for what a file lacks. MDAnalysis reads neither
orientations nor angular momenta.
"""

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import partial
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from rigidmd.core.state import State
from rigidmd.formats import Format, register
from rigidmd.formats.atoms import SAME_MASS, Atoms, Frame, names_of_types, structure_error
from rigidmd.formats.bonds import connections
from rigidmd.formats.cells import make_whole
from rigidmd.formats.frame_file import FrameFile
from rigidmd.formats.systems import MolecularSystem, Species
from rigidmd.formats.through_mdanalysis import index_of
from rigidmd.mechanics.rotation import from_quaternion, to_quaternion

if TYPE_CHECKING:
    from gsd.hoomd import Frame as HoomdFrame
    from gsd.hoomd import HOOMDTrajectory

#: Distance, Å, between particles at one position.
COINCIDENT = 1e-3
#: Logged quantity with the time of a frame, ps, which the schema lacks.
TIME = "time_ps"


class Particles(NamedTuple):
    """The N particles of a frame, in the units of the file. rigidmd writes Å, ps, u and e."""

    step: int
    time: float  # ps; NaN if the file does not have it
    cell: np.ndarray | None  # (3, 3) rows a, b, c
    label: list[str]  # (N,) names of types
    body: np.ndarray  # (N,) number of the body; of the particle itself without a body
    #: (N,) index of the central particle of the body; of the particle itself without one
    owner: np.ndarray
    position: np.ndarray  # (N, 3) lab frame, molecules whole
    orientation: np.ndarray  # (N, 4) wxyz, normalised
    velocity: np.ndarray | None  # (N, 3)
    angular_momentum_body: np.ndarray  # (N, 3)
    inertia: np.ndarray  # (N, 3)
    mass: np.ndarray  # (N,)

    @property
    def site_masses(self) -> np.ndarray | None:
        """Masses of the sites (s,), if the masses in each body add up to the mass of its central
        particle: HOOMD does not use masses of constituents, which may have any value."""
        sites = self.sites
        body = self.owner[self.sites]
        total = np.bincount(body, self.mass[sites], len(self.owner))
        centres = np.unique(body)
        agrees = np.abs(total[centres] - self.mass[centres]) <= SAME_MASS * self.mass[centres]
        return self.mass[sites] if agrees.all() and np.ptp(self.mass[sites]) > 0 else None

    @property
    def centres(self) -> np.ndarray:
        """Indices of central particles and particles without one."""
        return np.flatnonzero(self.owner == np.arange(len(self.owner)))

    @property
    def sites(self) -> np.ndarray:
        """Indices of all particles except the central ones of bodies, molecule by molecule."""
        size = np.bincount(self.owner, minlength=len(self.owner))
        order = np.argsort(self.body, kind="stable")
        return order[(self.owner[order] != order) | (size[order] == 1)]

    def rotation(self) -> np.ndarray:
        return from_quaternion(self.orientation[self.centres])

    def site_velocities(self) -> np.ndarray | None:
        """Velocities of the sites, from the rigid bodies, because HOOMD stores none of
        constituents."""
        if self.velocity is None:
            return None
        inverse = np.divide(
            1.0, self.inertia, out=np.zeros_like(self.inertia), where=self.inertia > 0
        )
        body = self.owner[self.sites]
        omega = (self.angular_momentum_body * inverse)[body]
        lab = np.einsum("sij,sj->si", from_quaternion(self.orientation[body]), omega)
        return self.velocity[body] + np.cross(lab, self.position[self.sites] - self.position[body])


class GsdReader:
    """Reads the frames of a file. Methods raise OSError or ValueError. `count` is the number of
    frames."""

    def __init__(self, path: Path):
        import gsd.fl

        with _refusals():
            self._file = gsd.fl.open(name=str(path), mode="r")
        if self._file.schema != "hoomd":
            self._file.close()
            raise ValueError(f"its schema is {self._file.schema[:30]!r}, must be 'hoomd'")
        self.count: int = self._file.nframes

    def close(self) -> None:
        self._file.close()

    def size(self, frame: int) -> int:
        count = self._chunk(frame, "particles/N")
        return 0 if count is None else int(count.flat[0])

    def read(self, frame: int) -> Particles:
        """A frame, 0 for the first."""
        n = self.size(frame)
        position = self._chunk(frame, "particles/position")
        if n < 1 or position is None or position.shape != (n, 3):
            raise ValueError(f"frame {frame + 1} holds no positions of {n} particles")
        of = partial(self._of_particles, frame, n)
        # the default of the schema
        types = ["A"]
        kind = of("typeid", (), 0).astype(int)
        if (names := self._chunk(frame, "particles/types")) is not None:
            if names.ndim != 2 or names.dtype.itemsize != 1:
                raise ValueError("its names of types are not text")
            types = [
                row.tobytes().split(b"\0", 1)[0].decode("utf-8", errors="replace") for row in names
            ]
        if not 0 <= kind.min() <= kind.max() < len(types):
            raise ValueError(f"frame {frame + 1} has a particle without a type")
        body = of("body", (), -1).astype(np.int32).astype(int)  # -1 is often stored unsigned
        if body.max() >= n:
            raise ValueError(f"frame {frame + 1} has a particle of a body that does not exist")
        body = np.where(body < 0, np.arange(n), body)
        position = position.astype(float)
        box = self._chunk(frame, "configuration/box")
        cell = None
        if box is not None and box.any():
            if box.shape != (6,):
                raise ValueError(f"frame {frame + 1}: its box has {box.shape} numbers, must be 6")
            lx, ly, lz, xy, xz, yz = box.astype(float)
            cell = np.array([[lx, 0, 0], [xy * ly, ly, 0], [xz * lz, yz * lz, lz]])
            position += (of("image", (3,), 0) + 0.5) @ cell
            if self._chunk(frame, "particles/image") is None:
                position = _whole_bodies(position, body, cell)
        orientation = of("orientation", (4,), (1, 0, 0, 0)).astype(float)
        length = np.linalg.norm(orientation, axis=1, keepdims=True)
        if not (length > 0).all():
            raise ValueError(f"frame {frame + 1} has an orientation of length 0")
        orientation /= length
        step = self._chunk(frame, "configuration/step")
        time = self._chunk(frame, f"log/{TIME}")
        inertia = of("moment_inertia", (3,), 0).astype(float)
        moving = self._chunk(frame, "particles/velocity") is not None
        return Particles(
            step=0 if step is None else int(step.flat[0]),
            time=nan if time is None or time.size != 1 else float(time.flat[0]),
            cell=cell,
            label=[types[k] for k in kind],
            body=body,
            owner=_owners(body, position, inertia),
            position=position,
            orientation=orientation,
            velocity=of("velocity", (3,), 0).astype(float) if moving else None,
            angular_momentum_body=_vector_part(orientation, of("angmom", (4,), 0).astype(float)),
            inertia=inertia,
            mass=of("mass", (), 1).astype(float),
        )

    def frame(self, k: int) -> Frame:
        snapshot = self.read(k)
        where = snapshot.position[snapshot.sites]
        return Frame(
            snapshot.time,
            where,
            snapshot.cell,
            snapshot.site_velocities(),
            snapshot.rotation(),
            snapshot.step,
        )

    @property
    def sites(self) -> int:
        """Number of sites in the first frame."""
        return len(self.read(0).sites)

    def _chunk(self, frame: int, name: str) -> np.ndarray | None:
        """A chunk of a frame, else of the first frame (see the schema). None without either."""
        with _refusals():
            for k in (frame, 0):
                if self._file.chunk_exists(frame=k, name=name):
                    return self._file.read_chunk(frame=k, name=name)
        return None

    def _of_particles(
        self, frame: int, n: int, name: str, width: tuple[int, ...], default: ArrayLike
    ) -> np.ndarray:
        """A property of all particles (n, *width)."""
        values = self._chunk(frame, f"particles/{name}")
        if values is None:
            return np.broadcast_to(np.asarray(default), (n, *width))
        if values.shape != (n, *width):
            raise ValueError(
                f"frame {frame + 1}: particles/{name} is of {values.shape}, must be {(n, *width)}"
            )
        return values


def _owners(body: np.ndarray, position: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """The central particle (N,) of each particle, itself without one. A body has one if the
    particle of its number has moments of inertia, or is where one of the others is, which then has
    all mass, else it consists of sites alone."""
    index = np.arange(len(body))
    others = index[body != index]
    nearest = np.full(len(body), np.inf)
    np.minimum.at(
        nearest, body[others], np.linalg.norm(position[others] - position[body[others]], axis=1)
    )
    is_central = np.isfinite(nearest) & (inertia.any(axis=1) | (nearest <= COINCIDENT))
    return np.where(is_central[body], body, index)


def _whole_bodies(position: np.ndarray, body: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Positions (N, 3) of a file without image numbers, in which the particles of each body are
    near each other."""
    position = position.copy()
    size = np.bincount(body, minlength=len(body))
    order = np.argsort(body, kind="stable")
    for count in np.unique(size[size > 1]):
        members = order[size[body[order]] == count].reshape(-1, count)
        position[members] = make_whole(position[members], cell, np.zeros((count, count)))
    return position


def box_of(cell: np.ndarray) -> list[float]:
    """A cell (3, 3) as edges along the axes and tilts. All 0 without a cell."""
    if not np.isfinite(cell).all():
        return [0.0] * 6
    (lx, _, _), (bx, ly, _), (cx, cy, lz) = cell
    return [lx, ly, lz, bx / ly, cx / lz, cy / lz]


def momentum_quaternion(orientation: np.ndarray, angular_momentum_body: np.ndarray) -> np.ndarray:
    """HOOMD's form of an angular momentum (n, 3) in the body frame: 2 q (0, L), (n, 4) wxyz."""
    w, v = orientation[:, :1], orientation[:, 1:]
    real = -np.einsum("ni,ni->n", v, angular_momentum_body)[:, None]
    return 2 * np.hstack([real, w * angular_momentum_body + np.cross(v, angular_momentum_body)])


def _vector_part(orientation: np.ndarray, momentum: np.ndarray) -> np.ndarray:
    """The angular momentum (n, 3) of `momentum_quaternion`: the vector of q* p / 2."""
    w, v = orientation[:, :1], -orientation[:, 1:]
    return (w * momentum[:, 1:] + momentum[:, :1] * v + np.cross(v, momentum[:, 1:])) / 2


@contextlib.contextmanager
def _refusals() -> Iterator[None]:
    """Within it, errors of the library become ValueError. It allocates arrays before it checks the
    size of the file."""
    try:
        yield
    except (RuntimeError, KeyError, MemoryError) as error:
        raise ValueError(" ".join(str(error).split())) from None


#: Diameter, Å, of central particles in viewers.
DOT = 0.1


class GsdFile(FrameFile["HOOMDTrajectory", "HoomdFrame"]):
    def __init__(
        self,
        path: Path,
        system: MolecularSystem,
        velocities: bool,
        wrapped: bool,
        kept: Sequence[int] | None = None,
    ):
        """Set the constant properties. Particles are molecules, then the sites of molecules with
        several sites."""
        self._changing = [
            "position",
            "image",
            "orientation",
            *(("velocity", "angmom") if velocities else ()),
        ]
        molecule, species = system.sites.molecule, system.model.species
        single = np.bincount(molecule) == 1
        n = len(single)
        constituent = ~single[molecule]
        self._constituent = np.flatnonzero(constituent)
        particle = np.where(constituent, n + np.cumsum(constituent) - 1, molecule)  # of each site
        site_labels = _labels(system)
        names = [m.name if m.name not in site_labels else f"{m.name}_body" for m in system.species]
        label = np.array([names[k] for k in species] + [""] * len(self._constituent), dtype=object)
        label[particle] = site_labels
        types = list(dict.fromkeys(label.tolist()))
        mass = np.array([m.mass for m in system.species])[species]
        moments = np.array([m.inertia for m in system.species])[species]
        charge = np.zeros(len(label))
        charge[particle] = system.of_sites(lambda m: m.charges)
        central = set(label[:n][~single])
        self._constant = {
            "types": types,
            "typeid": np.array([types.index(name) for name in label]),
            "type_shapes": [
                {"type": "Sphere", "diameter": DOT} if name in central else {} for name in types
            ],
            "body": np.concatenate([np.where(single, -1, np.arange(n)), molecule[constituent]]),
            "mass": np.concatenate([mass, system.sites.mass[constituent]]),
            "charge": charge,
            "moment_inertia": np.vstack([moments, np.zeros((len(self._constituent), 3))]),
        }
        self._bonds = particle[connections(system)]
        super().__init__(path, system, velocities, wrapped, kept)

    def _open(self, path: Path, mode: str) -> "HOOMDTrajectory":
        import gsd.hoomd  # slow to import

        return gsd.hoomd.open(str(path), "r+" if mode == "a" else mode)  # pyright: ignore[reportArgumentType]

    def _append(self, file: "HOOMDTrajectory", frame: "HoomdFrame") -> None:
        file.append(frame)
        # after every frame, so that offsets of chunks do not depend on the time of a flush
        file.file.flush()

    def _stored_frames(self, count: int) -> "Iterator[HoomdFrame]":
        with contextlib.closing(GsdReader(self._path)) as reader:
            particles = len(self._constant["mass"])
            if reader.count < count or not {reader.size(k) for k in range(count)} <= {particles}:
                raise ValueError(f"{count} frames of {particles} particles are needed")
        with self._open(self._path, "r") as old:
            for k in range(count):
                yield cast("HoomdFrame", old[k])

    def _frame(self, state: State, time: float, step: int) -> "HoomdFrame":
        import gsd.hoomd

        system, sites = self._system, self._constituent
        owner = system.sites.molecule[sites]
        n = len(state.position)
        if len(state.rotation):
            orientation = to_quaternion(state.rotation)
        else:
            orientation = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        position = np.vstack(
            [
                system.centres(state, self._wrapped),
                system.site_positions(state, self._wrapped)[sites],
            ]
        )
        image = np.zeros(position.shape)
        if np.isfinite(state.cell).all():
            image = np.floor(np.linalg.solve(state.cell.T, position.T).T)
            # in the box that is centred at the origin
            position = position - (image + 0.5) @ state.cell
        properties = {
            "position": position,
            "image": image,
            "orientation": np.vstack([orientation, orientation[owner]]),
        }
        if self._velocities:
            properties["velocity"] = np.vstack(
                [state.velocity, system.site_velocities(state)[sites]]
            )
            properties["angmom"] = np.zeros((n + len(sites), 4))
            if len(state.rotation):
                properties["angmom"][:n] = momentum_quaternion(
                    orientation, state.angular_momentum_body
                )
        frame: Any = gsd.hoomd.Frame()  # its attributes have no types
        frame.configuration.step = step
        frame.configuration.dimensions = 3
        frame.configuration.box = np.array(box_of(state.cell), np.float32)
        frame.log[TIME] = np.array([time])
        frame.particles.N, frame.bonds.N = len(position), len(self._bonds)
        for name, values in properties.items():
            # in the type of the file, because the library compares it with the first frame and
            # leaves equal chunks out
            setattr(
                frame.particles, name, values.astype(np.int32 if name == "image" else np.float32)
            )
        if self._frames == 0:
            for name, values in self._constant.items():
                setattr(frame.particles, name, values)
            frame.bonds.types, frame.bonds.group = ["bond"], self._bonds
            frame.bonds.typeid = np.zeros(len(self._bonds), int)
        return frame

    def _arrays(self, frame: "HoomdFrame") -> list[np.ndarray]:
        return [
            np.asarray(frame.configuration.box),
            frame.log[TIME],
            *(getattr(frame.particles, name) for name in self._changing),
        ]


def _labels(system: MolecularSystem) -> np.ndarray:
    """Type of each site (s,): its element, or its name without element, with the species if it is
    ambiguous."""
    kinds = defaultdict(set)  # properties of sites by name, and by species and name

    def names_of(m: Species) -> list[str]:
        return [name if e == "X" else e for e, name in zip(m.elements, m.site_names, strict=True)]

    for m in system.species:
        for name, *kind in zip(names_of(m), m.masses, m.charges, m.sigma, m.epsilon, strict=True):
            kinds[name].add(tuple(kind))
            kinds[m.name, name].add(tuple(kind))

    def labels(m: Species) -> np.ndarray:
        labels_of_sites = []
        for name, site in zip(names_of(m), m.site_names, strict=True):
            in_species = f"{m.name}.{name if len(kinds[m.name, name]) == 1 else site}"
            labels_of_sites.append(name if len(kinds[name]) == 1 else in_species)
        return np.array(labels_of_sites, object)

    return system.of_sites(labels)


def read_frame(path: Path, frame: int, atom_types: dict[str, str] | None = None) -> Atoms:
    """The molecules of one frame of a GSD file."""
    try:
        with contextlib.closing(GsdReader(path)) as reader:
            snapshot = reader.read(index_of(reader.count, frame))
    except (OSError, ValueError) as error:
        raise structure_error(path, f"cannot be read as a trajectory: {error}") from None
    sites = snapshot.sites
    types = [snapshot.label[site] for site in sites]
    names = {label: label.rsplit(".", 1)[-1] for label in types}  # a type may be species.name
    # a body is named by the type of its central particle
    is_named = np.isin(
        np.arange(len(snapshot.body)),
        snapshot.body[sites][snapshot.owner[sites] == snapshot.body[sites]],
    )
    residue = [
        (int(body) + 1, snapshot.label[body] if is_named[body] else "")
        for body in snapshot.body[sites]
    ]
    return Atoms(
        names_of_types(path, types, [], names, atom_types),
        [""] * len(types),
        residue,
        snapshot.position[sites],
        snapshot.site_velocities(),
        snapshot.cell,
        snapshot.site_masses if atom_types is None else None,
    )


register(
    Format(
        (".gsd",),
        read_frame=read_frame,
        has_types=True,
        writer=GsdFile,
        reader=GsdReader,
        velocities=True,
        rotations=True,
        viewer="ovito {trajectory}",
    )
)
