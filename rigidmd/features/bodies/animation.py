"""The animation of a single body: its data in units of the picture, for pages and files, and
drawing by Matplotlib."""

import html
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.features.bodies.mesh import mesh_of
from rigidmd.features.bodies.motion import drawn_axis
from rigidmd.features.view.figures.space import UP, View, camera, globe, thin_path
from rigidmd.features.view.figures.style import COOL, FAINT, INK, PALETTE, WARM
from rigidmd.features.view.page import Animation, PagePart, read_asset
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.run.record import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Most samples of an animation, most points of the drawn path.
MOST_SAMPLES, MOST_POINTS = 20_000, 3000
#: Radius of the sphere around a body, in its reach; least fraction of the picture that a moving
#: body fills.
SPHERE, MIN_BODY_FRACTION = 1.2, 0.07
#: A body whose centre moves by less than this fraction of its reach is drawn at rest.
FIXED_FRACTION = 0.05
#: Length of the longest L and omega, and of gravity, in radii of the sphere (True) or in the unit
#: of the picture.
VECTOR_LENGTH, GRAVITY_LENGTH = {True: 1.0, False: 0.45}, {True: 0.45, False: 0.3}
#: Height of the eye above the horizon, rad; colours of a body's sides, painted or not.
LIFT = 0.35
SIDES = np.array([[0.31, 0.58, 0.77], [0.85, 0.41, 0.31]])
#: Vectors: columns, unit, colour of the palette, description, and side of the label, as vectors
#: may coincide.
VECTORS = {
    "L": ("L_lab", "kg m²/s", "violet", "angular momentum L", 0.05),
    "ω": ("omega_lab", "rad/s", "amber", "angular velocity ω", -0.05),
}
USAGE = (
    "Drag to rotate, wheel or pinch to zoom, double click to reset. Space plays. A click on a plot"
    " jumps to it."
)
#: Rotations between two frames beyond which a body seems to rotate backwards.
MAX_ROTATION = 0.5
#: Differences of Q (rad), and of velocities and position, in their largest values, at which a
#: motion has returned.
RETURN_ANGLE, RETURN_FRACTION = 0.03, 0.02
#: As a fraction of these: a motion that returns to what a picture can show. Others nearly return.
EXACT_RETURN = 0.02


