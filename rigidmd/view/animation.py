"""Animations of runs as files, which `rigidmd film` writes: .mp4 by ffmpeg, .gif by Pillow, frames
by Matplotlib."""

import contextlib
import importlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.core.files import atomic_file
from rigidmd.errors import OutputError
from rigidmd.figures.style import INK, WARM, new_figure
from rigidmd.run.record import Record, read_record
from rigidmd.view import plots
from rigidmd.view.run_page import animation_of

EXTENSIONS = (".mp4", ".gif")
#: Frames per second, length in seconds, and height in pixels of an animation; inches of its
#: picture. A frame of a .gif lasts a whole number of hundredths of a second.
RATE, SECONDS, HEIGHT = {".mp4": 25, ".gif": 12.5}, 10.0, {".mp4": 640, ".gif": 448}
INCHES = 6.4
#: Most panels next to an animation.
PANELS = 3
#: Most frames of molecules that are read.
MOST_FRAMES = 2000


def ffmpeg() -> str | None:
    """The program that writes .mp4, on the path or in the package imageio-ffmpeg, or None."""
    if program := shutil.which("ffmpeg"):
        return program
    with contextlib.suppress(
        ImportError, RuntimeError
    ):  # RuntimeError: the package without its program
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return None


def default_name() -> str:
    """The default name of a file: .mp4 if there is ffmpeg."""
    return f"film{EXTENSIONS[0] if ffmpeg() else EXTENSIONS[1]}"


def write_film(
    folder: Path,
    path: Path,
    seconds: float = SECONDS,
    with_plots: bool = False,
    height: int | None = None,
    progress: Callable[[float], object] = lambda fraction: None,
) -> tuple[Path, list[str]]:
    """Write the animation of the run in a folder. Returns its path, and notes on it. Raises
    OutputError.

    seconds : its length; height : pixels, made even; progress : called with the fraction done
    """
    from matplotlib import rc_context
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    if path.suffix == ".mp4" and ffmpeg() is None:
        advice = "install the program, or `pip install imageio-ffmpeg`, which contains it"
        raise OutputError(f"{path}: .mp4 needs ffmpeg: {advice}; a .gif needs no other program")
    record = read_record(folder)
    animation = animation_of(record, MOST_FRAMES)
    begin, (end, notes) = float(animation.time[0]), animation.loop_end()
    pixels = 2 * round((height or HEIGHT[path.suffix]) / 2)
    across = 2 * round(pixels * (1.75 if with_plots else 1.0) / 2)
    figure = new_figure(INCHES * across / pixels, INCHES, layout=None, dpi=pixels / INCHES)
    FigureCanvasAgg(figure)
    width = 1 / 1.75 if with_plots else 1.0
    axes = figure.add_axes((0.0, 0.0, width, 1.0))
    cursors = _draw_panels(figure, record, width) if with_plots else []
    figure.text(0.02, 0.965, record.scene.name, color=INK, fontsize=13, weight="bold", va="top")
    clock = figure.text(0.02, 0.92, "", color=INK, fontsize=13, va="top")
    rate = RATE[path.suffix]
    count = max(2, round(seconds * rate))
    digits = int(np.clip(2 - np.floor(np.log10((end - begin) or 1.0)), 0, 6))
    kind = FFMpegWriter if path.suffix == ".mp4" else PillowWriter
    options = (
        {"codec": "h264", "extra_args": ["-pix_fmt", "yuv420p", "-crf", "20"]}
        if path.suffix == ".mp4"
        else {}
    )
    writer = kind(fps=rate, **options)
    times = np.linspace(begin, end, count)
    notes = [
        *record.missing,
        *animation.notes,
        *notes,
        *animation.film_notes(times[1] - times[0], seconds),
    ]
    with (
        atomic_file(path) as temporary,
        rc_context({"animation.ffmpeg_path": ffmpeg() or "ffmpeg"}),
    ):
        try:
            with writer.saving(figure, str(temporary), figure.dpi):
                for k, time in enumerate(times):
                    animation.draw(axes, time)
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
    return path, [
        *notes,
        f"{seconds:g} s of animation: {(end - begin) / seconds:.3g} {record.time_unit} per second",
    ]


def _draw_panels(figure, record: Record, left: float) -> list[tuple[Any, Any]]:
    """Put the first plots of the run next to the picture, as an image. Returns (cursor line, axis)
    of each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.lines import Line2D

    still = new_figure(*figure.get_size_inches(), layout=None, dpi=figure.dpi)
    canvas = FigureCanvasAgg(still)
    panels = plots.panels(record)[:PANELS]
    cursors = []
    for k, panel in enumerate(panels):
        height = 0.94 / len(panels)
        axis = still.add_axes(
            (left + 0.06, 0.98 - height * (k + 1) + 0.07, 0.86 - left, height - 0.11)
        )
        plots.draw_panel(axis, record, panel)
        axis.set_title(panel.title, loc="left", fontsize=9, color=INK, x=-0.06)
        if k == len(panels) - 1:
            axis.set_xlabel(f"time ({record.time_unit})", fontsize=8, color=INK)
        cursor = Line2D(
            [0, 0], axis.get_position().intervaly, color=WARM, lw=1.2, transform=figure.transFigure
        )
        cursors.append((figure.add_artist(cursor), axis))
    canvas.draw()
    figure.figimage(np.asarray(canvas.buffer_rgba()), zorder=-1)
    return cursors
