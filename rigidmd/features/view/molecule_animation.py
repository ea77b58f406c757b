"""The animation of molecules: on a page by chemiscope, with 16-bit coordinates, and in files by
Matplotlib."""

from dataclasses import replace
from importlib.resources import files
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from rigidmd.engines.sites import Sites
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.features.view.figures.space import View, camera
from rigidmd.features.view.molecule_figure import color_of
from rigidmd.features.view.page import Animation, PagePart, read_asset
from rigidmd.features.view.solids import solids_of, sphere_radius
from rigidmd.formats.bonds import connections
from rigidmd.io.trajectory import Frames, read_frames
from rigidmd.run.record import Record
from rigidmd.run.results import Results
from rigidmd.run.rigid_fit import RigidFit
from rigidmd.scene.validation import not_none

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Most coordinates in a page, of 2 bytes each: with base64 about 21 MB, plus 3 MB of chemiscope.
MOST_COORDINATES = 8_000_000
#: Maximum number of coordinates in a notebook.
NOTEBOOK_COORDINATES = 1_500_000
#: The JavaScript of chemiscope inside its package.
SCRIPT = ("sphinx", "static", "chemiscope.min.js")
#: Largest rounding error of a distance within a molecule in a trajectory, Å.
MAX_DEVIATION = 0.05
#: Largest 16-bit number.
LARGEST_INTEGER = 32_767
#: Direction of the eye; fraction of white in the atoms that are furthest away.
EYE = np.array([0.45, -1.0, 0.33])
HAZE = 0.5
#: Lengths of the scale, Å.
SCALES = (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1)
USAGE = (
    "Drag to rotate, wheel or pinch to zoom. The ☰ of the picture has its style, the box, labels"
    " and axes. Space plays. A click on a plot jumps to its time. Drawn by chemiscope"
    " (chemiscope.org)."
)
PICTURE = (
    '<div class="molecules" id="film-picture"></div><div hidden id="film-meta"></div>'
    '<div hidden id="film-info"></div>'
)


def chemiscope_script() -> str:
    """The JavaScript of chemiscope. Raises OutputError if it is not installed."""
    try:
        return files("chemiscope").joinpath(*SCRIPT).read_text(encoding="utf-8")
    except (ImportError, OSError):
        raise OutputError(
            "the animation of molecules needs chemiscope: pip install chemiscope"
        ) from None


def frames_of(record: Record, max_frames: int) -> Frames:
    """Trajectory frames of a run of molecules, each molecule whole and inside the box. Raises
    OutputError if distances within molecules are not as in the molecules of this run."""
    path = record.trajectory
    sites = record.system.sites
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
    """The frames with the centre of each molecule inside the box. Molecules stay whole."""
    if frames.cells is None:
        return frames
    count = np.bincount(sites.molecule)
    columns = np.swapaxes(frames.cells, 1, 2)
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


