"""The animation of a single body: its data in units of the picture, for pages and files, and drawing by Matplotlib."""

from typing import NamedTuple

import numpy as np

from rigidmd.engines.body_motion import drawn_axis
from rigidmd.figures.style import COOL, FAINT, INK, WARM, camera, circle, thin_path
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.run.record import Record
from rigidmd.view.mesh import Mesh, mesh_of

#: Most samples of an animation, most points of the drawn path.
MOST_SAMPLES, MOST_POINTS = 20_000, 3000
#: Radius of the sphere around a body, in its reach; least fraction of the picture that a moving body fills.
SPHERE, MIN_BODY_FRACTION = 1.2, 0.07
#: A body whose centre moves by less than this fraction of its reach is drawn at rest.
FIXED_FRACTION = 0.05
#: Length of the longest L and omega, and of gravity, in radii of the sphere (True) or in the unit of the picture.
VECTOR_LENGTH, GRAVITY_LENGTH = {True: 1.0, False: 0.45}, {True: 0.45, False: 0.3}


class BodyAnimation(NamedTuple):
    """Lengths in units of the picture's half width, about its centre; (t,) samples.

    path (p, 3) and when (p,): the axis on the sphere, or the centre of mass; sphere: its radius, 0 without one
    vectors : name -> (t, 3), and largest : name -> largest size with its unit
    """

    time: np.ndarray
    position: np.ndarray  # (t, 3) of the pivot or the centre of mass
    quaternion: np.ndarray  # (t, 4) w, x, y, z, without jumps of sign
    angles: np.ndarray  # (t, 3) phi, theta, psi, degrees; empty for a point
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
    notes: list[str]  # on thinning and enlargement


