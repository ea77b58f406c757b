"""The film of molecules on a page: chemiscope draws the structures, which the page keeps as 16-bit numbers."""

import html
from importlib.resources import files
from pathlib import Path

import numpy as np

from rigidmd.engines.system import Sites, System
from rigidmd.errors import OutputError
from rigidmd.io.bonds import connections
from rigidmd.io.trajectory import Frames, read_frames
from rigidmd.run.record import Record
from rigidmd.view.film_page import data_part, own, packed, script, stage

#: Coordinates in a page at most, of 2 bytes each: with base64 about 21 MB, beside 3 MB of chemiscope.
MOST = 8_000_000
#: The JavaScript of chemiscope inside its package.
SCRIPT = ("sphinx", "static", "chemiscope.min.js")
#: Å by which a distance within a molecule may be rounded in a trajectory.
OFF = 0.05
#: Largest 16-bit number.
STEPS = 32_767


def library() -> str:
    """The JavaScript of chemiscope. Raises OutputError if it is not installed."""
    try:
        found = files("chemiscope").joinpath(*SCRIPT).read_text(encoding="utf-8")
    except (ImportError, OSError):
        raise OutputError("the film of molecules needs the extra rigidmd[view]: pip install chemiscope") from None
    return found


def frames_of(record: Record, most: int) -> Frames:
    """Frames of the trajectory of a run of molecules, each molecule whole and inside the box.

    Raises OutputError if the run has none.
    """
    output, sites = record.scene.output, record.molecules.sites
    if not output.trajectory:
        raise OutputError(f"{record.folder}: this run wrote no trajectory (output.trajectory = false)")
    path = record.folder / output.trajectory
    if not path.is_file():
        raise OutputError(f"{record.folder}: its trajectory {output.trajectory} is missing")
    found = read_frames(path, len(sites.molecule), most)
    _check_shapes(path, sites, found.positions[0])
    return inside(found, sites)


def inside(frames: Frames, sites: Sites) -> Frames:
    """The frames with each molecule, which is whole, inside the box."""
    if frames.cells is None:
        return frames
    centre = np.stack([_centres(frame, sites.molecule) for frame in frames.positions])
    share = np.linalg.solve(np.swapaxes(frames.cells, 1, 2), np.swapaxes(centre, 1, 2))  # cells as columns
    shift = np.swapaxes(np.swapaxes(frames.cells, 1, 2) @ np.floor(share), 1, 2)
    return frames._replace(positions=frames.positions - shift[:, sites.molecule].astype(np.float32))


def _check_shapes(path: Path, sites: Sites, frame: np.ndarray) -> None:
    """Raise OutputError if neighbouring sites of molecules are not as far apart as they are in this run's molecules."""
    pairs = np.flatnonzero(sites.molecule[1:] == sites.molecule[:-1])
    wanted, seen = (np.linalg.norm(at[pairs + 1] - at[pairs], axis=1) for at in (sites.offset_body, frame))
    if np.abs(wanted - seen).max(initial=0.0) > OFF:
        raise OutputError(f"{path} is not the trajectory of this run: its molecules have other shapes")


def _centres(frame: np.ndarray, molecule: np.ndarray) -> np.ndarray:
    count = np.bincount(molecule)
    return np.stack([np.bincount(molecule, frame[:, k]) / count for k in range(3)], axis=-1)


def thinned(frames: Frames) -> list[str]:
    """What of a trajectory is not in its film."""
    told = []
    if frames.stride > 1:
        told.append(
            f"{len(frames.time)} of {frames.count} frames are in this film, every {frames.stride}th: "
            "all of them would make it too large."
        )
    if frames.is_cut:
        told.append("The trajectory ends within a frame, which is left out.")
    return told


def massive_bonds(system: System) -> list[list[int]]:
    """Bonds for chemiscope, [i, j, 1], in numbers of the sites with mass."""
    massive = np.flatnonzero(system.sites.mass > 0)
    number = np.full(len(system.sites.mass), -1)
    number[massive] = np.arange(len(massive))
    return [[int(i), int(j), 1] for i, j in number[connections(system)]]


def page_part(record: Record) -> tuple[list[str], list[str]]:
    """The film as HTML, and what was thinned out. Raises OutputError."""
    code = library()
    sites = record.molecules.sites
    massive = np.flatnonzero(sites.mass > 0)
    frames = frames_of(record, max(2, MOST // (3 * len(massive))))
    told = thinned(frames)
    positions = frames.positions[:, massive]
    if len(massive) < len(sites.mass):
        told.append("Sites without mass are not drawn.")
    low, high = positions.min(), positions.max()
    scale = max(float(high - low), 1e-9) / (2 * STEPS)
    data = {
        "time": packed(frames.time, "<f8"),
        "positions": packed(np.round((positions - low) / scale - STEPS), "<i2"),
        "low": float(low),
        "scale": scale,
        "steps": STEPS,
        "elements": [str(element) for element in sites.element[massive]],
        "bonds": massive_bonds(record.molecules),
        "cells": None if frames.cells is None else packed(frames.cells.reshape(-1, 9), "<f4"),
        "name": record.scene.name,
    }
    count = np.bincount(record.molecules.model.species, minlength=len(record.molecules.species))
    legend = ", ".join(f"{k} {m.name}" for k, m in zip(count, record.molecules.species, strict=True))
    how = (
        "Drag to turn, wheel or pinch to zoom; the ☰ of the picture has its style, the box, labels and axes. "
        "Space plays. A click on a plot jumps there. Drawn by chemiscope (chemiscope.org)."
    )
    beneath = f'<p class="legend">{html.escape(legend)}</p><p class="faint noprint">{how}</p>'
    picture = '<div class="molecules" id="film-picture"></div><div hidden id="film-meta"></div>'
    picture += '<div hidden id="film-info"></div>'
    parts = [stage(picture, beneath, record, told), data_part(data), script(code)]
    return [*parts, script(own("film.js")), script(own("molecules.js"))], told
