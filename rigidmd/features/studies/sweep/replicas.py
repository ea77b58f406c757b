"""Analyses of all runs of a sweep: of each run, and of replicas together with errors from their
scatter."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rigidmd.core.files import writing
from rigidmd.errors import OutputError, RigidMDError
from rigidmd.features.analysis.files import (
    FIGURES,
    AnalysisOutput,
    analyse_frames,
    write_results,
)
from rigidmd.features.analysis.options import check_options
from rigidmd.features.analysis.registry import selected, sweep_analyses
from rigidmd.features.analysis.result import AnalysisResult
from rigidmd.features.analysis.rigid_frames import MOST_NUMBERS, RigidFrames, frames_of_folder
from rigidmd.features.analysis.runs import Runs, as_runs
from rigidmd.features.studies.sweep.figure import write_analyses_figure
from rigidmd.features.studies.sweep.folder import (
    Manifest,
    describe_values,
    point_name,
    read_manifest,
    short_keys,
)
from rigidmd.features.studies.sweep.table import SweepRow, Table, measured_values, report_of
from rigidmd.io.folder import add_to_folder
from rigidmd.run.record import read_record

ANALYSES = "analysis.csv"

Progress = Callable[[float, str], object]
Analyse = Callable[..., AnalysisOutput]


class Combination(NamedTuple):
    """Results for one combination of values of the keys without the seed.

    title : describes the values; failed : point or analysis -> why it has no result
    """

    title: str
    runs: int
    results: list[AnalysisResult]
    failed: dict[str, str]
    files: list[Path]


def analyse_sweep(
    folder: Path,
    names: list[str],
    start: float | None,
    viscosity: float | None,
    progress: Progress,
    figures: str = FIGURES[0],
    options: Mapping[str, object] | None = None,
) -> list[Combination]:
    """Analyse all finished runs of a sweep. Raises OutputError.

    Results of replicas together are written into the folder of the sweep, or into a folder for each
    combination of the other keys, and all values into analysis.csv. names, start, viscosity,
    progress, figures, options : see `analyse_folder`
    """
    manifest = read_manifest(folder)
    finished = manifest.points_in("finished")
    if not finished:
        raise OutputError(
            f"{folder}: no point of this sweep has finished yet. `rigidmd sweep` continues it"
        )
    combinations = []
    of_sweeps = sweep_analyses()
    others = [name for name in names if name not in {analysis.name for analysis in of_sweeps}]
    if others or not names:
        check_options([entry.function for entry in selected(others)], options or {})
        analyse = partial(
            analyse_frames, names=others, viscosity=viscosity, figures=figures, options=options
        )
        combinations = _analyse_combinations(manifest, start, analyse, progress)
    for analysis in of_sweeps:
        name, title = analysis.name, analysis.title
        if name not in names and (names or not analysis.is_default(manifest)):
            continue
        try:
            result, used = analysis.measure(manifest)
            files = write_results(folder, used, [result], {}, figures)
            combinations.append(Combination(title, len(finished), [result], {}, files))
        except OutputError as error:
            if name in names:
                raise
            combinations.append(Combination(title, len(finished), [], {name: str(error)}, []))
    if not any(combination.results for combination in combinations):
        reasons = [reason for each in combinations for reason in each.failed.values()]
        raise OutputError(
            f"{folder}: no point can be analysed: {'; '.join(dict.fromkeys(reasons))}"
        )
    return combinations


def _analyse_combinations(
    manifest: Manifest, start: float | None, analyse: Analyse, progress: Progress
) -> list[Combination]:
    """Analyse the replicas of each combination, and write the table of all."""
    short = short_keys(manifest.keys)
    combinations = []
    table = Table(manifest.folder, [], [], [], together=manifest.keys)
    begun = 0
    count = len(manifest.points)
    for values, points in manifest.combinations():
        folders = [manifest.folder / point.folder for point in points if point.state == "finished"]
        if not folders:
            continue
        together = manifest.folder / point_name(values, short)

        def show(part: float, name: str, begun: int = begun) -> None:
            progress((begun + part) / count, name)

        runs, output = _analyse_replicas(folders, together, start, analyse, show)
        combinations.append(Combination(describe_values(values, short), runs, *output[1:]))
        measured = measured_values(output.results)
        table.rows.append(SweepRow(values, {None: measured}, runs))
        table.columns += [header for header in measured if header not in table.columns]
        begun += len(points)
    table.keys[:] = table.rows[0].values
    if table.columns:
        add_to_folder(manifest.folder, [ANALYSES])
        report_of(table.lines()).write(manifest.folder / ANALYSES, quote_text=True)
    if table.keys and len(table) > 1:
        write_analyses_figure(table, manifest.name)
    return combinations


def _analyse_replicas(
    folders: list[Path], together: Path, start: float | None, analyse: Analyse, progress: Progress
) -> tuple[int, AnalysisOutput]:
    """Analyses of each run in a combination, written into the folder of the run, and of all these
    runs together, written into another folder if there are several. What fails of one run or of one
    analysis does not end the others. Returns the number of runs too."""
    members: list[RigidFrames] = []
    failed: dict[str, str] = {}
    output = AnalysisOutput({}, [], {}, [])

    def show(part: float, of: str, k: int, label: str) -> None:
        progress(k + part, f"{label} {of}")

    for k, folder in enumerate(folders):
        try:
            frames = frames_of_folder(read_record(folder), start)
            shown = partial(show, k=k, label=folder.name)
            output = analyse(folder, as_runs(frames), progress=shown)
        except RigidMDError as error:
            failed[folder.name] = str(error)
            continue
        every = -(-frames.size * len(folders) // MOST_NUMBERS)
        members.append(frames if every == 1 else frames[::every].copied())
    if len(members) > 1:
        with writing(together, "made"):
            together.mkdir(exist_ok=True)
        shown = partial(show, k=len(folders) - 1, label="all runs:")
        output = analyse(together, Runs(tuple(members)), progress=shown)
    return len(members), output._replace(failed=failed | output.failed)
