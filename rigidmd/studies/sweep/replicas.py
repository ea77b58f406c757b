"""Analyses of all runs of a sweep: of each run, and of replicas together with errors from their
scatter."""

import csv
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rigidmd.analysis.files import FIGURES, AnalysisOutput, analyse_frames
from rigidmd.analysis.mean_force import NAME as MEAN_FORCE
from rigidmd.analysis.registry import selected
from rigidmd.analysis.result import AnalysisResult
from rigidmd.analysis.rigid_frames import MOST_NUMBERS, RigidFrames, frames_of_folder
from rigidmd.analysis.runs import Runs, as_runs
from rigidmd.core.files import writing
from rigidmd.errors import OutputError, RigidMDError
from rigidmd.io.folder import add_to_folder
from rigidmd.io.write import Column, Table, nine_digits, with_error
from rigidmd.run.record import read_record
from rigidmd.studies.sweep.folder import (
    SEED,
    Manifest,
    combination_folder,
    describe_values,
    read_manifest,
    short_keys,
    state_on_disk,
)
from rigidmd.studies.sweep.table import SweepRow, key_columns, write_analyses_figure
from rigidmd.studies.sweep.windows import is_of_windows, write_mean_force

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

    Results of replicas together are written into the folder of the sweep, or into a folder for each
    combination of the other keys, and all values into analysis.csv. names, start, viscosity,
    progress, figures : see `analyse_folder`
    """
    manifest = read_manifest(folder)
    ready = {
        point.folder for point in manifest.points if state_on_disk(folder, point) == "finished"
    }
    if not ready:
        raise OutputError(
            f"{folder}: no point of this sweep has finished yet; `rigidmd sweep` continues it"
        )
    wants_mean_force = MEAN_FORCE in names or (not names and is_of_windows(manifest))
    if names == [MEAN_FORCE]:
        return [_mean_force(folder, manifest, ready, figures)]
    names = [name for name in names if name != MEAN_FORCE]
    selected(names)
    short, found, seen = short_keys(manifest.keys), [], 0
    for values, points in manifest.combinations():
        finished = [point.folder for point in points if point.folder in ready]
        if not finished:
            continue
        where = combination_folder(folder, values, short)
        title = describe_values(values, short)
        request = _Request(names, start, viscosity, figures)

        def show(part, name, seen=seen):
            return progress((seen + part) / len(ready), name)

        found.append(_combine(folder, where, title, values, finished, request, show))
        seen += len(finished)
    if wants_mean_force:
        found.append(_mean_force(folder, manifest, ready, figures))
    if not any(combination.results for combination in found):
        reasons = dict.fromkeys(
            reason for combination in found for reason in combination.failed.values()
        )
        raise OutputError(f"{folder}: no point can be analysed: {'; '.join(reasons)}")
    _write_table(
        folder, manifest, [combination for combination in found if combination.title != WINDOWS]
    )
    return found


#: Title of the combination of all windows of a restrained distance.
WINDOWS = "all windows"


def _mean_force(folder: Path, manifest: Manifest, ready: set[str], figures: str) -> Combination:
    """The potential of mean force of all windows, as the combination of all points."""
    points = [point for point in manifest.points if point.folder in ready]
    result, files = write_mean_force(folder, manifest, points, figures)
    return Combination(WINDOWS, {}, len(points), [result], {}, files)


class _Request(NamedTuple):
    """See `analyse_folder`."""

    names: list[str]
    start: float | None
    viscosity: float | None
    figures: str


def _combine(
    folder: Path,
    where: Path,
    title: str,
    values: dict[str, Any],
    points: list[str],
    request: _Request,
    progress: Callable[[float, str], object],
) -> Combination:
    """Analyses of each run of a combination, written into its folder; and of all of them together,
    written into the folder `where` if there are several. What fails of one run or of one analysis
    does not end the others."""
    members: list[RigidFrames] = []
    outputs: list[AnalysisOutput] = []
    failed: dict[str, str] = {}
    names, start, viscosity, figures = request

    def show_part(k: int, of: str, part: float, name: str) -> None:
        progress((k + part) / (len(points) + 1), f"{of}{name}")

    for k, point in enumerate(points):
        show = partial(show_part, k, f"{point} ")
        try:
            frames = frames_of_folder(read_record(folder / point), start)
            outputs.append(
                analyse_frames(folder / point, as_runs(frames), names, viscosity, show, figures)
            )
        except RigidMDError as error:
            failed[point] = str(error)
            continue
        members.append(_thinned(frames, MOST_NUMBERS // len(points)))
    if len(members) < 2:
        (done,) = outputs or [AnalysisOutput({}, [], {}, [])]
        return Combination(
            title, values, len(members), done.results, failed | done.failed, done.files
        )
    with writing(where, "made"):
        where.mkdir(exist_ok=True)
    show = partial(show_part, len(points), "all runs: ")
    done = analyse_frames(where, Runs(tuple(members)), names, viscosity, show, figures)
    return Combination(title, values, len(members), done.results, failed | done.failed, done.files)


def _thinned(frames: RigidFrames, most: int) -> RigidFrames:
    """Evenly spaced frames with a largest number of numbers in their arrays."""
    every = -(-frames.size // most)
    return frames if every == 1 else frames[::every].copied()


def _write_table(folder: Path, manifest: Manifest, found: list[Combination]) -> None:
    """analysis.csv: a line for each combination, its values with their errors; analysis.png: values
    against a key."""
    values = {
        combination.title: {
            (result.name, v.header): v for result in combination.results for v in result.values
        }
        for combination in found
    }
    columns = [*key_columns(found[0].values), Column("runs", lambda combination: combination.runs)]
    for title in dict.fromkeys(
        title for of_combination in values.values() for title in of_combination
    ):

        def measured(combination: Combination, title: tuple = title) -> list[float | None] | None:
            value = values[combination.title].get(title)
            return value and [nine_digits(value.value), nine_digits(value.error)]

        columns += with_error(title[1], measured, f"{title[1]} error")
    add_to_folder(folder, [ANALYSES])
    Table(columns, found).write(folder / ANALYSES, csv.QUOTE_NONNUMERIC)
    rows = [
        SweepRow(
            combination.values,
            {
                None: {
                    header: (v.value, v.error)
                    for (_, header), v in of.items()
                    if v.value is not None
                }
            },
        )
        for combination, of in zip(found, values.values(), strict=True)
    ]
    if manifest.keys.keys() - {SEED} and len(rows) > 1:
        write_analyses_figure(folder, manifest, rows)
