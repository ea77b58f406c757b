"""Animations of runs as files, which `rigidmd film` writes: .mp4 by ffmpeg, .gif by Pillow, frames
by Matplotlib."""

import contextlib
import importlib
import shutil
import subprocess
from collections.abc import Callable, Iterator
from itertools import chain
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.files import atomic_file
from rigidmd.errors import OutputError
from rigidmd.features.view.figures.panels import draw_rows
from rigidmd.features.view.figures.style import COLORS, INK, WARM, new_figure
from rigidmd.features.view.kind_display import display_of, panels
from rigidmd.features.view.page import Animation
from rigidmd.run.record import Record, read_record
from rigidmd.scene.validation import not_none

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidmd.features.view.figures.picture import Picture

EXTENSIONS = (".mp4", ".gif")
#: Frames per second, length in seconds, and height in pixels of an animation; inches of its
#: picture. A frame of a .gif lasts a whole number of hundredths of a second.
RATE = {".mp4": 25, ".gif": 12.5}
SECONDS = 10.0
HEIGHT = {".mp4": 640, ".gif": 300}
INCHES = 5.0
#: Panels above one another next to an animation; inches of one of more of them, in two columns;
#: size of its name and clock, colour of the cursor of panels.
PANELS, PANEL_HEIGHT = 3, 1.8
FONT = 13
CURSOR = tuple(bytes.fromhex(WARM[1:]))
#: Most frames of molecules that are read.
MOST_FRAMES = 2000
#: Most bytes of a .gif of the default height, which otherwise has every second or third frame only.
GIF_BYTES = 500_000
GIF_STEPS = (1, 2, 3)
#: Colours of a .gif besides those of curves, the same in all frames, so that what is at rest is
#: stored once.
GIF_COLORS = 40


def ffmpeg() -> str | None:
    """The program that writes .mp4, on the path or in the package imageio-ffmpeg, or None."""
    if program := shutil.which("ffmpeg"):
        return program
    # RuntimeError: the package without its program
    with contextlib.suppress(ImportError, RuntimeError):
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return None


def default_name() -> str:
    """The default name of a file: .mp4 if there is ffmpeg."""
    return f"film{EXTENSIONS[0] if ffmpeg() else EXTENSIONS[1]}"


def write_film(
    folder: Path,
    path: Path,
    seconds: float = SECONDS,
    *,
    with_plots: bool = False,
    height: int | None = None,
    progress: Callable[[float], object] = lambda fraction: None,
) -> tuple[Path, list[str]]:
    """Write the animation of the run in a folder. Returns its path, and notes on it. Raises
    OutputError.

    seconds : its length; height : pixels, made even; progress : called with the fraction done
    """
    kind = path.suffix
    if kind == ".mp4" and ffmpeg() is None:
        advice = "install the program, or `pip install imageio-ffmpeg`, which contains it"
        raise OutputError(f"{path}: .mp4 needs ffmpeg: {advice}. A .gif needs no other program")
    record = read_record(folder)
    animation = display_of(record.scene).animation(record, MOST_FRAMES)
    begin, (end, notes) = float(animation.time[0]), animation.loop_end()
    count = max(2, round(seconds * RATE[kind]))
    times = np.linspace(begin, end, count)
    notes = [*record.missing, *animation.notes, *notes]
    notes += animation.film_notes(times[1] - times[0], seconds)
    pixels = 2 * round((height or HEIGHT[kind]) / 2)
    frames = _frames(record, animation, times, pixels, with_plots=with_plots, progress=progress)
    with atomic_file(path) as temporary:
        try:
            if kind == ".gif":
                _write_gif(temporary, frames, inf if height else GIF_BYTES)
            else:
                _write_mp4(temporary, frames)
        except (OSError, ValueError) as error:
            raise OutputError(f"{path} cannot be written: {error}") from None
    rate = f"{(end - begin) / seconds:.3g} {record.time_unit} per second"
    return path, [*notes, f"{seconds:g} s of animation: {rate}"]