class MoleculeAnimation(Animation):
    """Molecules at the times of a trajectory: lit spheres in the box, distant ones paler, and a
    scale."""

    def __init__(
        self, record: Record, most_frames: int | None = None, frames: Frames | None = None
    ):
        self._record, sites = record, record.system.sites
        self._shown = np.flatnonzero(sites.mass > 0)
        most_frames = most_frames or max(2, MOST_COORDINATES // (3 * len(self._shown)))
        frames = self._frames = frames or frames_of(record, most_frames)
        self.time, self.notes = frames.time, describe_thinning(frames)
        self._elements = [str(element) for element in sites.element[self._shown]]
        self._radius = np.array([sphere_radius(element) for element in self._elements])
        self._view = camera(EYE)
        self._colors = np.array([color_of(element) for element in self._elements])
        self._solids, self._fit = solids_of(record.system), RigidFit(record.system)
        self._kept: tuple[int, np.ndarray] | None = None  # a frame, and its picture
        self._corners, points = None, frames.positions
        if frames.cells is not None:
            points = self._corners = np.array([*product((0, 1), repeat=3)]) @ frames.cells
        seen = points.reshape(-1, 3) @ self._view.T
        self._low, self._high = seen.min(0), seen.max(0)
        reach = 1.0 if self._solids is None else self._solids.semi_axes.max()
        self._half = 0.54 * (self._high - self._low)[:2].max() + reach  # the picture is square

    def draw(self, axes: "Axes", time: float) -> None:
        """Draw the last frame up to a time into axes, which are cleared."""
        rounding = 1e-9 * (self.time[-1] - self.time[0])
        k = max(0, int(np.searchsorted(self.time, time + rounding, "right")) - 1)
        view = View(axes, self._view, self._half, (self._low + self._high)[:2] / 2)
        if self._solids is None:
            positions = self._frames.positions[k, self._shown]
            view.spheres(positions, self._radius, self._hazy(view, positions, self._colors))
        else:
            view.image(self._image(view, k))
        if self._corners is not None:
            view.box(self._corners[k])
        length = next(x for x in SCALES if x < 0.6 * self._half or x == 1)
        view.scale(length, f"{length} Å")

    def _image(self, view: View, k: int) -> np.ndarray:
        """The picture of the solids in a frame, kept because an animation shows it for a while."""
        if self._kept is None or self._kept[0] != k:
            solids = not_none(self._solids)
            centres, rotation = solids.poses(self._fit.bodies(self._frames.positions[k], None))
            colors = self._hazy(view, centres, solids.colors(rotation))
            self._kept = k, view.solids(centres, rotation, solids.semi_axes, colors)
        return self._kept[1]

    def _hazy(self, view: View, positions: np.ndarray, colors: np.ndarray) -> np.ndarray:
        """Colours, paler for things that are further away."""
        far = (self._high[2] - view.depth(positions)) / (self._high[2] - self._low[2] + 1.0)
        haze = HAZE * far.clip(0, 1)[:, None]
        return colors * (1 - haze) + haze

    def _begin_of_last_stage(self) -> float:
        """The time of the first frame of the last stage, or of all if no frame follows it."""
        columns = self._record.columns
        last = columns["time"][columns["stage"] == columns["stage"][-1]]
        k = int(np.searchsorted(self.time, last[0]))
        return float(self.time[k if k < len(self.time) - 1 else 0])

    def page_part(self) -> PagePart:
        """The animation by chemiscope. Raises OutputError."""
        code = chemiscope_script()
        frames = self._frames
        molecules = self._record.system
        positions = frames.positions[:, self._shown]
        elements = self._elements
        bonds = massive_bonds(molecules)
        solids = None
        if self._solids is not None:
            poses = [
                self._solids.poses(self._fit.bodies(frame, None)) for frame in frames.positions
            ]
            positions = np.array([centres for centres, _ in poses])
            rotation = np.array([of_frame for _, of_frame in poses])
            colors = np.array([self._solids.colors(of_frame) for of_frame in rotation])
            quaternion = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat()
            solids = {
                "semiaxes": self._solids.semi_axes.tolist(),
                "orientation": np.round(LARGEST_INTEGER * quaternion).astype("<i2"),
                "color": np.round(255 * colors).astype("u1"),
            }
            elements = ["X"] * positions.shape[1]
            bonds = []
        elif len(self._shown) < len(molecules.sites.mass):
            self.notes.append("Sites without mass are not drawn.")
        low, high = positions.min(), positions.max()
        scale = max(float(high - low), 1e-9) / (2 * LARGEST_INTEGER)
        data = {
            "time": frames.time.astype("<f8"),
            "begin": self._begin_of_last_stage(),
            "positions": np.round((positions - low) / scale - LARGEST_INTEGER).astype("<i2"),
            "low": float(low),
            "scale": scale,
            "steps": LARGEST_INTEGER,
            "elements": elements,
            "bonds": bonds,
            "solids": solids,
            "cells": None if frames.cells is None else frames.cells.reshape(-1, 9).astype("<f4"),
            "name": self._record.scene.name,
        }
        scripts = [code, read_asset("film.js"), read_asset("molecules.js")]
        return PagePart(PICTURE, "", USAGE, data, scripts)


def frames_in_memory(results: Results, system: System, record: Record) -> Frames:
    """The frames of a run for a notebook, from its files or from memory. Raises OutputError."""
    if not system.scene.output.trajectory or not results._frames:
        raise OutputError("this run has no frames (output.trajectory = false)")
    most = max(2, NOTEBOOK_COORDINATES // (3 * len(system.sites.mass)))
    if results.files:
        return frames_of(replace(record, folder=results.files[0].parent), most)
    count = len(results._frames)
    stride = max(1, -(-count // most))
    chosen = results._frames[::stride]
    frames = Frames(
        time=np.array([frame.time for frame in chosen]),
        positions=np.array([frame.positions for frame in chosen]),
        cells=np.array([frame.cell for frame in chosen]) if system.density else None,
        count=count,
        stride=stride,
        is_cut=False,
    )
    return inside(frames, system.sites)
