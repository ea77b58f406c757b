"""The animation of molecules: on a page by chemiscope, with 16-bit coordinates, and in files by
Matplotlib."""

import html
from importlib.resources import files
from itertools import combinations, product

import numpy as np

from rigidmd.engines.sites import Sites
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.figures.style import FAINT, INK, UP, camera, draw_scale
from rigidmd.formats.bonds import COVALENT, connections
from rigidmd.io.trajectory import Frames, read_frames
from rigidmd.run.record import Record
from rigidmd.view.molecule_figure import COLOURS, OTHER
from rigidmd.view.page import PagePart, read_asset

#: Most coordinates in a page, of 2 bytes each: with base64 about 21 MB, plus 3 MB of chemiscope.
MOST_COORDINATES = 8_000_000
#: The JavaScript of chemiscope inside its package.
SCRIPT = ("sphinx", "static", "chemiscope.min.js")
#: Largest rounding error of a distance within a molecule in a trajectory, Å.
MAX_DEVIATION = 0.05
#: Largest 16-bit number.
LARGEST_INTEGER = 32_767


def chemiscope_script() -> str:
    """The JavaScript of chemiscope. Raises OutputError if it is not installed."""
    try:
        return files("chemiscope").joinpath(*SCRIPT).read_text(encoding="utf-8")
    except (ImportError, OSError):
        raise OutputError(
            "the animation of molecules needs chemiscope: pip install chemiscope"
        ) from None


def frames_of(record: Record, max_frames: int) -> Frames:
    """Frames of the trajectory of a run of molecules, each molecule whole and inside the box.
    Raises OutputError if distances within molecules are not as in the molecules of this run."""
    path, sites = record.trajectory, record.system.sites
    frames = read_frames(path, len(sites.molecule), max_frames)
    pairs = np.flatnonzero(sites.molecule[1:] == sites.molecule[:-1])
    expected, actual = (
        np.linalg.norm(at[pairs + 1] - at[pairs], axis=1)
        for at in (sites.offset_body, frames.positions[0])
    )
    if np.abs(expected - actual).max(initial=0.0) > MAX_DEVIATION:
        raise OutputError(
            f"{path} is not the trajectory of this run: its molecules have other shapes"
        )
    return inside(frames, sites)


def inside(frames: Frames, sites: Sites) -> Frames:
    """The frames with the centre of each molecule inside the box; molecules stay whole."""
    if frames.cells is None:
        return frames
    count, columns = np.bincount(sites.molecule), np.swapaxes(frames.cells, 1, 2)
    centres = np.array(
        [[np.bincount(sites.molecule, x) / count for x in frame.T] for frame in frames.positions]
    )
    shift = np.swapaxes(columns @ np.floor(np.linalg.solve(columns, centres)), 1, 2)
    return frames._replace(positions=frames.positions - shift[:, sites.molecule].astype(np.float32))


def describe_thinning(frames: Frames) -> list[str]:
    """Notes on the frames of a trajectory that are left out."""
    shown = f"{len(frames.time)} of {frames.count} frames are shown, every {frames.stride}th"
    notes = [f"{shown}: all of them would be too large."] if frames.stride > 1 else []
    return notes + ["The trajectory ends within a frame, which is left out."] * frames.is_cut


def massive_bonds(system: System) -> list[list[int]]:
    """Bonds for chemiscope, [i, j, 1], in indices of the sites with mass."""
    massive = np.flatnonzero(system.sites.mass > 0)
    number = np.full(len(system.sites.mass), -1)
    number[massive] = np.arange(len(massive))
    return [[int(i), int(j), 1] for i, j in number[connections(system)]]


#: Direction of the eye.
EYE = np.array([0.45, -1.0, 0.33])
#: Radius of a sphere in covalent radii, by which bonded spheres touch; default radius, Å.
SPHERE_SCALE, DEFAULT_RADIUS = 1.15, 1.2
#: Discs of a lit sphere from its rim on: radius, shift towards the light (both in radii), amount of
#: white.
DISCS = ((1.0, 0.0, -0.35), (0.93, 0.03, 0.0), (0.62, 0.2, 0.12), (0.3, 0.34, 0.45))
LIGHT = np.array([-0.61, 0.79])
#: Fraction of white in the atoms that are furthest away.
HAZE = 0.5


