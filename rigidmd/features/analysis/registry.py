"""The analyses by name, built-in and user-defined."""

import runpy
from collections.abc import Callable, Mapping
from functools import cache, wraps
from importlib import import_module
from math import inf
from pathlib import Path
from pkgutil import iter_modules
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidmd.core.files import unreadable_reason
from rigidmd.core.toml import Json
from rigidmd.errors import OutputError
from rigidmd.features import modules
from rigidmd.features.analysis.conditions import Condition, check_conditions, trajectory
from rigidmd.features.analysis.options import check_value, options_of
from rigidmd.features.analysis.result import (
    AnalysisResult,
    Curve,
    Value,
    converged_value,
    correlation_time_of,
    mean_of_series,
    with_error,
)
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.features.analysis.runs import Runs, as_runs
from rigidmd.scene.validation import did_you_mean

Function = Callable[..., AnalysisResult]
#: A user-defined analysis: a number for each frame, or such series by their titles.
UserFunction = Callable[[RigidFrames], ArrayLike | Mapping[str, ArrayLike]]


class Analysis(NamedTuple):
    """A function of frames under its name."""

    name: str
    about: str
    function: Function
    position: float  # among all; user-defined ones are at the end
    is_user: bool
    on_request: bool = False  # not among all, because it takes long or needs options
    needs: tuple[Condition, ...] = (trajectory,)


KNOWN: dict[str, Analysis] = {}


def built_in(
    about: str,
    position: float = inf,
    on_request: bool = False,
    needs: tuple[Condition, ...] = (trajectory,),
) -> Callable[[Function], Function]:
    """Register a built-in analysis under its function's name in `Runs`, which takes the frames of
    one run too. `needs` lists its conditions, see `features.analysis.conditions`: they are checked
    before it runs."""

    def add(function: Function) -> Function:
        name = function.__name__
        known = options_of(function)

        @wraps(function)
        def analysis(
            frames: RigidFrames | Runs, *arguments: object, **options: object
        ) -> AnalysisResult:
            runs = as_runs(frames)
            for key, value in [*zip(known, arguments, strict=False), *options.items()]:
                if key in known:
                    check_value(known[key], value)
            check_conditions(name, runs, needs)
            result = function(runs, *arguments, **options)
            result.values = [with_error(value) for value in result.values]
            stages = dict.fromkeys(stage.label for run in runs.members for stage in run.stages)
            if len(stages) > 1:
                result.notes.append(
                    f"of the stages {', '.join(stages)} together; from"
                    f" {runs.first.begin_of_stage:g} ps on frames are of the last one"
                )
            return result

        KNOWN[name] = Analysis(
            name, about, analysis, position, is_user=False, on_request=on_request, needs=needs
        )
        return analysis

    return add


def load_built_in() -> None:
    """Import the modules of `analysis/built_in/` and of features, which register their analyses."""
    from rigidmd.features.analysis import built_in as folder

    names = {m.name: f"{folder.__name__}.{m.name}" for m in iter_modules(folder.__path__)}
    names |= modules("analyses")
    for _, name in sorted(names.items()):
        import_module(name)


@cache
def _load_once() -> None:
    load_built_in()


def known() -> dict[str, Analysis]:
    """The analyses by name."""
    _load_once()
    return KNOWN