class BodyAnimation(Animation):
    """Lengths are in units of the picture's half width, about its centre. (t,) samples.

    position : (t, 3) of the pivot or the centre of mass
    centre : (3,) centre of mass in the body's axes
    quaternion : (t, 4) w, x, y, z, without jumps of sign
    angles : (t, 3) phi, theta, psi, degrees. Empty for a point
    path, when : (p, 3) and (p,) the body axis on the sphere, or the centre of mass
    sphere : its radius, 0 without one
    vectors : name -> (t, 3)
    largest : name -> largest size with its unit
    gravity : (3,) or None
    unit : of the picture, m
    azimuth : of the eye, rad
    notes : on thinning, the shape and enlargement
    """

    def __init__(self, record: Record):
        self._record = record
        system = record.system
        columns = record.columns
        count = len(record.time)
        stride = -(-count // MOST_SAMPLES)
        rows = np.arange(0, count, stride)
        self.time, self.notes = record.time[rows], []
        if stride > 1:
            self.notes.append(f"{len(rows)} of {count} samples are shown, one in {stride}.")
        mesh = mesh_of(system)
        self.notes.append(f"The body is drawn as {mesh.about}.")

        def of(*names: str) -> np.ndarray:
            return np.stack([columns[name][rows] for name in names], axis=-1)

        def along(name: str) -> np.ndarray:
            return of(*(f"{name}_{axis}" for axis in "xyz"))

        position = of("x", "y", "z") if system.translates else np.zeros((len(rows), 3))
        turns = system.rotates and "qw" in columns
        self.axis = drawn_axis(system)
        middle = (position.max(0) + position.min(0)) / 2
        extent = float(np.linalg.norm(position - middle, axis=1).max())
        moves = extent > FIXED_FRACTION * (mesh.reach if turns else 0.0)
        radius = SPHERE * mesh.reach
        enlarged = 1.0
        if moves:
            enlarged = MIN_BODY_FRACTION * extent / mesh.reach
            enlarged = max(1.0, enlarged) if turns else enlarged
            self.unit = 1.05 * extent + mesh.reach * enlarged
            self.position = path = (position - middle) / self.unit
            if turns and enlarged > 1:
                self.notes.append(f"The body is drawn {enlarged:.3g} times larger than to scale.")
        else:
            self.unit = 1.08 * radius
            self.position = path = np.zeros_like(position)
            if turns:
                Q = of(*(f"q{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(-1, 3, 3)
                path = radius / self.unit * (Q @ self.axis)
        self.sphere = 0.0 if moves else radius / self.unit
        still = np.tile([1.0, 0, 0, 0], (len(rows), 1))
        self.quaternion = of("qw", "qx", "qy", "qz") if turns else still
        shown = thin_path(path, MOST_POINTS)
        self.path, self.when = path[shown], self.time[shown]
        self.vectors, self.largest = {}, {}
        for name, (key, size, *_) in VECTORS.items():
            if turns and f"{key}_x" in columns:
                values = along(key)
                longest = float(np.linalg.norm(values, axis=1).max())
                if longest > 0:
                    scale = VECTOR_LENGTH[not moves] * (self.sphere or 1.0) / longest
                    self.vectors[name], self.largest[name] = scale * values, f"{longest:.4g} {size}"
        self.gravity, field = None, system.scene.gravity
        if field and np.any(field.acceleration_m_s2):
            gravity = np.array(field.acceleration_m_s2)
            self.gravity = GRAVITY_LENGTH[not moves] * gravity / np.linalg.norm(gravity)
        self.angles = np.degrees(of("phi", "theta", "psi")) if turns else np.empty(0)
        x, y, _ = path[0]
        self.azimuth = float(np.arctan2(y, x)) - 0.6 if np.hypot(x, y) > 1e-9 else 0.6
        self.mesh = mesh._replace(vertices=mesh.vertices * enlarged / self.unit)
        self.centre, self.pinned = system.centre * enlarged / self.unit, not system.translates
        level = np.array([np.cos(self.azimuth), np.sin(self.azimuth), 0.0])
        self._view = camera(np.cos(LIFT) * level + np.sin(LIFT) * UP)

    def draw(self, axes: "Axes", time: float) -> None:
        """Draw a time into axes, which are cleared."""
        from matplotlib.patches import Circle

        view = View(axes, self._view, 1.08)
        rotation, origin = self._pose(time)
        centre = origin + rotation @ self.centre
        past = self.path[self.when <= time]
        if self.sphere:
            tip = self.sphere * rotation @ self.axis
            axes.add_patch(Circle((0, 0), self.sphere, fc=FAINT, alpha=0.08, lw=0))
            view.curve(self.sphere * globe(), (0.4, 0.15), color=FAINT, lw=0.5)
            view.curve(self.path, (0.25, 0.08), color=COOL, lw=0.9)
            view.curve(np.vstack([past, tip]), (0.95, 0.3), color=COOL, lw=1.7)
            front = view.depth(tip) >= 0
            alpha, order = (1.0, 5) if front else (0.4, 1)
            axes.plot(*view.flat(tip), "o", color=WARM, ms=6, alpha=alpha, zorder=order)
        else:
            for line, alpha, width in ((self.path, 0.3, 0.9), (np.vstack([past, origin]), 1, 1.7)):
                axes.plot(*view.flat(line).T, color=COOL, lw=width, alpha=alpha, zorder=1)
        vertices = self.mesh.vertices @ rotation.T + origin
        faces = [vertices[face] for face in self.mesh.faces]
        view.faces(faces, SIDES[np.array(self.mesh.painted, int)])
        if self.pinned:
            ends = view.flat(np.stack([origin, centre]))
            if not self.mesh.stem:
                behind = view.depth(centre - origin) >= 0
                axes.plot(*ends.T, color=INK, lw=2.2, zorder=1.5 if behind else 2.5)
            axes.plot(*ends[0], "o", color=INK, ms=5, zorder=2.5)
        start = origin if self.pinned else centre
        for name, values in self.vectors.items():
            vector = np.array([np.interp(time, self.time, column) for column in values.T])
            view.arrow(start, vector, PALETTE[VECTORS[name][2]], name, VECTORS[name][4])
        if self.gravity is not None:
            view.arrow(centre, self.gravity, INK, "g")
        length = 10.0 ** np.floor(np.log10(0.6 * self.unit))
        view.scale(length / self.unit, f"{length:g} m")

    def _pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Q and the position at a time: between samples the body rotates at a constant rate."""
        high = int(np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1))
        gap = self.time[high] - self.time[high - 1]
        fraction = float((time - self.time[high - 1]) / gap) if gap > 0 else 0.0
        pair = slice(high - 1, high + 1)
        a, b = self.quaternion[pair]
        weights = np.array([1 - fraction, fraction])
        position = weights @ self.position[pair]
        angle = np.arccos(np.clip(a @ b, -1, 1))
        if angle > 1e-4:
            weights = np.sin(weights * angle)
        mixed = weights @ self.quaternion[pair]
        return from_quaternion(mixed / np.linalg.norm(mixed)), position

    def loop_end(self) -> tuple[float, list[str]]:
        """End of an animation, and a note: the last return of the motion to its start, to repeat it
        without a jump."""
        dots = np.abs(self.quaternion @ self.quaternion[0]).clip(0, 1)
        away = [2 * np.arccos(dots) / RETURN_ANGLE]
        for values in (*self.vectors.values(), self.position):
            size = np.linalg.norm(values, axis=1).max()
            if size > 0:
                away.append(np.linalg.norm(values - values[0], axis=1) / (RETURN_FRACTION * size))
        off = np.max(away, axis=0)
        left = np.flatnonzero(off > 10)
        back = np.flatnonzero((off < 1) & (np.arange(len(off)) > left[0])) if len(left) else left
        if len(back) == 0:
            return float(self.time[-1]), []
        # the best of the last returns
        near = back[np.searchsorted(back, back[-1] - 0.1 * len(off)) :]
        end = float(self.time[near[off[near].argmin()]])
        nearly = "" if off[near].min() < EXACT_RETURN else "nearly "
        return end, [
            f"The motion {nearly}returns to its start at {end:.6g} s, the animation's end."
        ]

    def film_notes(self, interval: float, seconds: float) -> list[str]:
        """A sentence if the body rotates too far between frames for its rotation to be seen."""
        if "omega_lab_x" not in self._record.columns:
            return []
        size = np.linalg.norm([self._record.columns[f"omega_lab_{k}"] for k in "xyz"], axis=0)
        turns = float(size.max() * interval / (2 * np.pi))
        if turns <= MAX_ROTATION:
            return []
        return [
            f"The body rotates up to {turns:.2g} times between two frames, so that it may seem to"
            " stand or to rotate backwards: an animation of"
            f" {seconds * turns / MAX_ROTATION:.3g} s shows its rotation."
        ]

    def page_part(self) -> PagePart:
        def short(values: np.ndarray) -> np.ndarray:
            return values.astype("<f4")

        data = {
            "time": self.time,
            "quaternion": short(self.quaternion),
            "position": short(self.position),
            "path": short(self.path),
            "when": self.when,
            "angles": short(self.angles) if self.angles.size else None,
            "vectors": {
                name: {"values": short(values), "color": VECTORS[name][2]}
                for name, values in self.vectors.items()
            },
            "gravity": None if self.gravity is None else self.gravity.tolist(),
            "vertices": self.mesh.vertices.round(6).tolist(),
            "faces": self.mesh.faces,
            "painted": self.mesh.painted,
            "sides": (255 * SIDES).tolist(),
            "sphere": self.sphere,
            "axis": self.axis.tolist(),
            "centre": self.centre.tolist(),
            "pinned": self.pinned,
            "rod": not self.mesh.stem,
            "unit": self.unit,
            "azimuth": self.azimuth,
        }
        chips = [
            (VECTORS[name][2], f"{VECTORS[name][3]}, at most {largest}")
            for name, largest in self.largest.items()
        ]
        chips += [] if self.gravity is None else [("ink", "gravity g")]
        drawn = "body axis on the sphere" if self.sphere else "centre of mass"
        chips.append(("cool", f"path of the {drawn}"))
        chip = '<span><i class="chip" style="background:var(--{})"></i>{}</span>'
        legend = "".join(chip.format(color, html.escape(text)) for color, text in chips)
        picture = '<canvas id="film" role="img" aria-label="animation of the body"></canvas>'
        scripts = [read_asset("film.js"), read_asset("body.js")]
        return PagePart(picture, legend, USAGE, data, scripts)
