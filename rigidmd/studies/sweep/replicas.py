"""Analyses of all runs of a sweep: of each run, then means over replicas with errors from their scatter."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.analysis.files import FIGURES, AnalysisOutput, analyse_folder, write_results
from rigidmd.analysis.result import AnalysisResult, Curve, Value
from rigidmd.core.files import writing
from rigidmd.core.statistics import standard_error
from rigidmd.errors import OutputError
from rigidmd.io.folder import add_to_folder
from rigidmd.io.write import Column, Table, nine_digits, with_error
from rigidmd.studies.sweep.folder import describe_values, point_name, read_manifest, short_keys, state_on_disk
from rigidmd.studies.sweep.table import key_columns

ANALYSES = "analysis.csv"


class Combination(NamedTuple):
    """Results for one combination of values of the keys without the seed.

    title : describes the values; failed : point or analysis -> why it has no result
    """

    title: str
    values: dict[str, Any]
    runs: int
    results: list[AnalysisResult]
    failed: dict[str, str]
    files: list[Path]


def analyse_sweep(
    folder: Path,
    names: list[str],
    start: float | None,
    viscosity: float | None,
    progress: Callable[..., object],
    figures: str = FIGURES[0],
) -> list[Combination]:
    """Analyse all finished runs of a sweep. Raises OutputError.

    Means over replicas are written into the folder of the sweep, or into a folder for each combination of the other
    keys, and all values into analysis.csv. names, start, viscosity, progress, figures : see `analyse_folder`
    """
    manifest = read_manifest(folder)
    ready = [point for point in manifest.points if state_on_disk(folder, point) == "finished"]
    if not ready:
        raise OutputError(f"{folder}: no point of this sweep has finished yet; `rigidmd sweep` continues it")
    done: dict[str, AnalysisOutput] = {}
    failed: dict[str, str] = {}
    for k, point in enumerate(ready):
        try:
            done[point.folder] = analyse_folder(
                folder / point.folder,
                names,
                start,
                viscosity,
                lambda part, name, k=k, point=point: progress((k + part) / len(ready), f"{point.folder} {name}"),
                figures,
            )
        except OutputError as error:
            if len(ready) == 1:
                raise
            failed[point.folder] = str(error)
    if not done:
        raise OutputError(f"{folder}: no point can be analysed: {next(iter(failed.values()))}")
    found, short = [], short_keys(manifest.keys)
    for values, points in manifest.combinations():
        runs = [done[point.folder] for point in points if point.folder in done]
        missed = {point.folder: failed[point.folder] for point in points if point.folder in failed}
        if runs:
            where = folder / point_name(values, short) if values else folder
            title = describe_values(values, short)
            found.append(_combine(where, title, values, runs, missed, figures))
    _write_table(folder, found)
    return found


def _combine(
    where: Path,
    title: str,
    values: dict[str, Any],
    runs: list[AnalysisOutput],
    missed: dict[str, str],
    figures: str,
) -> Combination:
    """Means over the runs of a combination; they are written into a folder if there are several."""
    results = over_replicas([run.results for run in runs])
    names = {result.name for result in results}
    why = {name: reason for run in runs for name, reason in run.failed.items() if name not in names}
    if len(runs) < 2:
        return Combination(title, values, 1, results, missed | why, runs[0].files)
    with writing(where, "made"):
        where.mkdir(exist_ok=True)
    frames_used = runs[0].frames_used | {
        "from_ps": min(run.frames_used["from_ps"] for run in runs),
        "to_ps": max(run.frames_used["to_ps"] for run in runs),
        "frames": sum(run.frames_used["frames"] for run in runs),
        "notes": [f"means over {len(runs)} runs, errors from their scatter"],
    }
    files = write_results(where, frames_used, results, why, figures)
    return Combination(title, values, len(runs), results, missed | why, files)


def over_replicas(runs: list[list[AnalysisResult]]) -> list[AnalysisResult]:
    """Means of the results of several runs, with their standard errors; a result of only one run keeps its error."""
    found: dict[str, list[AnalysisResult]] = {}
    for results in runs:
        for result in results:
            found.setdefault(result.name, []).append(result)
    return [_mean_of(results, len(runs)) for results in found.values()]


def _mean_of(results: list[AnalysisResult], runs: int) -> AnalysisResult:
    if len(results) == 1:
        return results[0]
    names = dict.fromkeys(value.name for result in results for value in result.values)
    values = [_mean_value([v for f in results for v in f.values if v.name == name], runs) for name in names]
    notes, curves = list(dict.fromkeys(note for result in results for note in result.notes)), []
    by_file: dict[str, list[Curve]] = {}
    for curve in (curve for result in results for curve in result.curves):
        by_file.setdefault(curve.file, []).append(curve)
    for of_file in by_file.values():
        if (mean := _mean_curve(of_file)) is not None:
            curves.append(mean)
        else:
            notes.append(f"{of_file[0].label}: no mean, because the runs have no common range")
    return AnalysisResult(results[0].name, results[0].about, values, curves, notes)


def _mean_value(values: list[Value], runs: int) -> Value:
    there = [value.value for value in values if value.value is not None]
    if len(there) < 2:
        only = next((value for value in values if value.value is not None), values[0])
        return only._replace(note=f"of one of {runs} runs") if there else only
    note = f"over {len(there)} runs" + (f" of {runs}; the others have none" if len(there) < runs else "")
    mean, error = float(np.mean(there)), float(standard_error(there))
    return Value(values[0].name, values[0].unit, mean, error, None, note)


def _mean_curve(curves: list[Curve]) -> Curve | None:
    """The mean of curves in their common range, interpolated to the axis of the first. None without such a range."""
    first = curves[0]
    if len(curves) == 1:
        return first
    header, axis = first.axis
    if all(len(curve.axis[1]) == len(axis) and np.allclose(curve.axis[1], axis, rtol=1e-9) for curve in curves):
        kept, sampled = axis, [curve.columns for curve in curves]
    else:
        low, high = max(curve.axis[1].min() for curve in curves), min(curve.axis[1].max() for curve in curves)
        kept = axis[(axis >= low) & (axis <= high)]
        if len(kept) < 2:
            return None
        sampled = [{t: np.interp(kept, c.axis[1], values) for t, values in c.columns.items()} for c in curves]
    titles = [title for title in first.columns if all(title in one for one in sampled)]
    columns = {title: np.mean([one[title] for one in sampled], axis=0) for title in titles}
    errors = {title: standard_error([one[title] for one in sampled]) for title in titles}
    return Curve(first.file, (header, kept), first.label, columns, errors, first.log, first.level, first.bars)


def _write_table(folder: Path, found: list[Combination]) -> None:
    """analysis.csv: a line for each combination, its values with their errors."""
    values = {
        combination.title: {(result.name, v.header): v for result in combination.results for v in result.values}
        for combination in found
    }
    columns = [*key_columns(found[0].values), Column("runs", lambda combination: combination.runs)]
    for title in dict.fromkeys(title for of_combination in values.values() for title in of_combination):

        def measured(combination: Combination, title: tuple = title) -> list[float | None] | None:
            value = values[combination.title].get(title)
            return value and [nine_digits(value.value), nine_digits(value.error)]

        columns += with_error(title[1], measured, f"{title[1]} error")
    add_to_folder(folder, [ANALYSES])
    Table(columns, found).write(folder / ANALYSES, csv.QUOTE_NONNUMERIC)
