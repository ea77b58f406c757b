"""The film of a single body: what is drawn at each time, in units of the picture, for a page and for film files."""

from typing import NamedTuple

import numpy as np

from rigidmd.engines.body_motion import drawn_axis
from rigidmd.figures.style import thin_path
from rigidmd.run.record import Record
from rigidmd.view.mesh import Mesh, mesh_of

#: Samples in a film at most; points of the path that is drawn at most.
MOST, MOST_POINTS = 20_000, 3000
#: The sphere around a turning body and its reach; least share of the picture that a flying body fills.
SPHERE, LEAST = 1.2, 0.07
#: A body whose centre moves by less than this share of its reach stays where it is.
STAYS = 0.05
#: Length of the longest L and omega, and of gravity, as a share of the sphere or of the picture.
VECTOR, DOWN = {True: 1.0, False: 0.45}, {True: 0.45, False: 0.3}


class BodyFilm(NamedTuple):
    """Lengths in units of the picture's half width, about its centre; (t,) samples.

    path (p, 3) and when (p,): the axis on the sphere, or the centre of mass; sphere: its radius, 0 without one
    vectors : name -> (t, 3), and largest : name -> largest size with its unit
    """

    time: np.ndarray
    position: np.ndarray  # (t, 3) of the pivot or the centre of mass
    quaternion: np.ndarray  # (t, 4) w, x, y, z, without jumps of sign
    angles: np.ndarray  # (t, 3) phi, theta, psi, degrees; empty of a point
    mesh: Mesh
    path: np.ndarray
    when: np.ndarray
    sphere: float
    vectors: dict[str, np.ndarray]
    largest: dict[str, str]
    gravity: np.ndarray | None  # (3,)
    centre: np.ndarray  # (3,) centre of mass in the body's axes
    unit: float  # m
    axis: np.ndarray  # (3,) the body axis whose path is drawn
    azimuth: float  # of the eye, rad
    told: list[str]  # what was thinned out or enlarged


def body_film(record: Record) -> BodyFilm:
    """The film of a run of a single body."""
    system, seen = record.body, record.columns
    count = len(record.time)
    stride = -(-count // MOST)
    rows = np.arange(0, count, stride)
    told = [f"{len(rows)} of {count} samples are in this film: every {stride}th."] if stride > 1 else []
    mesh = mesh_of(system)
    told.append(f"The body is drawn as {mesh.about}.")
    place = _stack(seen, "xyz")[rows] if system.flies else np.zeros((len(rows), 3))
    turns = system.turns and "qw" in seen
    middle = (place.max(0) + place.min(0)) / 2
    extent = float(np.linalg.norm(place - middle, axis=1).max())
    flies = extent > STAYS * (mesh.reach if turns else 0.0)
    radius = SPHERE * mesh.reach
    if flies:
        enlarged = max(1.0, LEAST * extent / mesh.reach) if turns else LEAST * extent / mesh.reach
        unit = 1.05 * extent + mesh.reach * enlarged
        if turns and enlarged > 1:
            told.append(f"The body is drawn {enlarged:.3g} times as large as it is beside its path.")
    else:
        enlarged, unit, place = 1.0, 1.08 * radius, np.zeros_like(place)
    quaternion = np.stack([seen[key][rows] for key in ("qw", "qx", "qy", "qz")], -1) if turns else _still(len(rows))
    path = (place - middle) / unit if flies else radius / unit * _axis(record)[rows]
    shown = thin_path(path, MOST_POINTS)
    vectors, largest = {}, {}
    for name, key, size in (("L", "L_lab", "kg m²/s"), ("ω", "omega_lab", "rad/s")):
        if turns and f"{key}_x" in seen:
            found = np.stack([seen[f"{key}_{k}"][rows] for k in "xyz"], axis=-1)
            longest = float(np.linalg.norm(found, axis=1).max())
            if longest > 0:
                scale = VECTOR[not flies] * (1.0 if flies else radius / unit) / longest
                vectors[name], largest[name] = scale * found, f"{longest:.4g} {size}"
    gravity = system.scene.gravity and np.array(system.scene.gravity.acceleration_m_s2, float)
    down = None
    if gravity is not None and gravity.any():
        down = DOWN[not flies] * gravity / np.linalg.norm(gravity)
    return BodyFilm(
        time=record.time[rows],
        position=(place - middle) / unit if flies else place,
        quaternion=quaternion,
        angles=np.degrees(np.stack([seen[key][rows] for key in ("phi", "theta", "psi")], -1)) if turns else np.empty(0),
        mesh=mesh._replace(vertices=mesh.vertices * enlarged / unit),
        path=path[shown],
        when=record.time[rows][shown],
        sphere=0.0 if flies else radius / unit,
        vectors=vectors,
        largest=largest,
        gravity=down,
        centre=system.centre * enlarged / unit,
        unit=unit,
        axis=drawn_axis(system),
        azimuth=float(np.arctan2(path[0, 1], path[0, 0])) - 0.6 if np.hypot(*path[0, :2]) > 1e-9 else 0.6,
        told=told,
    )


def _stack(seen: dict[str, np.ndarray], keys: str) -> np.ndarray:
    return np.stack([seen[key] for key in keys], axis=-1)


def _still(count: int) -> np.ndarray:
    return np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))


def _axis(record: Record) -> np.ndarray:
    """The body axis whose path is drawn, in the lab (t, 3)."""
    axis = drawn_axis(record.body)
    return np.stack([sum(record.columns[f"q{i}{j + 1}"] * axis[j] for j in range(3)) for i in (1, 2, 3)], axis=-1)
