"""The analyses by name: those that come with the package, and those of users."""

import runpy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.analysis.findings import Curve, Finding, Value, settled
from rigidmd.analysis.history import History
from rigidmd.core.files import unreadable_reason
from rigidmd.core.statistics import correlation_time, mean
from rigidmd.errors import OutputError
from rigidmd.scene.validation import did_you_mean


class Analysis(NamedTuple):
    """A function of a history under its name."""

    name: str
    about: str
    function: Callable[..., Finding]
    own: bool


KNOWN: dict[str, Analysis] = {}
ORDER = (
    "rdf", "structure_factor", "density_profile", "hydrogen_bonds", "msd", "diffusion", "orientation", "spectrum",
    "dielectric", "viscosity",
)  # fmt: skip


def built_in(about: str) -> Callable[[Callable[..., Finding]], Callable[..., Finding]]:
    """Register an analysis that comes with the package under the name of its function."""

    def add(function: Callable[..., Finding]) -> Callable[..., Finding]:
        name = function.__name__
        KNOWN[name] = Analysis(name, about, function, False)
        return function

    return add


def register(function: Callable[[History], Any]) -> Callable[[History], Any]:
    """Register an analysis of one's own under the name of its function; `rigidmd analyse --only NAME` finds it.

    @rigidmd.analysis.register
    def height(frames):
        "mean height of the centres (Å)"
        return frames.positions[:, :, 2].mean(axis=1)

    The function gets the frames (`rigidmd.analysis.history.History`: time, positions, Q, L, velocities, cell, ...) and
    returns one number for each frame (f,), or a dictionary of such arrays; means, errors, a CSV file and a figure are
    made of them. Its first line of documentation is the title. Raises OutputError for a name that is taken.
    """
    name = getattr(function, "__name__", "")
    if name in ORDER:  # whether those are registered yet or not
        raise OutputError(f"{name} is an analysis that comes with rigidmd; name your function otherwise")
    if not name.isidentifier():
        raise OutputError(f"an analysis has the name of its function, and {name or function!r} is no name: use def")
    about = ((function.__doc__ or "").strip().splitlines() or [name])[0]
    KNOWN[name] = Analysis(name, about, lambda history: _of_own(name, about, function, history), True)
    return function


def selected(names: list[str]) -> list[Analysis]:
    """The analyses of these names, or all. Raises OutputError."""
    known = sorted(KNOWN, key=place)
    for name in names:
        if name not in KNOWN:
            raise OutputError(
                f"there is no analysis {name!r}{did_you_mean(name, known) or ';'} there are {', '.join(known)}"
            )
    return [KNOWN[name] for name in names or known]


def place(name: str) -> int:
    """The place of an analysis among all: those of users at the end."""
    return ORDER.index(name) if name in ORDER else len(ORDER)


def trusted(path: Path) -> None:
    """Run a Python file that defines analyses: it is code, and the user said that it may run. Raises OutputError."""
    if fault := unreadable_reason(path):
        raise OutputError(f"{path}: {fault}")
    before = dict(KNOWN)
    try:
        runpy.run_path(str(path))
    except OutputError as error:
        raise OutputError(f"{path}: {error}") from None
    except (Exception, SystemExit) as error:  # whatever a stranger's file raises
        raise OutputError(f"{path} raised {type(error).__name__}: {error}") from error
    if not any(entry.own and entry is not before.get(name) for name, entry in KNOWN.items()):
        raise OutputError(f"{path} defines no analysis: put @rigidmd.analysis.register before a function of frames")


def _of_own(name: str, about: str, function: Callable[[History], Any], history: History) -> Finding:
    """Means and errors of what a function of users gives."""
    try:
        found = function(history)
    except (Exception, SystemExit) as error:  # whatever a stranger's function raises
        raise OutputError(f"the analysis {name} raised {type(error).__name__}: {error}") from error
    series = dict(found) if isinstance(found, Mapping) else {name: found}
    if not series:
        raise OutputError(f"the analysis {name} gave an empty dictionary")
    values, columns = [], {}
    for title, given in series.items():
        try:
            array = np.asarray(given, float)
        except (TypeError, ValueError):
            array = np.array([])
        if array.shape != (len(history),):
            raise OutputError(
                f"the analysis {name} must give one number for each of the {len(history)} frames, or a dictionary of "
                f"such arrays; {title!r} has the shape {np.shape(given)}"
            )
        if not np.isfinite(array).all():
            raise OutputError(
                f"the analysis {name}: {title!r} is no finite number at frame {np.isfinite(array).argmin() + 1}"
            )
        columns[str(title)] = array
        value, error = mean(array)
        gap = history.span / (len(history) - 1)
        if np.ptp(array) == 0 or value is None:
            values.append(Value(str(title), "", float(array[0]), 0.0))
        else:
            tau = correlation_time(array, gap)
            values.append(settled(str(title), "", value, error, history.span, tau))
    return Finding(name, about, values, [Curve(name, ("Time (ps)", history.time), about, columns)])
