"""Analyses of runs of molecules, as functions of results: `rigidmd.analysis.rdf(results, "OW",
"OW")`.

There is a function for each analysis of `rigidmd analyse --list`, and for each one added by
`register`. It returns an `AnalysisResult`: values with errors, and curves. A list of results, of
replicas, is analysed together. `start` (ps) is the first time used, by default the detected end of
the equilibration. Other arguments are described by help() of the function. They raise OutputError.
"""

from collections.abc import Callable, Sequence
from functools import cache
from inspect import Parameter, getdoc, signature
from pathlib import Path

from rigidmd.features.analysis import registry
from rigidmd.features.analysis.registry import Analysis, register, selected
from rigidmd.features.analysis.result import AnalysisResult
from rigidmd.features.analysis.rigid_frames import frames_of_results
from rigidmd.features.analysis.runs import Runs
from rigidmd.run.results import Results

__all__ = ["analyse", "register", *registry.known()]  # pyright: ignore[reportUnsupportedDunderAll]


def analyse(
    results: Results, name: str, /, start: float | None = None, **options: object
) -> AnalysisResult:
    """The result of an analysis by its name, built-in or added by `register`.

    Parameters
    ----------
    results : Results or sequence of Results
        Results of a run, or of replicas, which are analysed together
    name : str
        Name of the analysis
    start : float, optional
        First time that is used, ps. Default: the detected end of the equilibration
    **options : object
        The other arguments of the function of this name

    Returns
    -------
    AnalysisResult
        Values with errors, curves and notes

    Raises
    ------
    OutputError
        For an unknown name, or as the function of this name.
    """
    (entry,) = selected([name])
    return _function_of_results(entry)(results, start=start, **options)


def __getattr__(name: str) -> Callable[..., AnalysisResult]:
    if name not in registry.known():
        raise AttributeError(f"module 'rigidmd.analysis' has no attribute {name!r}")
    return _function_of_results(registry.known()[name])


def __dir__() -> list[str]:
    return sorted({*__all__, *registry.known()})


def _check_results(results: object, name: str) -> None:
    """Raise TypeError for anything but the results of a run, or a list of them."""
    each = results if isinstance(results, list | tuple) else [results]
    if each and all(isinstance(one, Results) for one in each):
        return
    of = f"rigidmd.analysis.{name}"
    if isinstance(results, str | Path):
        raise TypeError(
            f"{of} takes the results of a run, not its path:"
            f" {of}(rigidmd.read_run({str(results)!r}))"
        )
    raise TypeError(
        f"{of} takes the results of a run, or a list of them, not {results!r:.80}; of a sweep give"
        " a list of rigidmd.read_run(path) for the paths in table.runs.values()"
    )


@cache
def _function_of_results(entry: Analysis) -> Callable[..., AnalysisResult]:
    """The function of frames as one of results, with its other parameters and its docstring."""

    def function(
        results: Results | Sequence[Results],
        *arguments: object,
        start: float | None = None,
        **options: object,
    ) -> AnalysisResult:
        _check_results(results, entry.name)
        each = [results] if isinstance(results, Results) else results
        for one in each:
            if start not in one._analysis_frames:
                one._analysis_frames[start] = frames_of_results(one, start)
        return entry.function(
            Runs(tuple(one._analysis_frames[start] for one in each)), *arguments, **options
        )

    ours = signature(function)
    _, *function_parameters = signature(entry.function).parameters.values()
    parameters = [ours.parameters["results"], *function_parameters, ours.parameters["start"]]
    parameters.sort(key=lambda parameter: parameter.kind is Parameter.KEYWORD_ONLY)
    function.__signature__ = ours.replace(parameters=parameters)  # pyright: ignore[reportFunctionMemberAccess]
    function.__name__ = function.__qualname__ = entry.name
    function.__doc__ = _with_common_entries(getdoc(entry.function) or entry.about)
    return function


PARAMETERS = "Parameters\n----------\n"
RESULTS = """\
results : Results or sequence of Results
    Results of a run, or of replicas, which are analysed together
"""
START = """\
start : float, optional
    First time that is used, ps. Default: the detected end of the equilibration

Returns
-------
AnalysisResult
    Values with errors, curves and notes

Raises
------
OutputError
    If the run lacks what the analysis needs.
"""


def _with_common_entries(doc: str) -> str:
    """The docstring of an analysis, whose last section is that of its options, with the entries
    that all have."""
    text, _, options = doc.partition(PARAMETERS)
    options = f"{options.rstrip()}\n" if options else ""
    return f"{text.rstrip()}\n\n{PARAMETERS}{RESULTS}{options}{START}"
