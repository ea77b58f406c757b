"""Drawing of things in space, for all figures and animations: curves, spheres, faces, arrows."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rigidmd.features.view.figures.style import FAINT, INK, WARM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.typing import LineStyleType

UP = np.array([0.0, 0.0, 1.0])
#: Direction of the light: right, up, towards the eye.
LIGHT = np.array([-0.5, 0.65, 0.55])
#: Discs of a lit sphere from its rim on: radius, shift towards the light (both in radii), amount of
#: white.
DISCS = ((1.0, 0.0, -0.35), (0.93, 0.03, 0.0), (0.62, 0.2, 0.12), (0.3, 0.34, 0.45))
#: Most points of a line that are drawn at once: the renderer fails on 200,000 across a figure.
AT_ONCE = 5000
#: Lines with more points are images in an .svg.
MOST_POINTS = 10_000
#: Pixels across a picture of ellipsoids.
PIXELS = 700


def camera(eye: np.ndarray, up: np.ndarray = UP) -> np.ndarray:
    """An orthographic view from the direction `eye`: rows are to the right, upwards and towards the
    eye."""
    toward = eye / np.linalg.norm(eye)
    right = np.cross(up, eye)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward])


def circle(normal: np.ndarray, polar: float = 90.0) -> np.ndarray:
    """The circle on the unit sphere at this polar angle (degrees) from a direction."""
    right, up, toward = camera(normal, np.eye(3)[np.abs(normal).argmin()])
    angle = np.linspace(0, 2 * np.pi, 361)[:, None]
    polar = np.radians(polar)
    return np.sin(polar) * (np.cos(angle) * right + np.sin(angle) * up) + np.cos(polar) * toward


def globe() -> np.ndarray:
    """Circles of longitude and latitude on the unit sphere, every 30 degrees, with gaps of NaN."""
    azimuths = np.radians(np.arange(0, 180, 30))
    rings = [circle(np.array([np.cos(a), np.sin(a), 0.0])) for a in azimuths]
    rings += [circle(UP, polar) for polar in range(30, 180, 30)]
    return np.concatenate([np.vstack([ring, np.full(3, np.nan)]) for ring in rings])


def thin_path(path: np.ndarray, max_points: int) -> np.ndarray:
    """Indices of at most about `max_points` points of a path (n, d), evenly along its length,
    with its ends."""
    if len(path) <= max_points:
        return np.arange(len(path))
    way = np.append(0.0, np.linalg.norm(np.diff(path, axis=0), axis=1)).cumsum()
    marks = np.searchsorted(way, np.linspace(0, way[-1], max_points))
    return np.unique([0, *marks.clip(0, len(path) - 1), len(path) - 1])


def draw_line(
    axis: "Axes",
    flat: np.ndarray,
    color: str,
    lw: float,
    ls: "LineStyleType" = "-",
    alpha: float | None = None,
    zorder: float = 2.0,
) -> None:
    """Draw a line of any number of points (n, 2), in pieces that join."""
    for first in range(0, max(1, len(flat) - 1), AT_ONCE):
        axis.plot(
            *flat[first : first + AT_ONCE + 1].T,
            snap=False,
            color=color,
            lw=lw,
            ls=ls,
            alpha=alpha,
            zorder=zorder,
            rasterized=len(flat) > MOST_POINTS,
        )


def path_style(flat: np.ndarray, half: ArrayLike) -> tuple[np.ndarray, float]:
    """Indices of the points of a path (n, 2) to draw, about one per pixel of a picture of this half
    width, and the width of its line: longer ones are thinner."""
    length = np.linalg.norm(np.diff(flat, axis=0) / half, axis=1).sum()
    shown = thin_path(flat / half, int(800 * length) + 2)
    return shown, max(0.25, 1.7 / (1 + length / 60))


def glossy(color: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Colours (p, 3) of points of a surface by the light (p, 1) that they get, 0 to 1."""
    return color * (0.45 + 0.55 * light) + 0.35 * light**12


def pale(color: np.ndarray, light: np.ndarray) -> np.ndarray:
    """The same for surfaces behind curves."""
    return 1 - (0.38 - 0.28 * light) * (1 - color)


