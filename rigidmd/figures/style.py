"""Functions for all figures: new figures and their files, styles of curves, thinning of long
series, views of 3D objects."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.core.files import atomic_file
from rigidmd.errors import RigidMDError, RigidMDWarning
from rigidmd.figures.save import save_figure, settings

if TYPE_CHECKING:
    from rigidmd.figures.picture import Picture

INK, FAINT, WARM, COOL = "#1f2430", "#8a8f99", "#c8553d", "#2b6f9e"
COLORS = (
    "#2b6f9e",
    "#c8553d",
    "#4f8a5b",
    "#7a5ca3",
    "#b8862d",
    "#1f2430",
    "#3fa7a0",
    "#c2569a",
    "#8a8f99",
    "#7f9a1c",
)
MARKERS = "os^Dv*PX<>"
UP = np.array([0.0, 0.0, 1.0])
DASHES = ((), (5, 1.5), (1.5, 1.2), (6, 1.5, 1.5, 1.5))


def curve_style(k: int) -> dict:
    """Style of the k-th of many curves: ten colours, then other dashes and markers."""
    rounds, color = divmod(k, len(COLORS))
    dashes = DASHES[rounds % len(DASHES)]
    marker = MARKERS[(color + 3 * rounds) % len(MARKERS)]
    return {"color": COLORS[color], "ls": (0, dashes) if dashes else "-", "marker": marker}


@contextmanager
def drawing(path: Path) -> Iterator[None]:
    """Context in which an error of drawing becomes a warning, as results do not depend on pictures.
    The errors of this package are raised."""
    try:
        yield
    except RigidMDError:
        raise
    except Exception as error:  # Matplotlib raises many types
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        warnings.warn(f"{path} cannot be drawn: {reason}", RigidMDWarning, stacklevel=2)


def write_figure(path: Path, draw: Callable[[], Any], title: str = "") -> None:
    """Draw a figure and write it under a title; see `drawing`. Raises OutputError."""
    with drawing(path):
        figure = draw()
        if title:
            figure.suptitle(title, color=INK, x=0.01, ha="left", fontsize=11)
        save_files(figure, path.with_suffix(""), [path.suffix[1:]])


def save_files(figure: "Picture", stem: Path, suffixes: Sequence[str]) -> list[Path]:
    """Write a figure as files of these types, with the same bytes for the same figure. Raises
    OutputError."""
    figure.lay_out(150)
    paths = [stem.with_name(f"{stem.name}.{suffix}") for suffix in suffixes]
    for path in paths:
        options = (
            {"dpi": 100, "metadata": {"Date": None}} if path.suffix == ".svg" else {"dpi": 150}
        )
        with settings({"svg.hashsalt": "rigidmd"}), atomic_file(path) as temporary:
            save_figure(figure, temporary, **options)
    return paths


def new_figure(
    width: float, height: float, layout: Any = "constrained", title: str = "", **options
) -> "Picture":
    """An empty figure of this size, inches, under a title."""
    from rigidmd.figures.picture import Picture  # Matplotlib is slow to import

    figure = Picture(figsize=(width, height), layout=layout, **options)
    if title:
        figure.suptitle(title, color=INK, x=0.01, ha="left", fontsize=11)
    return figure


def panel_grid(
    count: int, across: int, width: float, height: float, margin: float
) -> "tuple[Picture, list[Any]]":
    """A figure of panels in rows of at most `across`, and the axes of the panels. Inches: of a
    panel, and below all."""
    across = min(across, max(1, count))
    down = max(1, -(-count // across))
    figure = new_figure(width * across, height * down + margin)
    axes = list(figure.subplots(down, across, squeeze=False).flat)
    for axis in axes[count:]:
        axis.set_visible(False)
    return figure, axes[:count]


def open_axis(axis, **ticks) -> None:
    """Draw an axis without its frame on top and right, with these settings of ticks, in ink."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[:].set_color(INK)
    axis.tick_params(colors=INK, **ticks)


