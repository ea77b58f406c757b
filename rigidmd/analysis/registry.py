"""The analyses by name, built-in and user-defined."""

import runpy
from collections.abc import Callable, Mapping
from functools import wraps
from importlib import import_module
from math import inf
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, NamedTuple

import numpy as np

from rigidmd.analysis.result import AnalysisResult, Curve, Value, converged_value
from rigidmd.analysis.rigid_frames import RigidFrames
from rigidmd.core.files import unreadable_reason
from rigidmd.core.statistics import correlation_time, mean_and_error
from rigidmd.errors import OutputError
from rigidmd.scene.validation import did_you_mean

Function = Callable[..., AnalysisResult]


class Analysis(NamedTuple):
    """A function of frames under its name."""

    name: str
    about: str
    function: Function
    position: float  # among all; user-defined ones are at the end
    is_user: bool


KNOWN: dict[str, Analysis] = {}


def built_in(about: str, position: float = inf) -> Callable[[Function], Function]:
    """Register a built-in analysis under the name of its function."""

    def add(function: Function) -> Function:
        KNOWN[function.__name__] = Analysis(function.__name__, about, function, position, False)
        return function

    return add


def load_built_in() -> None:
    """Import the modules of `analysis/built_in/`, which register their analyses."""
    from rigidmd.analysis import built_in as folder

    for module in iter_modules(folder.__path__):
        import_module(f"{folder.__name__}.{module.name}")


def register(function: Callable[[RigidFrames], Any]) -> Callable[[RigidFrames], Any]:
    """Register a user-defined analysis under the name of its function; `rigidmd analyse --only NAME` runs it.

    @rigidmd.analysis.register
    def height(frames):
        "mean height of the centres (Å)"
        return frames.positions[:, :, 2].mean(axis=1)

    The function gets a `rigidmd.analysis.rigid_frames.RigidFrames` (time, positions, Q, L, velocities, cell, ...) and
    returns one number for each frame (f,), or a dictionary of such arrays, of which means, errors, a CSV file and a
    figure are made. The first line of its docstring is the title. Raises OutputError if the name is not free.
    """
    name = getattr(function, "__name__", "")
    if is_built_in(name):
        raise OutputError(f"{name} is an analysis of rigidmd; rename your function")
    if not name.isidentifier():
        raise OutputError(f"an analysis has the name of its function; {name or function!r} is not a name: use def")
    about = ((function.__doc__ or "").strip().splitlines() or [name])[0]

    @wraps(function)
    def analysis(frames: RigidFrames) -> AnalysisResult:
        """Means and errors of its values."""
        try:
            found = function(frames)
        except (Exception, SystemExit) as error:  # a user's function may raise anything
            raise OutputError(f"the analysis {name} raised {type(error).__name__}: {error}") from error
        series = dict(found) if isinstance(found, Mapping) else {name: found}
        if not series:
            raise OutputError(f"the analysis {name} returned an empty dictionary")
        columns = {str(title): _checked_series(name, title, given, len(frames)) for title, given in series.items()}
        values = []
        for title, array in columns.items():
            value, error = mean_and_error(array)
            if np.ptp(array) == 0 or value is None:
                values.append(Value(title, "", float(array[0]), 0.0))
            else:
                tau = correlation_time(array, frames.span / (len(frames) - 1))
                values.append(converged_value(title, "", value, error, frames.span, tau))
        return AnalysisResult(name, about, values, [Curve(name, ("Time (ps)", frames.time), about, columns)])

    KNOWN[name] = Analysis(name, about, analysis, inf, True)
    return function


def selected(names: list[str]) -> list[Analysis]:
    """The analyses with these names, or all. Raises OutputError."""
    known = sorted(KNOWN, key=analysis_order)
    for name in names:
        if name not in KNOWN:
            hint = did_you_mean(name, known) or ";"
            raise OutputError(f"unknown analysis {name!r}{hint} there are {', '.join(known)}")
    return [KNOWN[name] for name in names or known]


def analysis_order(name: str) -> float:
    return KNOWN[name].position if name in KNOWN else inf


def is_built_in(name: str) -> bool:
    return name in KNOWN and not KNOWN[name].is_user


def run_user_file(path: Path) -> None:
    """Run a Python file that defines analyses, which the user trusts. Raises OutputError."""
    if fault := unreadable_reason(path):
        raise OutputError(f"{path}: {fault}")
    before = dict(KNOWN)
    try:
        runpy.run_path(str(path))
    except OutputError as error:
        raise OutputError(f"{path}: {error}") from None
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        raise OutputError(f"{path} raised {type(error).__name__}: {error}") from error
    if not any(entry.is_user and entry is not before.get(name) for name, entry in KNOWN.items()):
        raise OutputError(f"{path} defines no analysis: put @rigidmd.analysis.register before a function of frames")


def _checked_series(name: str, title: object, given: Any, count: int) -> np.ndarray:
    """What a user-defined analysis returned, as one number for each frame (f,). Raises OutputError."""
    try:
        array = np.asarray(given, float)
    except (TypeError, ValueError):
        array = np.array([])
    if array.shape != (count,):
        raise OutputError(
            f"the analysis {name} must return one number for each of the {count} frames, or a dictionary of such "
            f"arrays; {title!r} has the shape {np.shape(given)}"
        )
    if not np.isfinite(array).all():
        frame = np.isfinite(array).argmin() + 1
        raise OutputError(f"the analysis {name}: {title!r} is not a finite number at frame {frame}")
    return array
