"""GSD, the format of HOOMD: a rigid body is a central particle, which turns, with constituent particles.

In a file the box lies about the origin and every particle in it, with the number of its image; here the box begins at
the origin, and positions are those of the images. A file is read chunk by chunk: sizes that it promises are compared
with what it holds before anything is made of them.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from math import nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.mechanics.rotation import from_quaternion

#: Time of a frame, ps, for which the schema has no place of its own.
TIME = "time_ps"


class Particles(NamedTuple):
    """The N particles of a frame, in the units of the file; rigidmd writes Å, ps, u and e."""

    step: int
    time: float  # ps; NaN where the file does not tell it
    cell: np.ndarray | None  # (3, 3) rows a, b, c
    label: list[str]  # (N,) names of types
    owner: np.ndarray  # (N,) the central particle of the body that a particle is part of; itself where there is none
    position: np.ndarray  # (N, 3) lab frame, a molecule is whole
    orientation: np.ndarray  # (N, 4) wxyz, of length 1
    velocity: np.ndarray | None  # (N, 3)
    angular_momentum_body: np.ndarray  # (N, 3)
    inertia: np.ndarray  # (N, 3)
    mass: np.ndarray  # (N,)

    @property
    def centres(self) -> np.ndarray:
        """Central particles and those without a body: one for each molecule."""
        return np.flatnonzero(self.owner == np.arange(len(self.owner)))

    @property
    def sites(self) -> np.ndarray:
        """All but the central particles of bodies, molecule by molecule."""
        size = np.bincount(self.owner, minlength=len(self.owner))
        order = np.argsort(self.owner, kind="stable")
        return order[(self.owner[order] != order) | (size[order] == 1)]

    def rotation(self) -> np.ndarray:
        """Q of each molecule (n, 3, 3)."""
        return from_quaternion(self.orientation[self.centres])

    def site_velocities(self) -> np.ndarray | None:
        """Velocities of the sites, those of rigid bodies: HOOMD does not keep those of constituents."""
        if self.velocity is None:
            return None
        inverse = np.divide(1.0, self.inertia, out=np.zeros_like(self.inertia), where=self.inertia > 0)
        body = self.owner[self.sites]
        omega = (self.angular_momentum_body * inverse)[body]
        lab = np.einsum("sij,sj->si", from_quaternion(self.orientation[body]), omega)
        return self.velocity[body] + np.cross(lab, self.position[self.sites] - self.position[body])


class GsdReader:
    """Reads the frames of a file. Its methods raise OSError or ValueError for what cannot be read.

    count : frames
    """

    def __init__(self, path: Path):
        import gsd.fl

        with _refusals():
            self._file: Any = gsd.fl.open(name=str(path), mode="r")
        if self._file.schema != "hoomd":
            self._file.close()
            raise ValueError(f"its schema is {self._file.schema[:30]!r}, must be 'hoomd'")
        self.count: int = self._file.nframes

    def close(self) -> None:
        self._file.close()

    def size(self, frame: int) -> int:
        """Number of particles in a frame."""
        found = self._chunk(frame, "particles/N")
        return 0 if found is None else int(found.flat[0])

    def read(self, frame: int) -> Particles:
        """A frame, 0 for the first."""
        n = self.size(frame)
        position = self._chunk(frame, "particles/position")
        if n < 1 or position is None or position.shape != (n, 3):
            raise ValueError(f"frame {frame + 1} holds no positions of {n} particles")
        of = partial(self._of_particles, frame, n)
        types, kind = self._types(frame), of("typeid", (), 0).astype(int)
        if not 0 <= kind.min() <= kind.max() < len(types):
            raise ValueError(f"frame {frame + 1} has a particle of no type")
        body, own = of("body", (), -1).astype(np.int32).astype(int), np.arange(n)  # -1 is often stored unsigned
        if body.max() >= n:
            raise ValueError(f"frame {frame + 1} has a particle of a body that is not there")
        cell = self._cell(frame)
        position = position.astype(float)
        if cell is not None:
            position += (of("image", (3,), 0) + 0.5) @ cell
        orientation = of("orientation", (4,), (1, 0, 0, 0)).astype(float)
        length = np.linalg.norm(orientation, axis=1, keepdims=True)
        if not (length > 0).all():
            raise ValueError(f"frame {frame + 1} has an orientation that is none")
        orientation /= length
        step, time = self._chunk(frame, "configuration/step"), self._chunk(frame, f"log/{TIME}")
        moving = self._chunk(frame, "particles/velocity") is not None
        return Particles(
            step=0 if step is None else int(step.flat[0]),
            time=nan if time is None or time.size != 1 else float(time.flat[0]),
            cell=cell,
            label=[types[k] for k in kind],
            owner=np.where(body < 0, own, body),
            position=position,
            orientation=orientation,
            velocity=of("velocity", (3,), 0).astype(float) if moving else None,
            angular_momentum_body=_vector_part(orientation, of("angmom", (4,), 0).astype(float)),
            inertia=of("moment_inertia", (3,), 0).astype(float),
            mass=of("mass", (), 1).astype(float),
        )

    def _chunk(self, frame: int, name: str) -> np.ndarray | None:
        """A chunk of a frame, else of the first frame, as the schema says; None without either."""
        with _refusals():
            for k in (frame, 0):
                if self._file.chunk_exists(frame=k, name=name):
                    return self._file.read_chunk(frame=k, name=name)
        return None

    def _of_particles(self, frame: int, n: int, name: str, width: tuple[int, ...], default: Any) -> np.ndarray:
        """A property of all particles (n, *width)."""
        found = self._chunk(frame, f"particles/{name}")
        if found is None:
            return np.broadcast_to(np.asarray(default), (n, *width))
        if found.shape != (n, *width):
            raise ValueError(f"frame {frame + 1}: particles/{name} is of {found.shape}, must be {(n, *width)}")
        return found

    def _types(self, frame: int) -> list[str]:
        found = self._chunk(frame, "particles/types")
        if found is None:
            return ["A"]  # of the schema
        if found.ndim != 2 or found.dtype.itemsize != 1:
            raise ValueError("its names of types are no text")
        return [row.tobytes().split(b"\0", 1)[0].decode("utf-8", errors="replace") for row in found]

    def _cell(self, frame: int) -> np.ndarray | None:
        found = self._chunk(frame, "configuration/box")
        if found is None or not found.any():
            return None
        if found.shape != (6,):
            raise ValueError(f"frame {frame + 1}: its box has {found.shape} numbers, must be 6")
        lx, ly, lz, xy, xz, yz = found.astype(float)
        return np.array([[lx, 0, 0], [xy * ly, ly, 0], [xz * lz, yz * lz, lz]])


def box_of(cell: np.ndarray) -> list[float]:
    """Edges along the axes and tilts, as a file holds a cell (3, 3); all 0 without one."""
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


@contextmanager
def _refusals() -> Iterator[None]:
    """Refusals of the library, which makes room before it looks at the size of the file, as ValueError."""
    try:
        yield
    except (RuntimeError, KeyError, MemoryError) as error:
        raise ValueError(" ".join(str(error).split())) from None
