"""Films of runs as files: .mp4 by ffmpeg, .gif by Pillow. Matplotlib draws every frame."""

import contextlib
import importlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.core.files import whole_file
from rigidmd.errors import OutputError
from rigidmd.figures.style import INK, WARM
from rigidmd.run.record import Record, read_record
from rigidmd.view import plots
from rigidmd.view.body_film import BodyFilm, body_film
from rigidmd.view.draw_body import BodyPicture
from rigidmd.view.draw_molecules import MoleculePicture
from rigidmd.view.molecule_film import frames_of, thinned

ENDINGS = (".mp4", ".gif")
#: Frames a second, seconds, and pixels of height of a film; inches of its picture.
RATE, SECONDS, HEIGHT = {".mp4": 25, ".gif": 15}, 10.0, {".mp4": 640, ".gif": 448}
INCHES = 6.4
#: Rotations between two frames beyond which a body seems to rotate backwards.
STROBES = 0.5
#: Panels beside a film at most.
PANELS = 3
#: Frames of molecules that are read at most.
MOST_FRAMES = 2000
#: A motion returns to its start if Q is as near to it as this (rad), and the speeds and the place to this share of
#: their largest.
RETURN, NEAR = 0.03, 0.02


class Film(NamedTuple):
    """What is drawn, and when.

    draw : draws a time into the axes; times : first and last; told : what is said of it
    """

    draw: Callable
    begin: float
    end: float
    told: list[str]


def ffmpeg() -> str | None:
    """The program that writes .mp4: on the path, or that of the package imageio-ffmpeg; None if there is none."""
    if found := shutil.which("ffmpeg"):
        return found
    with contextlib.suppress(ImportError, RuntimeError):  # RuntimeError: the package without its program
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return None


def default_name() -> str:
    """The name of a film: .mp4 where there is ffmpeg."""
    return f"film{ENDINGS[0] if ffmpeg() else ENDINGS[1]}"


def check_writer(path: Path) -> None:
    """Raise OutputError if a film of this kind cannot be written here."""
    if path.suffix == ".mp4" and ffmpeg() is None:
        raise OutputError(
            f"{path}: .mp4 needs ffmpeg: install the program, or `pip install imageio-ffmpeg`, which brings it; "
            "a .gif needs nothing more"
        )