def _pixels(figure: "Picture") -> np.ndarray:
    """Red, green and blue of a figure, (h, w, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def within(axis: "Axes", time: float) -> bool:
    """Whether an axis of times has this one: that of a stage has no others."""
    left, right = axis.get_xlim()
    return left <= time <= right


def _frames(
    record: Record,
    animation: Animation,
    times: np.ndarray,
    pixels: int,
    *,
    with_plots: bool,
    progress: Callable[[float], object],
) -> Iterator[np.ndarray]:
    """The pictures (h, w, 3) of an animation, with a name and a clock, next to plots."""
    dpi = pixels / INCHES
    plots, cursors = _plots(record, pixels) if with_plots else (np.empty((pixels, 0, 3), "u1"), [])
    figure = new_figure(INCHES, INCHES, layout=None, dpi=dpi)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    style = {"color": INK, "fontsize": FONT, "va": "top"}
    figure.text(0.02, 0.97, record.scene.name, weight="bold", **style)
    clock = figure.text(0.02, 0.92, "", **style)
    digits = int(np.clip(2 - np.floor(np.log10((times[-1] - times[0]) or 1.0)), 0, 6))
    for k, time in enumerate(times):
        animation.draw(axes, time)
        clock.set_text(f"{time:.{digits}f} {record.time_unit}")
        beside = plots.copy()
        for axis in (axis for axis in cursors if within(axis, time)):
            x = int(axis.transData.transform((time, 0))[0])
            low, high = (pixels - int(end) for end in axis.bbox.intervaly)
            beside[high:low, x : x + 2] = CURSOR
        yield np.hstack([_pixels(figure), beside])
        progress((k + 1) / len(times))


def _plots(record: Record, pixels: int) -> "tuple[np.ndarray, list[Axes]]":
    """A picture of all plots of a run with this height, and their axes."""
    drawn = panels(record)
    across = 1 if len(drawn) <= PANELS else 2
    rows = [drawn[k : k + across] for k in range(0, len(drawn), across)]
    height = max(INCHES, PANEL_HEIGHT * len(rows))
    dpi = pixels / height
    width = 2 * round(0.375 * INCHES * across * dpi) / dpi  # an even number of pixels
    figure = new_figure(width, height, layout=None, dpi=dpi)
    axes = draw_rows(figure, rows, (0.0, 0.05, width, height - 0.1))
    return _pixels(figure), axes


def _write_gif(path: Path, frames: Iterator[np.ndarray], most: float) -> None:
    """Write frames with one palette, without dithering, by which still parts would flicker."""
    from PIL import Image

    pictures = [*frames]
    some = np.vstack(pictures[:: -(-len(pictures) // 8)])
    colors = Image.fromarray(some).quantize(GIF_COLORS).getpalette()
    palette = Image.new("P", (1, 1))
    palette.putpalette(
        bytes(colors or ()) + bytes.fromhex("".join(COLORS).replace("#", "") + "ffffff")
    )
    quantized = [
        Image.fromarray(x).quantize(palette=palette, dither=Image.Dither.NONE) for x in pictures
    ]
    for step in GIF_STEPS:
        first, *others = quantized[::step]
        first.save(
            path,
            save_all=True,
            append_images=others,
            duration=round(1000 * step / RATE[".gif"]),
            loop=0,
            optimize=True,
        )
        if path.stat().st_size < most:
            break


def _write_mp4(path: Path, frames: Iterator[np.ndarray]) -> None:
    first = next(frames)
    size = f"{first.shape[1]}x{first.shape[0]}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(RATE[".mp4"])]
    target = ["-codec:v", "h264", "-pix_fmt", "yuv420p", "-crf", "20", str(path)]
    command = [str(ffmpeg()), "-loglevel", "error", "-y", *source, "-i", "-", *target]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as program:
        for frame in chain([first], frames):
            not_none(program.stdin).write(frame.tobytes())
    if program.returncode:
        raise OSError(f"ffmpeg ended with exit code {program.returncode}")