def thin_series(
    time: np.ndarray, values: np.ndarray, bins: int = 1500
) -> tuple[np.ndarray, np.ndarray]:
    """A long series reduced to the lowest and highest value of each of its parts, whose curve is
    the same."""
    size = len(time) // bins
    if size < 4:
        return time, values
    starts = np.arange(0, len(time) // size * size, size)
    parts = values[: len(starts) * size].reshape(-1, size)
    extremes = np.unique(
        np.concatenate([starts + parts.argmin(1), starts + parts.argmax(1), [0, len(time) - 1]])
    )
    return time[extremes], values[extremes]


def shown_range(values: np.ndarray, stage: np.ndarray) -> tuple[float, float] | None:
    """Limits of the axis of a curve (n,): the range of the second halves of the stages, and as much
    above and below, as the starts of stages would flatten the rest. None if the range is 0."""
    late = np.concatenate(
        [part[len(part) // 2 :] for part in (values[stage == k] for k in np.unique(stage))]
    )
    late, values = late[np.isfinite(late)], values[np.isfinite(values)]
    if len(late) == 0 or not (span := float(np.ptp(late))) > 0:
        return None
    low, high = max(values.min(), late.min() - span), min(values.max(), late.max() + span)
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def thin_path(path: np.ndarray, max_points: int) -> np.ndarray:
    """Indices of at most about `max_points` points of a path (n, d), evenly along its length,
    with its ends."""
    if len(path) <= max_points:
        return np.arange(len(path))
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
    if way[-1] == 0:
        return np.array([0, len(path) - 1])
    marks = np.searchsorted(way, np.linspace(0, way[-1], max_points))
    return np.unique(np.concatenate([marks.clip(0, len(path) - 1), [0, len(path) - 1]]))


def camera(eye: np.ndarray, up: np.ndarray) -> np.ndarray:
    """An orthographic view from the direction `eye`: rows are to the right, upwards and towards the
    eye."""
    toward, right = eye / np.linalg.norm(eye), np.cross(up, eye)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward])


def circle(normal: np.ndarray, polar: float = 90.0) -> np.ndarray:
    """The circle on the unit sphere at this polar angle (degrees) from a direction."""
    right, up, toward = camera(normal, np.eye(3)[np.abs(normal).argmin()])
    angle, polar = np.linspace(0, 2 * np.pi, 361)[:, None], np.radians(polar)
    return np.sin(polar) * (np.cos(angle) * right + np.sin(angle) * up) + np.cos(polar) * toward


def globe() -> list[np.ndarray]:
    """Circles of longitude and latitude on the unit sphere, every 30 degrees."""
    around = [
        circle(np.array([np.cos(a), np.sin(a), 0.0])) for a in np.radians(np.arange(0, 180, 30))
    ]
    return [*around, *(circle(UP, polar) for polar in range(30, 180, 30))]


def draw_front_and_back(
    axis, points, view: np.ndarray, depth, alphas: tuple[float, float], **style
) -> None:
    """Draw a line that is strong on the side of the eye (depth >= 0) and faint on the other."""
    flat, front = points @ view[:2].T, depth >= 0
    joined = front.copy()
    joined[:-1] |= front[1:]
    joined[1:] |= front[:-1]
    for part, alpha, order in ((joined, alphas[0], 3), (~front, alphas[1], 1.5)):
        axis.plot(*np.where(part[:, None], flat, np.nan).T, alpha=alpha, zorder=order, **style)


def draw_scale(
    axis, right: float, foot: float, length: float, label: str, fontsize: float = 10
) -> None:
    """Draw a bar of this length with its label above it, from its right end at (right, foot)."""
    axis.plot(
        [right - length, right], [foot, foot], color=INK, lw=2, solid_capstyle="butt", zorder=4
    )
    style = {"ha": "right", "va": "bottom", "zorder": 4, "textcoords": "offset points"}
    axis.annotate(label, (right, foot), (0, 3), color=INK, fontsize=fontsize, **style)


def label_minor_ticks(line) -> None:
    """Label a logarithmic axis (`axis.xaxis` or `.yaxis`) between powers of ten if it has fewer
    than two of them."""
    from matplotlib.ticker import LogFormatterSciNotation

    line.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(1.0, 0.5)))
    line.set_tick_params(which="minor", labelsize=7)
