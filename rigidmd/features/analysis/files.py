"""Analyses of the folder of a run, and their files: analysis.json, a CSV file and a figure for each
curve."""

import traceback
from collections.abc import Callable, Mapping
from functools import partial
from inspect import signature
from pathlib import Path
from typing import NamedTuple

from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from rigidmd.core.toml import Json
from rigidmd.errors import OutputError
from rigidmd.features.analysis.curve_figure import curve_figure
from rigidmd.features.analysis.options import check_options
from rigidmd.features.analysis.registry import analysis_order, is_built_in, selected
from rigidmd.features.analysis.report import by_reason, frames_text
from rigidmd.features.analysis.result import AnalysisResult, Curve, Value
from rigidmd.features.analysis.rigid_frames import frames_of_folder
from rigidmd.features.analysis.runs import Runs, as_runs
from rigidmd.features.view.figures.style import write_figure
from rigidmd.io.folder import add_to_folder, written_by_runs
from rigidmd.io.run_files import Bounded, read_columns, read_json
from rigidmd.io.write import nine_digits, write_csv, write_json
from rigidmd.run.record import read_record

ANALYSIS = "analysis.json"
FIGURES = ("png", "svg", "pdf")  # types of files of figures


def write_results(
    folder: Path,
    frames_used: Json,
    results: list[AnalysisResult],
    failed: dict[str, str],
    figures: str = FIGURES[0],
) -> list[Path]:
    """Write results. Entries of other analyses in the folder stay. Returns the files. Raises
    OutputError.

    frames_used : see `AnalysisOutput`; failed : analysis -> a sentence on why it has failed
    figures : type of the figures, one of FIGURES
    """
    known = read_table(folder)
    owner = {name: analysis for analysis, entry in known.items() for name in entry.files}
    marked = written_by_runs(folder)
    new, files = {}, {}
    for result in results:
        names = files[result.name] = [
            f"{curve.file}{end}" for curve in result.curves for end in (".csv", f".{figures}")
        ]
        for name in names:
            if others := {new.setdefault(name, result.name), owner.get(name, result.name)} - {
                result.name
            }:
                raise OutputError(
                    f"{folder / name} is a file of the analysis {others.pop()}. Rename"
                    f" {result.name}"
                )
            is_ours = name in owner or (is_built_in(result.name) and name in marked)
            if (folder / name).exists() and not is_ours:
                raise OutputError(
                    f"{folder / name} exists and is not of an analysis. Rename {result.name}"
                )
    add_to_folder(folder, [ANALYSIS, *new])
    entries = {}
    curves = [curve for result in results for curve in result.curves]
    for name, entry in known.items():
        entries[name] = entry.model_dump() | {"values": [value._asdict() for value in entry.values]}
    for result in [
        *results,
        *(AnalysisResult(name, name, notes=[reason]) for name, reason in failed.items()),
    ]:
        entries[result.name] = {
            "about": result.about,
            "values": [value._asdict() for value in result.values],
            "notes": result.notes,
            "curves": [
                {key: getattr(curve, key) for key in _Curve.model_fields} for curve in result.curves
            ],
            "files": files.get(result.name, []),
            "frames_used": frames_used,
        }
    entries = dict(sorted(entries.items(), key=lambda entry: analysis_order(entry[0])))
    for curve in curves:
        columns = curve.table
        lines = (list(map(nine_digits, line)) for line in zip(*columns.values(), strict=True))
        write_csv(folder / f"{curve.file}.csv", [list(columns), *lines], quote_text=True)
    write_json(folder / ANALYSIS, {"analyses": entries}, indent=1, ensure_ascii=False)
    for about, curve in [(r.title_of(curve), curve) for r in results for curve in r.curves]:
        title = f"{folder.absolute().name}: {about}"
        write_figure(folder / f"{curve.file}.{figures}", partial(curve_figure, curve), title)
        for other in (
            {f"{curve.file}.{kind}" for kind in FIGURES} & owner.keys() & {*marked} - new.keys()
        ):
            (folder / other).unlink(missing_ok=True)  # a figure of the results before
    return [path for name in (ANALYSIS, *new) if (path := folder / name).is_file()]


class _Curve(BaseModel):
    """What analysis.json has of a curve."""

    file: str
    label: str
    log: tuple[bool, bool]
    level: Bounded | None
    bars: bool
    # not in files of rigidmd 0.2
    per_color: int = 1
    power: Bounded | None = None
    from_zero: bool = False


class _FramesUsed(BaseModel):
    model_config = ConfigDict(extra="allow")

    stage: str
    from_ps: Bounded
    to_ps: Bounded
    frames: int
    runs: int = 1
    notes: list[str]


class TableEntry(BaseModel):
    about: str
    values: list[Value]
    notes: list[str]
    curves: list[_Curve]
    files: list[str]
    # `stretch` in files of rigidmd 0.2
    frames_used: _FramesUsed = Field(validation_alias=AliasChoices("frames_used", "stretch"))


class _Analyses(BaseModel):
    """analysis.json."""

    analyses: dict[str, TableEntry]


def read_table(folder: Path) -> dict[str, TableEntry]:
    """The entries of analysis.json by analysis, if there are any. Raises OutputError."""
    analyses = read_json(folder / ANALYSIS, _Analyses, ". Remove it, and analyse again")
    return {} if analyses is None else analyses.analyses