class MoleculeAnimation:
    """Molecules at the times of a trajectory: lit spheres in the box, distant ones paler, and a
    scale."""

    def __init__(self, record: Record, most_frames: int | None = None):
        from matplotlib.colors import to_rgb

        self._record, sites = record, record.system.sites
        self._shown = np.flatnonzero(sites.mass > 0)
        self._frames = frames_of(
            record, most_frames or max(2, MOST_COORDINATES // (3 * len(self._shown)))
        )
        self.time, self.notes = self._frames.time, describe_thinning(self._frames)
        self._elements = [str(element) for element in sites.element[self._shown]]
        radii = [
            SPHERE_SCALE * COVALENT[e] if e in COVALENT else DEFAULT_RADIUS for e in self._elements
        ]
        self._radius, self._view = np.array(radii), camera(EYE, UP)
        self._color = np.array([to_rgb(COLOURS.get(e, OTHER)) for e in self._elements])
        cells, points = self._frames.cells, self._frames.positions
        self._corners = (
            None
            if cells is None
            else np.array(list(product((0, 1), repeat=3))) @ cells @ self._view.T
        )
        points = (points @ self._view.T if self._corners is None else self._corners).reshape(-1, 3)
        low, high = points.min(0), points.max(0)
        half = (high - low) / 2
        half[:2] = half[:2].max()  # the picture is square
        half = 1.08 * half + 1.0
        self._low, self._high = (low + high) / 2 - half, (low + high) / 2 + half

    def loop_end(self) -> tuple[float, list[str]]:
        """End of an animation, and notes."""
        return float(self.time[-1]), []

    def film_notes(self, interval: float, seconds: float) -> list[str]:
        return []

    def draw(self, axes, time: float) -> None:
        """Draw the last frame up to a time into axes, which are cleared."""
        from matplotlib.collections import EllipseCollection

        frames = self._frames
        k = max(
            0,
            int(
                np.searchsorted(
                    frames.time, time + 1e-9 * (frames.time[-1] - frames.time[0]), "right"
                )
            )
            - 1,
        )
        axes.clear()
        axes.set_axis_off()
        axes.set(
            xlim=(self._low[0], self._high[0]), ylim=(self._low[1], self._high[1]), aspect="equal"
        )
        projected = frames.positions[k, self._shown] @ self._view.T  # right, up, towards the eye
        order = projected[:, 2].argsort()
        near = (projected[order, 2] - self._low[2]) / (self._high[2] - self._low[2])
        haze = (HAZE * (1 - near.clip(0, 1)))[:, None, None]
        color, radius = self._color[order][:, None], self._radius[order][:, None]
        size, lift, white = np.array(DISCS).T  # of the discs (m, d) of m atoms
        tint = (
            color * (1 + np.minimum(white, 0))[:, None]
            + (1 - color) * np.maximum(white, 0)[:, None]
        )
        widths = (2 * size * radius).ravel()
        centres = projected[order, None, :2] + (lift * radius)[..., None] * LIGHT
        style = {
            "offsets": centres.reshape(-1, 2),
            "facecolors": (tint * (1 - haze) + haze).reshape(-1, 3).clip(0, 1),
            "edgecolors": "none",
            "zorder": 2,
        }
        self._box(axes, k, back=True)
        axes.add_collection(
            EllipseCollection(
                widths, widths, 0, units="xy", offset_transform=axes.transData, **style
            )
        )
        self._box(axes, k, back=False)
        span = self._high[0] - self._low[0]
        length = next(
            x for x in (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1) if x < 0.3 * span or x == 1
        )
        draw_scale(
            axes, self._high[0] - 0.03 * span, self._low[1] + 0.03 * span, length, f"{length} Å"
        )

    def _box(self, axes, k: int, back: bool) -> None:
        """The edges of the box at its furthest corner (`back`), or all others."""
        if self._corners is None:
            return
        corners = self._corners[k]
        furthest = int(corners[:, 2].argmin())
        for i, j in combinations(range(8), 2):
            if (i ^ j) in (1, 2, 4) and (furthest in (i, j)) == back:
                axes.plot(
                    *corners[[i, j], :2].T,
                    color=FAINT if back else INK,
                    lw=0.8,
                    zorder=1 if back else 3,
                )

    def page_part(self) -> PagePart:
        """The animation by chemiscope. Raises OutputError."""
        code, frames, molecules = chemiscope_script(), self._frames, self._record.system
        positions = frames.positions[:, self._shown]
        left_out = (
            ["Sites without mass are not drawn."]
            if len(self._shown) < len(molecules.sites.mass)
            else []
        )
        low, high = positions.min(), positions.max()
        scale = max(float(high - low), 1e-9) / (2 * LARGEST_INTEGER)
        data = {
            "time": frames.time.astype("<f8"),
            "positions": np.round((positions - low) / scale - LARGEST_INTEGER).astype("<i2"),
            "low": float(low),
            "scale": scale,
            "steps": LARGEST_INTEGER,
            "elements": self._elements,
            "bonds": massive_bonds(molecules),
            "cells": None if frames.cells is None else frames.cells.reshape(-1, 9).astype("<f4"),
            "name": self._record.scene.name,
        }
        count = np.bincount(molecules.model.species, minlength=len(molecules.species))
        legend = ", ".join(f"{k} {m.name}" for k, m in zip(count, molecules.species, strict=True))
        usage = (
            "Drag to rotate, wheel or pinch to zoom; the ☰ of the picture has its style, the box,"
            " labels and axes."
        )
        usage += (
            " Space plays. A click on a plot jumps to its time. Drawn by chemiscope"
            " (chemiscope.org)."
        )
        picture = '<div class="molecules" id="film-picture"></div><div hidden id="film-meta"></div>'
        picture += '<div hidden id="film-info"></div>'
        scripts = [code, read_asset("film.js"), read_asset("molecules.js")]
        return PagePart(
            picture, html.escape(legend), usage, data, [*self.notes, *left_out], scripts
        )
