"""Animations of runs as files, which `rigidmd film` writes: .mp4 by ffmpeg, .gif by Pillow, frames by Matplotlib."""

import contextlib
import importlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.core.files import atomic_file
from rigidmd.errors import OutputError
from rigidmd.figures.style import INK, WARM
from rigidmd.run.record import Record, read_record
from rigidmd.view import plots
from rigidmd.view.body_animation import BodyAnimation, BodyDrawing, animate_body
from rigidmd.view.molecule_animation import MoleculeDrawing, describe_thinning, frames_of

EXTENSIONS = (".mp4", ".gif")
#: Frames per second, length in seconds, and height in pixels of an animation; inches of its picture.
RATE, SECONDS, HEIGHT = {".mp4": 25, ".gif": 15}, 10.0, {".mp4": 640, ".gif": 448}
INCHES = 6.4
#: Rotations between two frames beyond which a body seems to rotate backwards.
MAX_ROTATION = 0.5
#: Most panels next to an animation.
PANELS = 3
#: Most frames of molecules that are read.
MOST_FRAMES = 2000
#: Differences of Q (rad), and of velocities and position, in their largest values, at which a motion has returned.
RETURN_ANGLE, RETURN_FRACTION = 0.03, 0.02


class Animation(NamedTuple):
    """A function that draws a time into axes, the first and last time, and notes."""

    draw: Callable
    begin: float
    end: float
    notes: list[str]


def ffmpeg() -> str | None:
    """The program that writes .mp4, on the path or in the package imageio-ffmpeg, or None."""
    if found := shutil.which("ffmpeg"):
        return found
    with contextlib.suppress(ImportError, RuntimeError):  # RuntimeError: the package without its program
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return None


def default_name() -> str:
    """The default name of a file: .mp4 if there is ffmpeg."""
    return f"film{EXTENSIONS[0] if ffmpeg() else EXTENSIONS[1]}"


def check_writer(path: Path) -> None:
    """Raise OutputError if a file of this format cannot be written on this machine."""
    if path.suffix == ".mp4" and ffmpeg() is None:
        raise OutputError(
            f"{path}: .mp4 needs ffmpeg: install the program, or `pip install imageio-ffmpeg`, which contains it; "
            "a .gif needs no other program"
        )


def write_film(
    folder: Path, path: Path, seconds: float = SECONDS, with_plots: bool = False, height: int | None = None,
    progress: Callable[[float], object] = lambda fraction: None,
) -> tuple[Path, list[str]]:  # fmt: skip
    """Write the animation of the run in a folder. Returns its path, and notes on it. Raises OutputError.

    seconds : its length; height : pixels, made even; progress : called with the fraction done
    """
    from matplotlib import animation, rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from rigidmd.figures.picture import Picture

    check_writer(path)
    record = read_record(folder)
    drawn = _body_animation(record) if record.is_body else _molecular_animation(record)
    pixels = 2 * round((height or HEIGHT[path.suffix]) / 2)
    across = 2 * round(pixels * (1.75 if with_plots else 1.0) / 2)
    figure = Picture(figsize=(INCHES * across / pixels, INCHES), dpi=pixels / INCHES)
    FigureCanvasAgg(figure)
    width = 1 / 1.75 if with_plots else 1.0
    axes = figure.add_axes((0.0, 0.0, width, 1.0))
    cursors = _draw_panels(figure, record, width) if with_plots else []
    figure.text(0.02, 0.965, record.scene.name, color=INK, fontsize=13, weight="bold", va="top")
    clock = figure.text(0.02, 0.92, "", color=INK, fontsize=13, va="top")
    rate = RATE[path.suffix]
    count = max(2, round(seconds * rate))
    digits = int(np.clip(2 - np.floor(np.log10((drawn.end - drawn.begin) or 1.0)), 0, 6))
    kind = animation.FFMpegWriter if path.suffix == ".mp4" else animation.PillowWriter
    options = {"codec": "h264", "extra_args": ["-pix_fmt", "yuv420p", "-crf", "20"]} if path.suffix == ".mp4" else {}
    writer = kind(fps=rate, **options)
    times = np.linspace(drawn.begin, drawn.end, count)
    notes = [*record.missing, *drawn.notes, *_rotation_notes(record, times, seconds)]
    with atomic_file(path) as temporary, rc_context({"animation.ffmpeg_path": ffmpeg() or "ffmpeg"}):
        try:
            with writer.saving(figure, str(temporary), figure.dpi):
                for k, time in enumerate(times):
                    drawn.draw(axes, time)
                    clock.set_text(f"{time:.{digits}f} {record.time_unit}")
                    for cursor, axis in cursors:
                        low, high = axis.get_xlim()
                        box = axis.get_position()
                        at = box.x0 + (time - low) / (high - low) * box.width
                        cursor.set_xdata([at, at])
                    writer.grab_frame()
                    progress((k + 1) / count)
        except (RuntimeError, ValueError) as error:
            raise OutputError(f"{path} cannot be written: {error}") from None
    speed = (drawn.end - drawn.begin) / seconds
    return path, [*notes, f"{seconds:g} s of film: {speed:.3g} {record.time_unit} per second"]