def write_film(
    folder: Path,
    path: Path,
    seconds: float = SECONDS,
    with_plots: bool = False,
    height: int | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> tuple[Path, list[str]]:
    """Write the film of the run in a folder. Returns its path and what is said of it. Raises OutputError.

    seconds : its length; height : pixels, made even; progress : called with the share that is done
    """
    from matplotlib import animation, rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from rigidmd.figures.picture import Picture

    check_writer(path)
    record = read_record(folder)
    film = _of_body(record) if record.is_body else _of_molecules(record)
    pixels = 2 * round((height or HEIGHT[path.suffix]) / 2)
    across = 2 * round(pixels * (1.75 if with_plots else 1.0) / 2)
    figure = Picture(figsize=(INCHES * across / pixels, INCHES), dpi=pixels / INCHES)
    FigureCanvasAgg(figure)
    width = 1 / 1.75 if with_plots else 1.0
    axes = figure.add_axes((0.0, 0.0, width, 1.0))
    cursors = _panels(figure, record, width) if with_plots else []
    figure.text(0.02, 0.965, record.scene.name, color=INK, fontsize=13, weight="bold", va="top")
    clock = figure.text(0.02, 0.92, "", color=INK, fontsize=13, va="top")
    rate = RATE[path.suffix]
    count = max(2, round(seconds * rate))
    digits = int(np.clip(2 - np.floor(np.log10((film.end - film.begin) or 1.0)), 0, 6))
    kind = animation.FFMpegWriter if path.suffix == ".mp4" else animation.PillowWriter
    options = {"codec": "h264", "extra_args": ["-pix_fmt", "yuv420p", "-crf", "20"]} if path.suffix == ".mp4" else {}
    writer = kind(fps=rate, **options)
    times = np.linspace(film.begin, film.end, count)
    told = [*record.missing, *film.told, *_strobes(record, times, seconds)]
    with whole_file(path) as temporary, rc_context({"animation.ffmpeg_path": ffmpeg() or "ffmpeg"}):
        try:
            with writer.saving(figure, str(temporary), figure.dpi):
                for k, time in enumerate(times):
                    film.draw(axes, time)
                    clock.set_text(f"{time:.{digits}f} {record.time_unit}")
                    for cursor, axis in cursors:
                        low, high = axis.get_xlim()
                        place = axis.get_position()
                        at = place.x0 + (time - low) / (high - low) * place.width
                        cursor.set_xdata([at, at])
                    writer.grab_frame()
                    progress((k + 1) / count)
        except (RuntimeError, ValueError) as error:
            raise OutputError(f"{path} cannot be written as a film: {error}") from None
    speed = (film.end - film.begin) / seconds
    return path, [*told, f"{seconds:g} s of film: {speed:.3g} {record.time_unit} a second"]


def _strobes(record: Record, times: np.ndarray, seconds: float) -> list[str]:
    """A sentence if a single body rotates too far between frames for its rotation to be seen."""
    if not record.is_body or "omega_lab_x" not in record.columns:
        return []
    size = np.linalg.norm([record.columns[f"omega_lab_{k}"] for k in "xyz"], axis=0)
    turns = float(size.max() * (times[1] - times[0]) / (2 * np.pi))
    if turns <= STROBES:
        return []
    return [
        f"The body rotates up to {turns:.2g} times between two frames, so that it may seem to stand or to rotate "
        f"backwards: a film of {seconds * turns / STROBES:.3g} s shows its rotation."
    ]


def _panels(figure, record: Record, left: float) -> list[tuple[Any, Any]]:
    """Put the first plots of the run beside the picture, as an image: they do not change.

    Returns (cursor, axis) of each; a cursor is a line of the figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.lines import Line2D

    from rigidmd.figures.picture import Picture

    still = Picture(figsize=figure.get_size_inches(), dpi=figure.dpi)
    canvas = FigureCanvasAgg(still)
    chosen = plots.panels(record)[:PANELS]
    found = []
    for k, panel in enumerate(chosen):
        height = 0.94 / len(chosen)
        axis = still.add_axes((left + 0.06, 0.98 - height * (k + 1) + 0.07, 0.86 - left, height - 0.11))
        plots.draw_panel(axis, record, panel)
        axis.set_title(panel.title, loc="left", fontsize=9, color=INK, x=-0.06)
        if k == len(chosen) - 1:
            axis.set_xlabel(f"time ({record.time_unit})", fontsize=8, color=INK)
        cursor = Line2D([0, 0], axis.get_position().intervaly, color=WARM, lw=1.2, transform=figure.transFigure)
        found.append((figure.add_artist(cursor), axis))
    canvas.draw()
    figure.figimage(np.asarray(canvas.buffer_rgba()), zorder=-1)
    return found


def _of_body(record: Record) -> Film:
    found = body_film(record)
    end, told = _loop(record, found)
    return Film(BodyPicture(found, not record.body.flies).draw, float(found.time[0]), end, [*found.told, *told])


def _loop(record: Record, film: BodyFilm) -> tuple[float, list[str]]:
    """Where a film ends: where a motion last returns to its start, so that the film can go round without a jump."""
    last = float(film.time[-1])
    dots = np.abs(film.quaternion @ film.quaternion[0]).clip(0, 1)
    away = [2 * np.arccos(dots) / RETURN]
    for values in (*film.vectors.values(), film.position):
        size = np.linalg.norm(values, axis=1).max()
        if size > 0:
            away.append(np.linalg.norm(values - values[0], axis=1) / (NEAR * size))
    off = np.max(away, axis=0)
    left = np.flatnonzero(off > 10)
    if len(left) == 0:
        return last, []
    back = np.flatnonzero((off < 1) & (np.arange(len(off)) > left[0]))
    if len(back) == 0:
        return last, []
    near = back[np.searchsorted(back, back[-1] - 0.1 * len(off)) :]  # the best of the last returns
    end = int(near[off[near].argmin()])
    return float(film.time[end]), [f"The motion returns to its start at {film.time[end]:.6g} s, where the film ends."]


def _of_molecules(record: Record) -> Film:
    frames = frames_of(record, MOST_FRAMES)
    picture = MoleculePicture(record, frames)
    return Film(picture.draw, float(frames.time[0]), float(frames.time[-1]), thinned(frames))