def read_results(folder: Path) -> list[tuple[AnalysisResult, str]]:
    """The results of analyses in the folder of a run, each with a phrase on the frames used. Raises
    OutputError."""
    results = []
    for name, entry in read_table(folder).items():
        curves = []
        used = entry.frames_used
        for described in entry.curves:
            path = folder / f"{Path(described.file).name}.csv"
            read = read_columns(path)
            if read is None or not read.cells:
                raise OutputError(f"{path} cannot be read: it has no curve. Analyse again")
            head, *titles = read.cells
            table = {title: read.numbers(title) for title in read.cells}
            columns = {
                t: table[t] for t in titles if t.removesuffix(" error") not in table.keys() - {t}
            }
            errors = {t.removesuffix(" error"): table[t] for t in titles if t not in columns}
            curves.append(
                Curve(
                    **described.model_dump(),
                    axis=(head, table[head]),
                    columns=columns,
                    errors=errors,
                )
            )
        phrase = frames_text(used.frames, used.from_ps, used.to_ps)
        results.append(
            (AnalysisResult(name, entry.about, entry.values, curves, entry.notes), phrase)
        )
    return results


READING = 0.25  # fraction of the progress for reading frames


class AnalysisOutput(NamedTuple):
    """failed : analysis -> why it has failed; frames_used : for analysis.json"""

    frames_used: Json  # stage, times (ps) from which and to which, number, notes
    results: list[AnalysisResult]
    failed: dict[str, str]
    files: list[Path]


def analyse_folder(
    folder: Path,
    names: list[str],
    start: float | None = None,
    viscosity: float | None = None,
    progress: Callable[[float, str], object] = lambda fraction, name: None,
    figures: str = FIGURES[0],
    options: Mapping[str, object] | None = None,
) -> AnalysisOutput:
    """Analyse the run in a folder and write the files into it.

    An analysis that is not possible is omitted with a sentence. Raises OutputError if none is
    possible.

    names : of analyses, all if empty; start : of the frames, ps; viscosity : mPa s
    progress : called with the fraction done and the name of the current work
    figures : type of the figures, one of FIGURES
    options : other arguments of analyses; each gets those that it takes
    """
    entries = selected(names)
    check_options([entry.function for entry in entries], options or {})  # before frames are read

    def reading(fraction):
        return progress(READING * fraction, "reading frames")

    reading(0.0)
    frames = frames_of_folder(read_record(folder), start, reading)

    def rest(fraction, name):
        return progress(READING + (1 - READING) * fraction, name)

    done = analyse_frames(folder, as_runs(frames), names, viscosity, rest, figures, options)
    if not done.results:
        raise OutputError(f"{folder}: {no_result_reason(done.failed)}")
    return done


def analyse_frames(
    folder: Path,
    runs: Runs,
    names: list[str],
    viscosity: float | None,
    progress: Callable[[float, str], object],
    figures: str,
    options: Mapping[str, object] | None = None,
) -> AnalysisOutput:
    """Analyse frames, and write the files into a folder if there are results. See
    `analyse_folder`."""
    results, failed = run_analyses(runs, names, viscosity, progress, options)
    used = {
        "stage": runs.first.stage.label,
        "from_ps": min(run.ends[0] for run in runs.members),
        "to_ps": max(run.ends[1] for run in runs.members),
        "frames": runs.frame_count,
        "runs": len(runs.members),
        "notes": runs.first.notes,
    }
    if runs.are_several:
        used["notes"] = [
            f"averages over {len(runs.members)} runs together, errors from their scatter"
        ]
    files = write_results(folder, used, results, failed, figures) if results else []
    progress(1.0, "")
    return AnalysisOutput(used, results, failed, files)


def run_analyses(
    runs: Runs,
    names: list[str],
    viscosity: float | None = None,
    progress: Callable[[float, str], object] = lambda fraction, name: None,
    options: Mapping[str, object] | None = None,
) -> tuple[list[AnalysisResult], dict[str, str]]:
    """The results of analyses, and a sentence on each that has failed: analysis -> why. No analysis
    ends the others."""
    entries = selected(names)
    given = {"viscosity_mPa_s": viscosity} | dict(options or {})
    results = []
    failed = {}
    for k, entry in enumerate(entries):
        progress(k / len(entries), entry.name)
        taken = given.keys() & signature(entry.function).parameters.keys()
        try:
            results.append(entry.function(runs, **{key: given[key] for key in taken}))
        except OutputError as error:
            failed[entry.name] = str(error)
        except (
            Exception
        ) as error:  # an error of rigidmd, which should not cost the results of other analyses
            failed[entry.name] = _unexpected(error)
    return results, failed


def no_result_reason(failed: dict[str, str]) -> str:
    """Why no analysis has a result."""
    if len(failed) == 1:
        return next(iter(failed.values()))
    return f"no analysis is possible: {'; '.join(by_reason(failed))}"


def _unexpected(error: Exception) -> str:
    """An exception with its type and the line that raised it."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"an error of rigidmd, please report it: {type(error).__name__}: {error}"
        f" ({Path(at.filename).name}:{at.lineno})"
    )