def _rotation_notes(record: Record, times: np.ndarray, seconds: float) -> list[str]:
    """A sentence if a single body rotates too far between frames for its rotation to be seen."""
    if not record.is_body or "omega_lab_x" not in record.columns:
        return []
    size = np.linalg.norm([record.columns[f"omega_lab_{k}"] for k in "xyz"], axis=0)
    turns = float(size.max() * (times[1] - times[0]) / (2 * np.pi))
    if turns <= MAX_ROTATION:
        return []
    return [
        f"The body rotates up to {turns:.2g} times between two frames, so that it may seem to stand or to rotate "
        f"backwards: an animation of {seconds * turns / MAX_ROTATION:.3g} s shows its rotation."
    ]


def _draw_panels(figure, record: Record, left: float) -> list[tuple[Any, Any]]:
    """Put the first plots of the run next to the picture, as an image. Returns (cursor line, axis) of each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.lines import Line2D

    from rigidmd.figures.picture import Picture

    still = Picture(figsize=figure.get_size_inches(), dpi=figure.dpi)
    canvas = FigureCanvasAgg(still)
    panels = plots.panels(record)[:PANELS]
    found = []
    for k, panel in enumerate(panels):
        height = 0.94 / len(panels)
        axis = still.add_axes((left + 0.06, 0.98 - height * (k + 1) + 0.07, 0.86 - left, height - 0.11))
        plots.draw_panel(axis, record, panel)
        axis.set_title(panel.title, loc="left", fontsize=9, color=INK, x=-0.06)
        if k == len(panels) - 1:
            axis.set_xlabel(f"time ({record.time_unit})", fontsize=8, color=INK)
        cursor = Line2D([0, 0], axis.get_position().intervaly, color=WARM, lw=1.2, transform=figure.transFigure)
        found.append((figure.add_artist(cursor), axis))
    canvas.draw()
    figure.figimage(np.asarray(canvas.buffer_rgba()), zorder=-1)
    return found


def _body_animation(record: Record) -> Animation:
    found = animate_body(record)
    end, notes = _loop_end(found)
    draw = BodyDrawing(found, not record.body.translates).draw
    return Animation(draw, float(found.time[0]), end, [*found.notes, *notes])


def _loop_end(animation: BodyAnimation) -> tuple[float, list[str]]:
    """End of an animation, and a note: the last return of the motion to its start, to repeat it without a jump."""
    last = float(animation.time[-1])
    dots = np.abs(animation.quaternion @ animation.quaternion[0]).clip(0, 1)
    away = [2 * np.arccos(dots) / RETURN_ANGLE]
    for values in (*animation.vectors.values(), animation.position):
        size = np.linalg.norm(values, axis=1).max()
        if size > 0:
            away.append(np.linalg.norm(values - values[0], axis=1) / (RETURN_FRACTION * size))
    off = np.max(away, axis=0)
    left = np.flatnonzero(off > 10)
    if len(left) == 0:
        return last, []
    back = np.flatnonzero((off < 1) & (np.arange(len(off)) > left[0]))
    if len(back) == 0:
        return last, []
    near = back[np.searchsorted(back, back[-1] - 0.1 * len(off)) :]  # the best of the last returns
    end = int(near[off[near].argmin()])
    return float(animation.time[end]), [
        f"The motion returns to its start at {animation.time[end]:.6g} s, where the film ends."
    ]


def _molecular_animation(record: Record) -> Animation:
    frames = frames_of(record, MOST_FRAMES)
    picture = MoleculeDrawing(record, frames)
    return Animation(picture.draw, float(frames.time[0]), float(frames.time[-1]), describe_thinning(frames))
