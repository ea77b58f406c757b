"""The animation of a single body: its data in units of the picture, for pages and files, and
drawing by Matplotlib."""

import html

import numpy as np

from rigidmd.engines.body_motion import drawn_axis
from rigidmd.figures.style import (
    COOL,
    FAINT,
    INK,
    UP,
    WARM,
    camera,
    draw_front_and_back,
    draw_scale,
    globe,
    thin_path,
)
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.run.record import Record
from rigidmd.view.mesh import mesh_of
from rigidmd.view.page import PagePart, read_asset

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
#: Vectors: columns, unit, colour, description, and side of the label, as vectors may coincide.
VECTORS = {
    "L": ("L_lab", "kg m²/s", "#7a5ca3", "angular momentum L", 0.05),
    "ω": ("omega_lab", "rad/s", "#b8862d", "angular velocity ω", -0.05),
}
ARROW = {"arrowstyle": "-|>,head_width=0.25,head_length=0.5", "lw": 2, "shrinkA": 0, "shrinkB": 0}
#: Rotations between two frames beyond which a body seems to rotate backwards.
MAX_ROTATION = 0.5
#: Differences of Q (rad), and of velocities and position, in their largest values, at which a
#: motion has returned.
RETURN_ANGLE, RETURN_FRACTION = 0.03, 0.02
#: As a fraction of these: a motion that returns to what a picture can show. Others nearly return.
EXACT_RETURN = 0.02


