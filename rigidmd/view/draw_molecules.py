"""Molecules drawn by Matplotlib at a time: atoms as lit spheres in the box, far ones paler, and a scale."""

from itertools import combinations, product

import numpy as np

from rigidmd.figures.style import FAINT, INK, camera
from rigidmd.io.connections import COVALENT
from rigidmd.io.trajectory import Frames
from rigidmd.run.record import Record
from rigidmd.view.molecule_figure import COLOURS, OTHER

#: Where the eye is.
EYE = np.array([0.45, -1.0, 0.33])
#: Radius of a sphere as a multiple of the covalent radius, so that bonded ones touch; of others, Å.
LARGE, OTHERS = 1.15, 1.2
#: Discs of a sphere from its rim to its light: radius, and how far towards the light, as shares of its radius; white.
DISCS = ((1.0, 0.0, -0.35), (0.93, 0.03, 0.0), (0.62, 0.2, 0.12), (0.3, 0.34, 0.45))
LIGHT = np.array([-0.61, 0.79])
#: Share of white in the atoms that are furthest away.
HAZE = 0.5


class MoleculePicture:
    """Draws the times of a film."""

    def __init__(self, record: Record, frames: Frames):
        from matplotlib.colors import to_rgb

        sites = record.molecules.sites
        self._shown = np.flatnonzero(sites.mass > 0)
        elements = sites.element[self._shown]
        self._radius = np.array([LARGE * COVALENT[e] if e in COVALENT else OTHERS for e in elements])
        self._color = np.array([to_rgb(COLOURS.get(e, OTHER)) for e in elements])
        self._frames, self._view = frames, camera(EYE, np.array([0.0, 0.0, 1.0]))
        self._low, self._high = self._limits()

    def draw(self, axes, time: float) -> None:
        """Draw the last frame that is not later than a time into axes, which are emptied."""
        from matplotlib.collections import EllipseCollection

        frames = self._frames
        k = max(0, int(np.searchsorted(frames.time, time + 1e-9 * (frames.time[-1] - frames.time[0]), "right")) - 1)
        axes.clear()
        axes.set_axis_off()
        axes.set(xlim=(self._low[0], self._high[0]), ylim=(self._low[1], self._high[1]), aspect="equal")
        seen = frames.positions[k, self._shown] @ self._view.T  # right, up, towards the eye
        order = seen[:, 2].argsort()
        near = (seen[order, 2] - self._low[2]) / (self._high[2] - self._low[2])
        haze = (HAZE * (1 - near.clip(0, 1)))[:, None]
        color, radius = self._color[order], self._radius[order]
        discs = []
        for size, lift, white in DISCS:
            tint = color * (1 + min(white, 0)) + (1 - color) * max(white, 0)
            discs.append(
                (seen[order, :2] + lift * radius[:, None] * LIGHT, 2 * size * radius, tint * (1 - haze) + haze)
            )
        places, widths, colors = (np.stack(part, axis=1) for part in zip(*discs, strict=True))
        widths = widths.ravel()
        self._box(axes, k, back=True)
        axes.add_collection(
            EllipseCollection(
                widths, widths, 0, units="xy", offsets=places.reshape(-1, 2), offset_transform=axes.transData,
                facecolors=colors.reshape(-1, 3).clip(0, 1), edgecolors="none", zorder=2,
            )
        )  # fmt: skip
        self._box(axes, k, back=False)
        self._scale(axes)

    def _corners(self, k: int) -> np.ndarray:
        cells = self._frames.cells
        return (
            np.zeros((0, 3)) if cells is None else np.array(list(product((0, 1), repeat=3))) @ cells[k] @ self._view.T
        )

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest coordinates in the picture, equal in width and height, and in depth."""
        frames = range(len(self._frames.time))
        places = [self._corners(k) for k in frames] if self._frames.cells is not None else self._frames.positions
        places = np.concatenate([part if part.shape[0] == 8 else part @ self._view.T for part in places])
        low, high = places.min(0), places.max(0)
        middle, half = (low + high) / 2, (high - low) / 2
        half[:2] = half[:2].max()
        half = 1.08 * half + 1.0
        return middle - half, middle + half

    def _box(self, axes, k: int, back: bool) -> None:
        """The edges of the box at its furthest corner, or all others."""
        corners = self._corners(k)
        if not len(corners):
            return
        furthest = int(corners[:, 2].argmin())
        for i, j in combinations(range(8), 2):
            if (i ^ j) in (1, 2, 4) and (furthest in (i, j)) == back:
                axes.plot(*corners[[i, j], :2].T, color=FAINT if back else INK, lw=0.8, zorder=1 if back else 3)

    def _scale(self, axes) -> None:
        """A round length at the lower right."""
        span = self._high[0] - self._low[0]
        length = next(x for x in (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1) if x < 0.3 * span or x == 1)
        right, foot = self._high[0] - 0.03 * span, self._low[1] + 0.03 * span
        axes.plot([right - length, right], [foot, foot], color=INK, lw=2, solid_capstyle="butt", zorder=4)
        axes.text(right, foot + 0.012 * span, f"{length} Å", color=INK, fontsize=10, ha="right", va="bottom", zorder=4)
