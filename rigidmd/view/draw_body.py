"""A single body drawn by Matplotlib at a time: its faces, its path on the sphere, vectors, a scale."""

import numpy as np

from rigidmd.figures.style import COOL, FAINT, INK, WARM, camera, circle
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.view.body_film import BodyFilm

#: Height of the eye above the horizon, rad; colours of a body's sides, painted or not, and of vectors.
LIFT = 0.35
SIDES = np.array([[0.31, 0.58, 0.77], [0.85, 0.41, 0.31]])
VECTORS = {"L": "#7a5ca3", "ω": "#b8862d"}
#: Labels of vectors that lie on one another stand beside them, to the left and to the right.
SIDE = {"L": 0.05, "ω": -0.05}
HEAD = "-|>,head_width=0.25,head_length=0.5"
UP = np.array([0.0, 0.0, 1.0])


class BodyPicture:
    """Draws the times of a film."""

    def __init__(self, film: BodyFilm, pinned: bool):
        self._film, self._pinned = film, pinned
        level = np.array([np.cos(film.azimuth), np.sin(film.azimuth), 0.0])
        self._view = camera(np.cos(LIFT) * level + np.sin(LIFT) * UP, UP)
        self._rings = np.zeros((0, 3))
        if film.sphere:
            around = [circle(np.array([np.cos(a), np.sin(a), 0.0])) for a in np.radians(np.arange(0, 180, 30))]
            rings = [*around, *(circle(UP, p) for p in range(30, 180, 30))]
            self._rings = film.sphere * np.concatenate([np.vstack([ring, np.full(3, np.nan)]) for ring in rings])

    def draw(self, axes, time: float) -> None:
        """Draw a time into axes, which are emptied."""
        from matplotlib.patches import Circle

        film, view = self._film, self._view
        axes.clear()
        axes.set(xlim=(-1.08, 1.08), ylim=(-1.08, 1.08), aspect="equal")
        axes.set_axis_off()
        rotation, origin = self._pose(time)
        centre = origin + rotation @ film.centre
        gone = film.path[film.when <= time]
        if film.sphere:
            tip = film.sphere * rotation @ film.axis
            gone = np.concatenate([gone, tip[None]])
            axes.add_patch(Circle((0, 0), film.sphere, fc=FAINT, alpha=0.08, lw=0))
            self._curve(axes, self._rings, (0.4, 0.15), color=FAINT, lw=0.5)
            self._curve(axes, film.path, (0.25, 0.08), color=COOL, lw=0.9)
            self._curve(axes, gone, (0.95, 0.3), color=COOL, lw=1.7)
            toward = float(view[2] @ tip) >= 0
            axes.plot(*(view[:2] @ tip), "o", color=WARM, ms=6, alpha=1.0 if toward else 0.4, zorder=5 if toward else 1)
        else:
            axes.plot(*(film.path @ view[:2].T).T, color=COOL, lw=0.9, alpha=0.3, zorder=1)
            axes.plot(*(np.concatenate([gone, origin[None]]) @ view[:2].T).T, color=COOL, lw=1.7, zorder=1)
        self._faces(axes, rotation, origin)
        if self._pinned:
            ends = np.stack([origin, centre]) @ view[:2].T
            if not film.mesh.stem:
                axes.plot(*ends.T, color=INK, lw=2.2, zorder=2.5 if view[2] @ (centre - origin) < 0 else 1.5)
            axes.plot(*ends[0], "o", color=INK, ms=5, zorder=2.5)
        start = origin if self._pinned else centre
        for name, values in film.vectors.items():
            vector = np.array([np.interp(time, film.time, values[:, k]) for k in range(3)])
            self._arrow(axes, start, vector, VECTORS[name], name)
        if film.gravity is not None:
            self._arrow(axes, centre, film.gravity, INK, "g")
        self._scale(axes)

    def _pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Q and the place at a time: between two samples a turn at a constant rate."""
        film = self._film
        high = int(np.clip(np.searchsorted(film.time, time), 1, len(film.time) - 1))
        gap = film.time[high] - film.time[high - 1]
        share = float((time - film.time[high - 1]) / gap) if gap > 0 else 0.0
        a, b = film.quaternion[high - 1], film.quaternion[high]
        angle = np.arccos(np.clip(a @ b, -1, 1))
        mixed = (1 - share) * a + share * b
        if angle > 1e-4:
            mixed = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)
        place = (1 - share) * film.position[high - 1] + share * film.position[high]
        return from_quaternion(mixed / np.linalg.norm(mixed)), place

    def _curve(self, axes, points: np.ndarray, alphas: tuple[float, float], **style) -> None:
        """Before the body on the side of the eye, behind it elsewhere."""
        flat, near = points @ self._view[:2].T, points @ self._view[2] >= 0
        for side, alpha, order in ((near, alphas[0], 3), (~near, alphas[1], 1)):
            axes.plot(*np.where(side[:, None], flat, np.nan).T, alpha=alpha, zorder=order, **style)

    def _faces(self, axes, rotation: np.ndarray, origin: np.ndarray) -> None:
        from matplotlib.collections import PolyCollection

        mesh, view = self._film.mesh, self._view
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
        style = {
            "arrowstyle": "-|>,head_width=0.25,head_length=0.5",
            "color": color,
            "lw": 2,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        axes.annotate("", tip, xytext=tail, arrowprops=style, zorder=4)
        along = (tip - tail) / size
        label = tip + 0.06 * along + SIDE.get(name, 0.0) * np.array([-along[1], along[0]])
        axes.text(
            *label, name, color=color, fontsize=13, style="italic", weight="bold", ha="center", va="center", zorder=4
        )

    def _scale(self, axes) -> None:
        """A round length at the lower right."""
        length = 10.0 ** np.floor(np.log10(0.6 * self._film.unit))
        width = length / self._film.unit
        axes.plot([1.02 - width, 1.02], [-1.02, -1.02], color=INK, lw=2, solid_capstyle="butt")
        axes.text(1.02, -0.99, f"{length:g} m", color=INK, fontsize=10, ha="right", va="bottom")