def animate_body(record: Record) -> BodyAnimation:
    system, seen = record.body, record.columns
    count = len(record.time)
    stride = -(-count // MOST_SAMPLES)
    rows = np.arange(0, count, stride)
    notes = [f"{len(rows)} of {count} samples are shown: every {stride}th."] if stride > 1 else []
    mesh = mesh_of(system)
    notes.append(f"The body is drawn as {mesh.about}.")
    position = np.stack([seen[key][rows] for key in "xyz"], -1) if system.translates else np.zeros((len(rows), 3))
    turns = system.rotates and "qw" in seen
    middle = (position.max(0) + position.min(0)) / 2
    extent = float(np.linalg.norm(position - middle, axis=1).max())
    moves = extent > FIXED_FRACTION * (mesh.reach if turns else 0.0)
    radius = SPHERE * mesh.reach
    if moves:
        enlarged = MIN_BODY_FRACTION * extent / mesh.reach
        enlarged = max(1.0, enlarged) if turns else enlarged
        unit = 1.05 * extent + mesh.reach * enlarged
        if turns and enlarged > 1:
            notes.append(f"The body is drawn {enlarged:.3g} times as large as it is relative to its path.")
    else:
        enlarged, unit, position = 1.0, 1.08 * radius, np.zeros_like(position)
    quaternion = (
        np.stack([seen[key][rows] for key in ("qw", "qx", "qy", "qz")], -1)
        if turns
        else np.tile([1.0, 0, 0, 0], (len(rows), 1))
    )
    path = (position - middle) / unit if moves else radius / unit * _axis(record)[rows]
    shown = thin_path(path, MOST_POINTS)
    vectors, largest = {}, {}
    for name, key, size in (("L", "L_lab", "kg m²/s"), ("ω", "omega_lab", "rad/s")):
        if turns and f"{key}_x" in seen:
            found = np.stack([seen[f"{key}_{k}"][rows] for k in "xyz"], axis=-1)
            longest = float(np.linalg.norm(found, axis=1).max())
            if longest > 0:
                scale = VECTOR_LENGTH[not moves] * (1.0 if moves else radius / unit) / longest
                vectors[name], largest[name] = scale * found, f"{longest:.4g} {size}"
    gravity = system.scene.gravity and np.array(system.scene.gravity.acceleration_m_s2, float)
    down = None
    if gravity is not None and gravity.any():
        down = GRAVITY_LENGTH[not moves] * gravity / np.linalg.norm(gravity)
    angles = np.degrees(np.stack([seen[key][rows] for key in ("phi", "theta", "psi")], -1)) if turns else np.empty(0)
    azimuth = float(np.arctan2(path[0, 1], path[0, 0])) - 0.6 if np.hypot(*path[0, :2]) > 1e-9 else 0.6
    return BodyAnimation(
        time=record.time[rows], position=(position - middle) / unit if moves else position, quaternion=quaternion,
        angles=angles, mesh=mesh._replace(vertices=mesh.vertices * enlarged / unit), path=path[shown],
        when=record.time[rows][shown], sphere=0.0 if moves else radius / unit, vectors=vectors, largest=largest,
        gravity=down, centre=system.centre * enlarged / unit, unit=unit, axis=drawn_axis(system), azimuth=azimuth,
        notes=notes,
    )  # fmt: skip


def _axis(record: Record) -> np.ndarray:
    """The body axis whose path is drawn, in the lab (t, 3)."""
    axis = drawn_axis(record.body)
    return np.stack([sum(record.columns[f"q{i}{j + 1}"] * axis[j] for j in range(3)) for i in (1, 2, 3)], axis=-1)


#: Height of the eye above the horizon, rad; colours of a body's sides, painted or not, and of vectors.
LIFT = 0.35
SIDES = np.array([[0.31, 0.58, 0.77], [0.85, 0.41, 0.31]])
VECTORS = {"L": "#7a5ca3", "ω": "#b8862d"}
#: Labels of vectors that coincide are to the left and to the right of them.
LABEL_SIDE = {"L": 0.05, "ω": -0.05}
ARROW = {"arrowstyle": "-|>,head_width=0.25,head_length=0.5", "lw": 2, "shrinkA": 0, "shrinkB": 0}
UP = np.array([0.0, 0.0, 1.0])


class BodyDrawing:
    """Draws a body at the times of an animation."""

    def __init__(self, animation: BodyAnimation, pinned: bool):
        self._animation, self._pinned = animation, pinned
        level = np.array([np.cos(animation.azimuth), np.sin(animation.azimuth), 0.0])
        self._view = camera(np.cos(LIFT) * level + np.sin(LIFT) * UP, UP)
        self._rings = np.zeros((0, 3))
        if animation.sphere:
            around = [circle(np.array([np.cos(a), np.sin(a), 0.0])) for a in np.radians(np.arange(0, 180, 30))]
            rings = [*around, *(circle(UP, p) for p in range(30, 180, 30))]
            self._rings = animation.sphere * np.concatenate([np.vstack([ring, np.full(3, np.nan)]) for ring in rings])

    def draw(self, axes, time: float) -> None:
        """Draw a time into axes, which are cleared."""
        from matplotlib.patches import Circle

        animation, view = self._animation, self._view
        axes.clear()
        axes.set(xlim=(-1.08, 1.08), ylim=(-1.08, 1.08), aspect="equal")
        axes.set_axis_off()
        rotation, origin = self._pose(time)
        centre = origin + rotation @ animation.centre
        past = animation.path[animation.when <= time]
        if animation.sphere:
            tip = animation.sphere * rotation @ animation.axis
            past = np.concatenate([past, tip[None]])
            axes.add_patch(Circle((0, 0), animation.sphere, fc=FAINT, alpha=0.08, lw=0))
            self._curve(axes, self._rings, (0.4, 0.15), color=FAINT, lw=0.5)
            self._curve(axes, animation.path, (0.25, 0.08), color=COOL, lw=0.9)
            self._curve(axes, past, (0.95, 0.3), color=COOL, lw=1.7)
            toward = float(view[2] @ tip) >= 0
            axes.plot(*(view[:2] @ tip), "o", color=WARM, ms=6, alpha=1.0 if toward else 0.4, zorder=5 if toward else 1)
        else:
            axes.plot(*(animation.path @ view[:2].T).T, color=COOL, lw=0.9, alpha=0.3, zorder=1)
            axes.plot(*(np.concatenate([past, origin[None]]) @ view[:2].T).T, color=COOL, lw=1.7, zorder=1)
        self._faces(axes, rotation, origin)
        if self._pinned:
            ends = np.stack([origin, centre]) @ view[:2].T
            if not animation.mesh.stem:
                axes.plot(*ends.T, color=INK, lw=2.2, zorder=2.5 if view[2] @ (centre - origin) < 0 else 1.5)
            axes.plot(*ends[0], "o", color=INK, ms=5, zorder=2.5)
        start = origin if self._pinned else centre
        for name, values in animation.vectors.items():
            vector = np.array([np.interp(time, animation.time, values[:, k]) for k in range(3)])
            self._arrow(axes, start, vector, VECTORS[name], name)
        if animation.gravity is not None:
            self._arrow(axes, centre, animation.gravity, INK, "g")
        self._scale(axes)

    def _pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Q and the position at a time: between samples the body rotates at a constant rate."""
        animation = self._animation
        high = int(np.clip(np.searchsorted(animation.time, time), 1, len(animation.time) - 1))
        gap = animation.time[high] - animation.time[high - 1]
        fraction = float((time - animation.time[high - 1]) / gap) if gap > 0 else 0.0
        a, b = animation.quaternion[high - 1], animation.quaternion[high]
        angle = np.arccos(np.clip(a @ b, -1, 1))
        mixed = (1 - fraction) * a + fraction * b
        if angle > 1e-4:
            mixed = (np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b) / np.sin(angle)
        position = (1 - fraction) * animation.position[high - 1] + fraction * animation.position[high]
        return from_quaternion(mixed / np.linalg.norm(mixed)), position

    def _curve(self, axes, points: np.ndarray, alphas: tuple[float, float], **style) -> None:
        """A curve, in front of the body on the side of the eye, behind it elsewhere."""
        flat, near = points @ self._view[:2].T, points @ self._view[2] >= 0
        for side, alpha, order in ((near, alphas[0], 3), (~near, alphas[1], 1)):
            axes.plot(*np.where(side[:, None], flat, np.nan).T, alpha=alpha, zorder=order, **style)

    def _faces(self, axes, rotation: np.ndarray, origin: np.ndarray) -> None:
        from matplotlib.collections import PolyCollection

        mesh, view = self._animation.mesh, self._view
        seen = (mesh.vertices @ rotation.T + origin) @ view.T  # right, up, towards the eye
        light = np.array([-0.5, 0.65, 0.55])
        shown = []
        for face, painted in zip(mesh.faces, mesh.painted, strict=True):
            corners = seen[face]
            following = np.roll(corners, -1, axis=0)
            normal = np.cross(corners, following).sum(axis=0)
            if normal[2] > 0:
                lit = 0.62 + 0.38 * max(0.0, float(normal @ light) / np.linalg.norm(normal))
                shown.append((corners[:, 2].mean(), corners[:, :2], lit * SIDES[int(painted)]))
        shown.sort(key=lambda entry: entry[0])
        colors = [color for _, _, color in shown]
        axes.add_collection(
            PolyCollection([flat for _, flat, _ in shown], facecolors=colors, edgecolors=colors, lw=0.5, zorder=2)
        )

    def _arrow(self, axes, start: np.ndarray, vector: np.ndarray, color: str, name: str) -> None:
        tail, tip = (self._view[:2] @ point for point in (start, start + vector))
        size = float(np.linalg.norm(tip - tail))
        if size < 0.02:
            return
        axes.annotate("", tip, xytext=tail, arrowprops=ARROW | {"color": color}, zorder=4)
        along = (tip - tail) / size
        label = tip + 0.06 * along + LABEL_SIDE.get(name, 0.0) * np.array([-along[1], along[0]])
        axes.text(
            *label, name, color=color, fontsize=13, style="italic", weight="bold", ha="center", va="center", zorder=4
        )

    def _scale(self, axes) -> None:
        length = 10.0 ** np.floor(np.log10(0.6 * self._animation.unit))
        width = length / self._animation.unit
        axes.plot([1.02 - width, 1.02], [-1.02, -1.02], color=INK, lw=2, solid_capstyle="butt")
        axes.text(1.02, -0.99, f"{length:g} m", color=INK, fontsize=10, ha="right", va="bottom")