class View:
    """A picture of things in space, in axes of Matplotlib, which are cleared.

    Parameters
    ----------
    matrix
        (3, 3), as of `camera`.
    half, centre
        (2,) Half the width and height of the picture, and its centre.
    """

    def __init__(
        self,
        axis: "Axes",
        matrix: np.ndarray,
        half: ArrayLike = 1.0,
        centre: ArrayLike = (0.0, 0.0),
    ):
        self.axis, self.matrix = axis, matrix
        self.half, self.centre = np.broadcast_to(half, 2), np.asarray(centre)
        axis.clear()
        axis.set_axis_off()
        low, high = self.centre - self.half, self.centre + self.half
        axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in the picture, (..., 2)."""
        return points @ self.matrix[:2].T

    def depth(self, points: np.ndarray) -> np.ndarray:
        """How far points are towards the eye."""
        return points @ self.matrix[2]

    def curve(
        self,
        points: np.ndarray,
        alphas: tuple[float, float],
        depth: np.ndarray | None = None,
        *,
        color: str,
        lw: float,
        ls: "LineStyleType" = "-",
    ) -> None:
        """Draw a line that is strong on the side of the eye (depth >= 0) and faint on the other."""
        flat = self.flat(points)
        front = (self.depth(points) if depth is None else depth) >= 0
        joined = front.copy()
        joined[:-1] |= front[1:]
        joined[1:] |= front[:-1]
        for part, alpha, order in ((joined, alphas[0], 3), (~front, alphas[1], 1.5)):
            line = np.where(part[:, None], flat, np.nan)
            draw_line(self.axis, line, color, lw, ls, alpha, order)

    def path(self, points: np.ndarray, color: str, depth: np.ndarray | None = None) -> None:
        """Draw the path of a motion, with a dot at its start."""
        depth = self.depth(points) if depth is None else depth
        flat = self.flat(points)
        shown, width = path_style(flat, self.half.max())
        self.curve(points[shown], (0.95, 0.25), depth[shown], color=color, lw=width)
        self.axis.plot(*flat[0], "o", color=WARM, ms=5, zorder=4)

    def spheres(
        self, centres: np.ndarray, radius: np.ndarray, colors: np.ndarray, zorder: float = 2.0
    ) -> None:
        """Draw lit spheres (n,), each over those behind it. colors : (n, 3)"""
        from matplotlib.collections import EllipseCollection

        order = self.depth(centres).argsort()
        flat = self.flat(centres[order])[:, None]
        radius = radius[order, None]
        colors = colors[order, None]
        size, lift, white = np.array(DISCS).T[..., None]  # of the discs (d, 1) of each sphere
        tint = colors + np.where(white > 0, 1 - colors, colors) * white
        widths = (2 * size[:, 0] * radius).ravel()
        middles = flat + (lift * LIGHT[:2] / 0.82) * radius[..., None]
        discs = EllipseCollection(
            widths,
            widths,
            0,
            units="xy",
            zorder=zorder,
            facecolors=tint.reshape(-1, 3).clip(0, 1),
            edgecolors="none",
            offsets=middles.reshape(-1, 2),
            offset_transform=self.axis.transData,
        )
        self.axis.add_collection(discs)

    def faces(self, corners: Sequence[np.ndarray], colors: np.ndarray) -> None:
        """Draw the lit faces of a solid, each (k, 3) counterclockwise from outside. colors :
        (n, 3)"""
        from matplotlib.collections import PolyCollection

        shown = []
        for face, color in zip(corners, colors, strict=True):
            seen = face @ self.matrix.T
            normal = np.cross(seen, np.roll(seen, -1, axis=0)).sum(axis=0)
            if normal[2] > 0:
                lit = 0.62 + 0.38 * max(0.0, float(normal @ LIGHT) / np.linalg.norm(normal))
                shown.append((seen[:, 2].mean(), seen[:, :2], lit * color))
        shown.sort(key=lambda entry: entry[0])
        tints = [color for *_, color in shown]
        flat = [corners for _, corners, _ in shown]
        self.axis.add_collection(
            PolyCollection(flat, facecolors=tints, edgecolors=tints, lw=0.5, zorder=2)
        )

    def ellipsoids(self, semi_axes: np.ndarray, colors: Sequence[str]) -> None:
        """Draw ellipsoids (n,) about the origin, which may intersect, in pale colours, with their
        rims."""
        from matplotlib.colors import to_rgba_array

        frames = np.broadcast_to(np.eye(3), (len(semi_axes), 3, 3))
        tints = to_rgba_array(colors)[:, :3]
        centres = np.zeros(semi_axes.shape)
        self.image(self.solids(centres, frames, semi_axes, tints, pale), zorder=0.0)
        for semi, color in zip(semi_axes, colors, strict=True):
            rim = self.flat(semi * circle(self.matrix[2] / semi))
            draw_line(self.axis, rim, color=color, lw=0.8, alpha=0.6)

    def solids(
        self,
        centres: np.ndarray,
        rotation: np.ndarray,
        semi: np.ndarray,
        colors: np.ndarray,
        shade: Callable[[np.ndarray, np.ndarray], np.ndarray] = glossy,
    ) -> np.ndarray:
        """A picture (rows, columns, 4) for `image` of lit ellipsoids (n,), which may intersect:
        centres (n, 3), rotation (n, 3, 3) from their axes, semi-axes (n, 3), colors (n, 3)."""
        seen = self.matrix @ rotation
        middles = centres @ self.matrix.T
        spread = np.einsum("nik,nk,njk->nij", seen, semi**2, seen)
        weights = np.einsum("nik,nk,njk->nij", seen, semi**-2.0, seen)
        reach = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
        low = self.centre - self.half
        size = 2 * self.half
        count = (PIXELS * self.half / self.half.max()).astype(int)
        image = np.zeros((count[1], count[0], 4))
        nearest = np.full(count[::-1], -np.inf)
        light = LIGHT / np.linalg.norm(LIGHT)
        for middle, extent, weight, color in zip(middles, reach, weights, colors, strict=True):
            first = np.floor((middle[:2] - extent[:2] - low) / size * count).astype(int)
            last = np.ceil((middle[:2] + extent[:2] - low) / size * count).astype(int)
            first, last = np.clip(first, 0, count), np.clip(last, 0, count)
            x, y = (
                low[k] + (np.arange(first[k], last[k]) + 0.5) * size[k] / count[k] - middle[k]
                for k in (0, 1)
            )
            x, y = np.meshgrid(x, y)
            flat = np.stack([x, y], axis=-1)
            b = flat @ weight[:2, 2]
            c = np.einsum("...i,ij,...j->...", flat, weight[:2, :2], flat) - 1
            root = b * b - weight[2, 2] * c
            z = (np.sqrt(root.clip(0)) - b) / weight[2, 2]
            part = (slice(first[1], last[1]), slice(first[0], last[0]))
            visible = (root >= 0) & (middle[2] + z > nearest[part] + 1e-6 * self.half.max())
            normal = np.concatenate([flat, z[..., None]], axis=-1)[visible] @ weight
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            tint = shade(color, (normal @ light).clip(0)[:, None])
            image[part][visible] = np.insert(tint.clip(0, 1), 3, 1.0, axis=1)
            nearest[part][visible] = (middle[2] + z)[visible]
        return image

    def image(self, image: np.ndarray, zorder: float = 2.0) -> None:
        """Draw a picture that fills the axes."""
        (left, bottom), (right, top) = self.centre - self.half, self.centre + self.half
        box = (left, right, bottom, top)
        self.axis.imshow(image, origin="lower", extent=box, interpolation="bilinear", zorder=zorder)

    def arrow(
        self,
        start: np.ndarray,
        vector: np.ndarray,
        color: str,
        name: str,
        side: float = 0.0,
        lw: float = 2.0,
        fontsize: float = 13.0,
        zorder: float = 4.0,
    ) -> np.ndarray | None:
        """Draw a named arrow, unless it is seen from its end. side : of the name, as arrows may
        coincide. Returns where the name is."""
        tail = self.flat(start)
        tip = self.flat(start + vector)
        size = float(np.linalg.norm(tip - tail))
        unit = self.half.max()
        if size < 0.02 * unit:
            return None
        head = f"-|>,head_width={0.12 * lw:g},head_length={0.25 * lw:g}"
        arrow = {"arrowstyle": head, "color": color, "lw": lw, "shrinkA": 0, "shrinkB": 0}
        self.axis.annotate("", (*tip,), xytext=(*tail,), arrowprops=arrow, zorder=zorder)
        along = (tip - tail) / size
        label = tip + unit * (0.055 * along + side * np.array([-along[1], along[0]]))
        self.axis.text(
            label[0],
            label[1],
            name,
            color=color,
            fontsize=fontsize,
            ha="center",
            va="center",
            style="italic",
            zorder=zorder,
        )
        return label

    def triad(self, names: Sequence[str], down: np.ndarray | None = None) -> None:
        """Draw the axes of space as small arrows in the lower left corner, and the direction of
        gravity."""
        corner = (self.centre - 0.8 * self.half) @ self.matrix[:2]
        vectors = [*zip(np.eye(3), names, [INK] * 3, strict=False)]
        if down is not None:
            vectors.append((0.8 * down, "g", WARM))
        for vector, name, color in vectors:
            arrow = 0.13 * self.half.max() * vector
            self.arrow(corner, arrow, color, name, lw=0.8, fontsize=9)

    def scale(self, length: float, label: str) -> None:
        """Draw a bar of this length with its label in the lower right corner."""
        x, y = self.centre + 0.95 * self.half * [1, -1]
        self.axis.plot([x - length, x], [y, y], color=INK, lw=2, solid_capstyle="butt", zorder=4)
        self.axis.annotate(
            label,
            (x, y),
            (0, 3),
            textcoords="offset points",
            ha="right",
            va="bottom",
            color=INK,
            fontsize=10,
            zorder=4,
        )

    def box(self, corners: np.ndarray) -> None:
        """Draw the edges of a box of eight corners (8, 3) in binary order. Those at the furthest
        corner are faint."""
        furthest = int(self.depth(corners).argmin())
        for i in range(8):
            for j in (i ^ 1, i ^ 2, i ^ 4):
                if i < j:
                    back = furthest in (i, j)
                    style = {"color": FAINT if back else INK, "zorder": 1 if back else 3}
                    self.axis.plot(*self.flat(corners[[i, j]]).T, lw=0.8, **style)
