"""Analyses of all runs of a sweep: each run by itself, then means over replicas with the errors that these show."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.analysis.files import stretch_of, write_findings
from rigidmd.analysis.findings import Curve, Finding, Value
from rigidmd.analysis.folder import Task, analyse_folder
from rigidmd.core.statistics import standard_error
from rigidmd.errors import OutputError
from rigidmd.io.folder import add_to_folder
from rigidmd.io.write import nine_digits, write_csv, writing
from rigidmd.studies.sweep.folder import FINISHED, Manifest, Point, read_manifest, state_on_disk
from rigidmd.studies.sweep.names import in_words, short_keys

ANALYSES = "analysis.csv"


class Run(NamedTuple):
    """What one run gave; its frames are let go. stretch : see `stretch_of`"""

    findings: list[Finding]
    failed: dict[str, str]
    stretch: dict[str, Any]
    files: list[Path]


class Combination(NamedTuple):
    """What was found for one combination of values of the keys but the seed.

    title : the values in words; failed : point or analysis -> why it gave nothing
    """

    title: str
    values: dict[str, Any]
    runs: int
    findings: list[Finding]
    failed: dict[str, str]
    files: list[Path]


def analyse_sweep(
    folder: Path, task: Task, step: Callable[[float, str], object] = lambda share, name: None
) -> list[Combination]:
    """Analyse all finished runs of a sweep, and write means over replicas into its folder, or into one for each
    combination of the other keys. The values of all stand in analysis.csv. Raises OutputError.

    step : called with the share that is done and what is being done
    """
    manifest = read_manifest(folder)
    ready = [point for point in manifest.points if state_on_disk(folder, point) == FINISHED]
    if not ready:
        raise OutputError(f"{folder}: no point of this sweep has finished yet; `rigidmd sweep` goes on with it")
    done: dict[str, Run] = {}
    failed: dict[str, str] = {}
    for k, point in enumerate(ready):

        def share(part: float, name: str, k: int = k, point: Point = point) -> None:
            step((k + part) / len(ready), f"{point.folder} {name}")

        try:
            one = analyse_folder(folder / point.folder, task, share)
            done[point.folder] = Run(one.findings, one.failed, stretch_of(one.history), one.files)
        except OutputError as error:
            if len(ready) == 1:
                raise
            failed[point.folder] = str(error)
    if not done:
        raise OutputError(f"{folder}: no point can be analysed: {next(iter(failed.values()))}")
    found = [_combined(folder, manifest, values, points, done, failed) for values, points in manifest.combinations()]
    found = [combination for combination in found if combination.runs]
    _write_table(folder, manifest, found)
    return found


def _combined(
    folder: Path,
    manifest: Manifest,
    values: dict[str, Any],
    points: list[Point],
    done: dict[str, Run],
    failed: dict[str, str],
) -> Combination:
    """Means over the points of a combination, written where there are several."""
    title = in_words(values, short_keys(manifest.keys))
    own = [done[point.folder] for point in points if point.folder in done]
    missed = {point.folder: failed[point.folder] for point in points if point.folder in failed}
    if not own:
        return Combination(title, values, 0, [], missed, [])
    findings = over_replicas([one.findings for one in own])
    names = {finding.name for finding in findings}
    why = {name: reason for one in own for name, reason in one.failed.items() if name not in names}
    if len(own) < 2:
        return Combination(title, values, 1, findings, missed | why, own[0].files)
    where = folder / manifest.folder_of(values) if values else folder
    with writing(where, "made"):
        where.mkdir(exist_ok=True)
    stretch = {
        "stage": own[0].stretch["stage"],
        "from_ps": min(one.stretch["from_ps"] for one in own),
        "to_ps": max(one.stretch["to_ps"] for one in own),
        "frames": sum(one.stretch["frames"] for one in own),
        "notes": [f"means over {len(own)} runs, errors from their scatter"],
    }
    return Combination(title, values, len(own), findings, missed | why, write_findings(where, stretch, findings, why))


def over_replicas(runs: list[list[Finding]]) -> list[Finding]:
    """Findings of several runs as their means, with the standard errors of these. What a single run alone has found
    keeps its own error."""
    found: dict[str, list[Finding]] = {}
    for findings in runs:
        for finding in findings:
            found.setdefault(finding.name, []).append(finding)
    return [_mean_of(findings, len(runs)) for findings in found.values()]


def _mean_of(findings: list[Finding], runs: int) -> Finding:
    """One analysis of several runs."""
    first = findings[0]
    if len(findings) == 1:
        return first
    names = dict.fromkeys(value.name for finding in findings for value in finding.values)
    values = [_mean_value([v for f in findings for v in f.values if v.name == name], runs) for name in names]
    files = dict.fromkeys(curve.file for finding in findings for curve in finding.curves)
    notes, curves = list(dict.fromkeys(note for finding in findings for note in finding.notes)), []
    for file in files:
        own = [curve for finding in findings for curve in finding.curves if curve.file == file]
        curve = _mean_curve(own)
        if curve is None:
            notes.append(f"{own[0].label}: the runs have no common range, and there is no mean")
        else:
            curves.append(curve)
    return Finding(first.name, first.about, values, curves, notes)


def _mean_value(values: list[Value], runs: int) -> Value:
    """The mean of a value over those runs that have it."""
    there = [value.value for value in values if value.value is not None]
    if len(there) < 2:
        own = next((value for value in values if value.value is not None), values[0])
        return own._replace(note=f"of one of {runs} runs") if there else own
    told = f"over {len(there)} runs" + (f" of {runs}; the others gave none" if len(there) < runs else "")
    return Value(values[0].name, values[0].unit, *mean_and_error(np.array(there)), None, told)  # pyright: ignore[reportCallIssue, reportArgumentType]


def mean_and_error(values: np.ndarray) -> tuple[Any, Any]:
    """Means over replicas (n, ...), and their standard errors."""
    return values.mean(axis=0), standard_error(values)


def _mean_curve(curves: list[Curve]) -> Curve | None:
    """The mean of a curve: on the axis of the first, as far as all reach, the others interpolated where theirs differs.

    None if they have no range in common.
    """
    first = curves[0]
    if len(curves) == 1:
        return first
    header, axis = first.axis
    same = all(len(curve.axis[1]) == len(axis) and np.allclose(curve.axis[1], axis, rtol=1e-9) for curve in curves)
    if same:
        kept, sampled = axis, [curve.columns for curve in curves]
    else:
        low, high = max(curve.axis[1].min() for curve in curves), min(curve.axis[1].max() for curve in curves)
        kept = axis[(axis >= low) & (axis <= high)]
        if len(kept) < 2:
            return None
        sampled = [
            {title: np.interp(kept, curve.axis[1], values) for title, values in curve.columns.items()}
            for curve in curves
        ]
    columns, errors = {}, {}
    for title in first.columns:
        if all(title in one for one in sampled):
            columns[title], errors[title] = mean_and_error(np.array([one[title] for one in sampled]))
    return Curve(first.file, (header, kept), first.label, columns, errors, first.log, first.level, first.bars)


def _write_table(folder: Path, manifest: Manifest, found: list[Combination]) -> None:
    """analysis.csv: a line for each combination, its values with their errors."""
    titles = dict.fromkeys(
        (finding.name, value.name, value.unit)
        for combination in found
        for finding in combination.findings
        for value in finding.values
    )
    keys = list(found[0].values)
    head: list[Any] = [*keys, "runs"]
    for _, name, unit in titles:
        header = f"{name} ({unit})" if unit not in ("", "1") else name
        head += [header, f"{header} error"]
    lines = [head]
    for combination in found:
        measured = {
            (finding.name, value.name, value.unit): value
            for finding in combination.findings
            for value in finding.values
        }
        line: list[Any] = [_cell(combination.values[key]) for key in keys] + [combination.runs]
        for title in titles:
            value = measured.get(title)
            line += [None, None] if value is None else [nine_digits(value.value), nine_digits(value.error)]
        lines.append(line)
    add_to_folder(folder, [ANALYSES])
    write_csv(folder / ANALYSES, lines, csv.QUOTE_NONNUMERIC)


def _cell(value: Any) -> Any:
    return value if isinstance(value, int | float | str) and not isinstance(value, bool) else str(value)