class BodyAnimation:
    """Lengths are in units of the picture's half width, about its centre; (t,) samples.

    position : (t, 3) of the pivot or the centre of mass
    centre : (3,) centre of mass in the body's axes
    quaternion : (t, 4) w, x, y, z, without jumps of sign
    angles : (t, 3) phi, theta, psi, degrees; empty for a point
    path, when : (p, 3) and (p,) the body axis on the sphere, or the centre of mass
    sphere : its radius, 0 without one
    vectors : name -> (t, 3)
    largest : name -> largest size with its unit
    gravity : (3,) or None
    unit : of the picture, m
    azimuth : of the eye, rad
    notes : on thinning and enlargement
    """

    def __init__(self, record: Record):
        self._record = record
        system, columns, count = record.system, record.columns, len(record.time)
        stride = -(-count // MOST_SAMPLES)
        rows = np.arange(0, count, stride)
        self.time = record.time[rows]
        self.notes = (
            [f"{len(rows)} of {count} samples are shown: every {stride}th."] if stride > 1 else []
        )
        mesh = mesh_of(system)
        self.notes.append(f"The body is drawn as {mesh.about}.")

        def of(*names: str) -> np.ndarray:
            return np.stack([columns[name][rows] for name in names], axis=-1)

        position = of("x", "y", "z") if system.translates else np.zeros((len(rows), 3))
        turns = system.rotates and "qw" in columns
        self.axis = drawn_axis(system)
        middle = (position.max(0) + position.min(0)) / 2
        extent = float(np.linalg.norm(position - middle, axis=1).max())
        moves = extent > FIXED_FRACTION * (mesh.reach if turns else 0.0)
        radius, enlarged = SPHERE * mesh.reach, 1.0
        if moves:
            enlarged = MIN_BODY_FRACTION * extent / mesh.reach
            enlarged = max(1.0, enlarged) if turns else enlarged
            self.unit = 1.05 * extent + mesh.reach * enlarged
            self.position = path = (position - middle) / self.unit
            if turns and enlarged > 1:
                self.notes.append(
                    f"The body is drawn {enlarged:.3g} times as large as it is relative to its"
                    " path."
                )
        else:
            self.unit, self.position = 1.08 * radius, np.zeros_like(position)
            turned = [
                sum(columns[f"q{i}{j + 1}"][rows] * self.axis[j] for j in range(3))
                for i in (1, 2, 3)
            ]
            path = radius / self.unit * np.stack(turned, axis=-1)
        self.sphere = 0.0 if moves else radius / self.unit
        self.quaternion = (
            of("qw", "qx", "qy", "qz") if turns else np.tile([1.0, 0, 0, 0], (len(rows), 1))
        )
        shown = thin_path(path, MOST_POINTS)
        self.path, self.when = path[shown], self.time[shown]
        self.vectors, self.largest = {}, {}
        for name, (key, size, *_) in VECTORS.items():
            if turns and f"{key}_x" in columns:
                values = of(f"{key}_x", f"{key}_y", f"{key}_z")
                longest = float(np.linalg.norm(values, axis=1).max())
                if longest > 0:
                    scale = VECTOR_LENGTH[not moves] * (self.sphere or 1.0) / longest
                    self.vectors[name], self.largest[name] = scale * values, f"{longest:.4g} {size}"
        gravity = np.array(
            system.scene.gravity.acceleration_m_s2 if system.scene.gravity else np.zeros(3), float
        )
        self.gravity = (
            GRAVITY_LENGTH[not moves] * gravity / np.linalg.norm(gravity) if gravity.any() else None
        )
        self.angles = np.degrees(of("phi", "theta", "psi")) if turns else np.empty(0)
        self.azimuth = (
            float(np.arctan2(path[0, 1], path[0, 0])) - 0.6
            if np.hypot(*path[0, :2]) > 1e-9
            else 0.6
        )
        self.mesh = mesh._replace(vertices=mesh.vertices * enlarged / self.unit)
        self.centre, self.pinned = system.centre * enlarged / self.unit, not system.translates
        level = np.array([np.cos(self.azimuth), np.sin(self.azimuth), 0.0])
        self._view = camera(np.cos(LIFT) * level + np.sin(LIFT) * UP, UP)
        self._rings = self.sphere * np.concatenate(
            [np.vstack([ring, np.full(3, np.nan)]) for ring in globe()]
        )

    def draw(self, axes, time: float) -> None:
        """Draw a time into axes, which are cleared."""
        from matplotlib.patches import Circle

        view = self._view
        axes.clear()
        axes.set(xlim=(-1.08, 1.08), ylim=(-1.08, 1.08), aspect="equal")
        axes.set_axis_off()
        rotation, origin = self._pose(time)
        centre = origin + rotation @ self.centre
        past = self.path[self.when <= time]
        if self.sphere:
            tip = self.sphere * rotation @ self.axis
            past = np.concatenate([past, tip[None]])
            axes.add_patch(Circle((0, 0), self.sphere, fc=FAINT, alpha=0.08, lw=0))
            for curve, alphas, style in (
                (self._rings, (0.4, 0.15), {"color": FAINT, "lw": 0.5}),
                (self.path, (0.25, 0.08), {"color": COOL, "lw": 0.9}),
                (past, (0.95, 0.3), {"color": COOL, "lw": 1.7}),
            ):
                draw_front_and_back(axes, curve, view, curve @ view[2], alphas, **style)
            toward = float(view[2] @ tip) >= 0
            axes.plot(
                *(view[:2] @ tip),
                "o",
                color=WARM,
                ms=6,
                alpha=1.0 if toward else 0.4,
                zorder=5 if toward else 1,
            )
        else:
            axes.plot(*(self.path @ view[:2].T).T, color=COOL, lw=0.9, alpha=0.3, zorder=1)
            axes.plot(
                *(np.concatenate([past, origin[None]]) @ view[:2].T).T, color=COOL, lw=1.7, zorder=1
            )
        self._faces(axes, rotation, origin)
        if self.pinned:
            ends = np.stack([origin, centre]) @ view[:2].T
            if not self.mesh.stem:
                axes.plot(
                    *ends.T,
                    color=INK,
                    lw=2.2,
                    zorder=2.5 if view[2] @ (centre - origin) < 0 else 1.5,
                )
            axes.plot(*ends[0], "o", color=INK, ms=5, zorder=2.5)
        for name, values in self.vectors.items():
            vector = np.array([np.interp(time, self.time, values[:, k]) for k in range(3)])
            self._arrow(
                axes,
                origin if self.pinned else centre,
                vector,
                VECTORS[name][2],
                name,
                VECTORS[name][4],
            )
        if self.gravity is not None:
            self._arrow(axes, centre, self.gravity, INK, "g")
        length = 10.0 ** np.floor(np.log10(0.6 * self.unit))
        draw_scale(axes, 1.02, -1.02, length / self.unit, f"{length:g} m")

    def _pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Q and the position at a time: between samples the body rotates at a constant rate."""
        high = int(np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1))
        gap = self.time[high] - self.time[high - 1]
        fraction = float((time - self.time[high - 1]) / gap) if gap > 0 else 0.0
        a, b = self.quaternion[high - 1], self.quaternion[high]
        angle = np.arccos(np.clip(a @ b, -1, 1))
        mixed = (1 - fraction) * a + fraction * b
        if angle > 1e-4:
            mixed = (np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b) / np.sin(
                angle
            )
        position = (1 - fraction) * self.position[high - 1] + fraction * self.position[high]
        return from_quaternion(mixed / np.linalg.norm(mixed)), position

    def _faces(self, axes, rotation: np.ndarray, origin: np.ndarray) -> None:
        from matplotlib.collections import PolyCollection

        # right, up, towards the eye
        projected = (self.mesh.vertices @ rotation.T + origin) @ self._view.T
        light = np.array([-0.5, 0.65, 0.55])
        shown = []
        for face, painted in zip(self.mesh.faces, self.mesh.painted, strict=True):
            corners = projected[face]
            normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
            if normal[2] > 0:
                lit = 0.62 + 0.38 * max(0.0, float(normal @ light) / np.linalg.norm(normal))
                shown.append((corners[:, 2].mean(), corners[:, :2], lit * SIDES[int(painted)]))
        shown.sort(key=lambda entry: entry[0])
        colors = [color for _, _, color in shown]
        style = {"facecolors": colors, "edgecolors": colors, "lw": 0.5, "zorder": 2}
        axes.add_collection(PolyCollection([flat for _, flat, _ in shown], **style))

    def _arrow(
        self, axes, start: np.ndarray, vector: np.ndarray, color: str, name: str, side: float = 0.0
    ) -> None:
        tail, tip = (self._view[:2] @ point for point in (start, start + vector))
        size = float(np.linalg.norm(tip - tail))
        if size < 0.02:
            return
        axes.annotate("", tip, xytext=tail, arrowprops=ARROW | {"color": color}, zorder=4)
        along = (tip - tail) / size
        label = tip + 0.06 * along + side * np.array([-along[1], along[0]])
        style = {
            "fontsize": 13,
            "style": "italic",
            "weight": "bold",
            "ha": "center",
            "va": "center",
            "zorder": 4,
        }
        axes.text(*label, name, color=color, **style)

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
        how = (
            "returns to its start"
            if off[near].min() < EXACT_RETURN
            else "nearly returns to its start"
        )
        return end, [f"The motion {how} at {end:.6g} s, where the animation ends."]

    def film_notes(self, interval: float, seconds: float) -> list[str]:
        """A sentence if the body rotates too far between frames for its rotation to be seen."""
        if "omega_lab_x" not in self._record.columns:
            return []
        size = np.linalg.norm([self._record.columns[f"omega_lab_{k}"] for k in "xyz"], axis=0)
        turns = float(size.max() * interval / (2 * np.pi))
        note = (
            f"The body rotates up to {turns:.2g} times between two frames, so that it may seem to"
            " stand or to rotate"
        )
        note += (
            f" backwards: an animation of {seconds * turns / MAX_ROTATION:.3g} s shows its"
            " rotation."
        )
        return [note] if turns > MAX_ROTATION else []

    def page_part(self) -> PagePart:
        def short(values):
            return values.astype("<f4")

        data = {
            "time": self.time,
            "quaternion": short(self.quaternion),
            "position": short(self.position),
            "path": short(self.path),
            "when": self.when,
            "angles": short(self.angles) if self.angles.size else None,
            "vectors": {name: short(values) for name, values in self.vectors.items()},
            "gravity": None if self.gravity is None else self.gravity.tolist(),
            "vertices": self.mesh.vertices.round(6).tolist(),
            "faces": self.mesh.faces,
            "painted": self.mesh.painted,
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
        chips += [] if self.gravity is None else [("var(--ink)", "gravity g")]
        trace = (
            "path of the centre of mass"
            if not self.sphere
            else "path of the body axis on the sphere"
        )
        chips.append(("var(--cool)", trace))
        chip = '<span><i class="chip" style="background:{}"></i>{}</span>'
        legend = "".join(chip.format(color, html.escape(text)) for color, text in chips)
        usage = "Drag to rotate, wheel or pinch to zoom, double click to reset; space plays."
        usage += " A click on a plot jumps to it."
        picture = '<canvas id="film" role="img" aria-label="film of the body"></canvas>'
        return PagePart(
            picture, legend, usage, data, self.notes, [read_asset("film.js"), read_asset("body.js")]
        )