def register(function: UserFunction) -> UserFunction:
    """Register a user-defined analysis under the name of its function. `rigidmd analyse --only
    NAME` runs it.

    Parameters
    ----------
    function : callable
        Called with a `rigidmd.features.analysis.rigid_frames.RigidFrames` (time, positions, Q, L,
        velocities, cell, ...). It returns one number for each frame (f,), or a dictionary of such
        arrays, of which means, errors, a CSV file and a figure are made. The first line of its
        docstring is the title

    Returns
    -------
    callable
        The same function

    Raises
    ------
    OutputError
        If the name is not free.

    Examples
    --------
        @rigidmd.analysis.register
        def height(frames):
            "mean height of the centres (Å)"
            return frames.positions[:, :, 2].mean(axis=1)
    """
    name = getattr(function, "__name__", "")
    if is_built_in(name):
        raise OutputError(f"{name} is an analysis of rigidmd. Rename your function")
    if not name.isidentifier():
        raise OutputError(
            f"an analysis has the name of its function; {name or function!r} is not a name: use def"
        )
    about = ((function.__doc__ or "").strip().splitlines() or [name])[0]

    @wraps(function)
    def analysis(frames: RigidFrames | Runs) -> AnalysisResult:
        """Means and errors of its values."""
        runs = as_runs(frames)
        check_conditions(name, runs, [trajectory])
        every = [_series_of(function, name, run) for run in runs.members]
        columns = {
            title: [of_run[title] for of_run in every if title in of_run] for title in every[0]
        }
        result = AnalysisResult(name, about)
        for title, series in columns.items():
            if len(series) < len(every):
                raise OutputError(
                    f"the analysis {name} returned {title!r} for some of the runs only"
                )
            value, error = mean_of_series(runs, series)
            if max(map(np.ptp, series)) == 0 and not error:
                result.values.append(Value(title, "", value, None))  # a constant
            else:
                tau = correlation_time_of(runs, series)
                result.values.append(converged_value(title, "", value, error, runs.span, tau))
        shown = {
            title: np.mean([values[: runs.shortest] for values in series], axis=0)
            for title, series in columns.items()
        }
        result.curves.append(
            Curve(name, ("Time (ps)", runs.first.time[: runs.shortest]), about, shown)
        )
        return result

    KNOWN[name] = Analysis(name, about, analysis, inf, is_user=True)
    return function


def selected(names: list[str]) -> list[Analysis]:
    """The analyses with these names, or all that need no request. Raises OutputError."""
    names_known = sorted(known(), key=analysis_order)
    for name in names:
        if name not in known():
            hint = did_you_mean(name, names_known) or ";"
            raise OutputError(f"unknown analysis {name!r}{hint} there are {', '.join(names_known)}")
    return [known()[name] for name in names or names_known if names or not known()[name].on_request]


def analysis_order(name: str) -> float:
    return known()[name].position if name in known() else inf


def is_built_in(name: str) -> bool:
    return name in known() and not known()[name].is_user


def run_user_file(path: Path) -> None:
    """Run a Python file that defines analyses, which the user trusts. Raises OutputError."""
    if fault := unreadable_reason(path):
        raise OutputError(f"{path}: {fault}")
    before = dict(known())
    try:
        runpy.run_path(str(path))
    except OutputError as error:
        raise OutputError(f"{path}: {error}") from None
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        raise OutputError(f"{path} raised {type(error).__name__}: {error}") from error
    if not any(entry.is_user and entry is not before.get(name) for name, entry in known().items()):
        raise OutputError(
            f"{path} defines no analysis: put @rigidmd.analysis.register before a function of"
            " frames"
        )


def _series_of(function: UserFunction, name: str, frames: RigidFrames) -> dict[str, np.ndarray]:
    """What a user-defined analysis returns for the frames of a run: a number for each frame (f,) by
    title. Raises OutputError."""
    try:
        returned = function(frames)
    except (Exception, SystemExit) as error:  # a user's function may raise anything
        raise OutputError(f"the analysis {name} raised {type(error).__name__}: {error}") from error
    series = dict(returned) if isinstance(returned, Mapping) else {name: returned}
    if not series:
        raise OutputError(f"the analysis {name} returned an empty dictionary")
    return {
        str(title): _checked_series(name, title, values, len(frames))
        for title, values in series.items()
    }


def _checked_series(name: str, title: object, values: ArrayLike, count: int) -> np.ndarray:
    """What a user-defined analysis returned, as one number for each frame (f,). Raises
    OutputError."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        array = np.array([])
    if array.shape != (count,):
        raise OutputError(
            f"the analysis {name} must return one number for each of the {count} frames, or a"
            f" dictionary of such arrays; {title!r} has the shape {np.shape(values)}"
        )
    if not np.isfinite(array).all():
        frame = np.isfinite(array).argmin() + 1
        raise OutputError(f"the analysis {name}: {title!r} is not a finite number at frame {frame}")
    return array


class SweepAnalysis(NamedTuple):
    """An analysis of all points of a sweep together."""

    name: str
    about: str
    over: str  # what the sweep varies
    title: str  # of its points
    #: Whether a sweep has it without a request. The argument is its manifest
    is_default: Callable[..., bool]
    #: The result of the finished points, and the samples used. The argument is the manifest
    measure: Callable[..., tuple[AnalysisResult, Json]]


def sweep_analyses() -> list[SweepAnalysis]:
    """The analyses of sweeps that features have."""
    return [import_module(name).SWEEP_ANALYSIS for _, name in modules("sweep_analyses")]
