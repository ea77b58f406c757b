"""Analyses of the folder of a run, and their files: analysis.json, a CSV file and a figure for each curve."""

import csv
import re
from collections.abc import Callable
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rigidmd.analysis.registry import analysis_order, is_built_in, selected
from rigidmd.analysis.result import AnalysisResult, Curve, Value
from rigidmd.analysis.rigid_frames import RigidFrames
from rigidmd.analysis.source import frames_of_folder
from rigidmd.errors import OutputError
from rigidmd.figures.style import COLORS, FAINT, INK, label_minor_ticks, open_axis, thin_series, write_figure
from rigidmd.io.folder import add_to_folder, written_by_runs
from rigidmd.io.run_files import Bounded, read_columns, read_json
from rigidmd.io.write import nine_digits, write_csv, write_json
from rigidmd.run.record import read_record

ANALYSIS = "analysis.json"
#: What analysis.json has of a curve.
CURVE_KEYS = ("file", "label", "log", "level", "bars")
#: Size of a figure, inches, and most curves in it.
WIDTH, HEIGHT, MOST_CURVES = 5.2, 3.2, 10
#: Headers of columns that are in the file and not drawn.
UNDRAWN = re.compile(r"n .+-.+")


def describe_range(frames: RigidFrames) -> dict[str, Any]:
    """The part of analysis.json on the frames that were used."""
    begin, end = float(frames.time[0]), float(frames.time[-1])
    return {"stage": frames.stage.label, "from_ps": begin, "to_ps": end, "frames": len(frames), "notes": frames.notes}


def write_results(
    folder: Path, frames_used: dict[str, Any], results: list[AnalysisResult], failed: dict[str, str]
) -> list[Path]:
    """Write results; entries of other analyses in the folder stay. Returns the files. Raises OutputError.

    frames_used : see `describe_range`; failed : analysis -> a sentence on why it has failed
    """
    known = read_table(folder)
    owner = {name: analysis for analysis, entry in known.items() for name in entry["files"]}
    marked = written_by_runs(folder)
    new = {}
    for result in results:
        for name in (f"{curve.file}{suffix}" for curve in result.curves for suffix in (".csv", ".png")):
            if new.setdefault(name, result.name) != result.name or owner.get(name, result.name) != result.name:
                other = new[name] if new[name] != result.name else owner[name]
                raise OutputError(f"{folder / name} is a file of the analysis {other}; rename {result.name}")
            known_there = name in owner or (is_built_in(result.name) and name in marked)
            if (folder / name).exists() and not known_there:
                raise OutputError(f"{folder / name} exists and is not of an analysis; rename {result.name}")
    add_to_folder(folder, [ANALYSIS, *new])
    written, pictures = [], {}
    entries = dict(known)
    for result in results:
        files = []
        for curve in result.curves:
            path, picture = folder / f"{curve.file}.csv", folder / f"{curve.file}.png"
            write_csv(path, _rows(curve), csv.QUOTE_NONNUMERIC)
            pictures[picture] = curve
            written += [path, picture]
            files += [path.name, picture.name]
        entries[result.name] = {
            "about": result.about, "values": [value._asdict() for value in result.values], "notes": result.notes,
            "curves": [{key: getattr(curve, key) for key in CURVE_KEYS} for curve in result.curves], "files": files,
            "stretch": frames_used,
        }  # fmt: skip
    for name, reason in failed.items():
        lists = {"values": [], "notes": [reason], "curves": [], "files": []}
        entries[name] = {"about": name, **lists, "stretch": frames_used}
    entries = dict(sorted(entries.items(), key=lambda entry: analysis_order(entry[0])))
    write_json(folder / ANALYSIS, {"analyses": entries}, indent=1, ensure_ascii=False)
    for picture, curve in pictures.items():
        write_figure(picture, partial(curve_figure, curve))
    return [folder / ANALYSIS, *(path for path in written if path.is_file())]


def _rows(curve: Curve) -> list[list[Any]]:
    """Rows of the file of a curve: the axis, the columns, each followed by its error if there is one."""
    columns = {curve.axis[0]: curve.axis[1]}
    for header, values in curve.columns.items():
        columns[header] = values
        if header in curve.errors:
            columns[f"{header} error"] = curve.errors[header]
    lines = zip(*columns.values(), strict=True)
    return [list(columns), *(list(map(nine_digits, line)) for line in lines)]


class _Curve(BaseModel):
    file: str
    label: str
    log: tuple[bool, bool]
    level: Bounded | None
    bars: bool


class _Value(BaseModel):
    name: str
    unit: str
    value: Bounded | None
    error: Bounded | None
    correlation_ps: Bounded | None = None
    note: str = ""


class _FramesUsed(BaseModel):
    model_config = ConfigDict(extra="allow")

    stage: str
    from_ps: Bounded
    to_ps: Bounded
    frames: int
    notes: list[str]


class _Entry(BaseModel):
    about: str
    values: list[_Value]
    notes: list[str]
    curves: list[_Curve]
    files: list[str]
    frames_used: _FramesUsed = Field(alias="stretch")


class _Analyses(BaseModel):
    """analysis.json."""

    analyses: dict[str, _Entry]


def read_table(folder: Path) -> dict[str, Any]:
    """The entries of analysis.json by analysis, if there are any. Raises OutputError."""
    found = read_json(folder / ANALYSIS, _Analyses, "; remove it, and analyse again")
    return {} if found is None else found.model_dump(by_alias=True)["analyses"]


def read_results(folder: Path) -> list[tuple[AnalysisResult, str]]:
    """The results of analyses in the folder of a run, each with a phrase on the frames used. Raises OutputError."""
    found = []
    for name, entry in read_table(folder).items():
        curves = [_read_curve(folder, curve) for curve in entry["curves"]]
        values = [Value(**value) for value in entry["values"]]
        used = entry["stretch"]
        phrase = f"{used['frames']} frames from {used['from_ps']:g} to {used['to_ps']:g} ps"
        found.append((AnalysisResult(name, entry["about"], values, curves, entry["notes"]), phrase))
    return found


def _read_curve(folder: Path, described: dict[str, Any]) -> Curve:
    path = folder / f"{Path(described['file']).name}.csv"
    read = read_columns(path)
    if read is None or not read.cells:
        raise OutputError(f"{path} cannot be read: it has no curve; analyse again")
    head = list(read.cells)
    table = {title: read.numbers(title) for title in head}
    columns = {title: table[title] for title in head[1:] if title.removesuffix(" error") not in set(head) - {title}}
    errors = {title.removesuffix(" error"): table[title] for title in head[1:] if title not in columns}
    return Curve(**described | {"axis": (head[0], table[head[0]]), "columns": columns, "errors": errors})


def curve_figure(curve: Curve):
    """The figure of a curve: each column with a band of one standard error."""
    from rigidmd.figures.picture import Picture

    figure = Picture(figsize=(WIDTH, HEIGHT), layout="constrained")
    axis = figure.subplots()
    header, x = curve.axis
    shown = [title for title in curve.columns if not UNDRAWN.fullmatch(title)][:MOST_CURVES]
    seen = x > 0 if curve.log[0] else np.ones(len(x), bool)
    if curve.level is not None:
        axis.axhline(curve.level, color=FAINT, lw=0.7)
    for color, title in zip(COLORS, shown, strict=False):
        values = curve.columns[title]
        if curve.bars:
            axis.bar(x, values, color=color, width=0.7)
            continue
        axis.plot(*thin_series(x[seen], values[seen]), color=color, lw=1.0, label=title)
        error = curve.errors.get(title)
        if error is not None and np.isfinite(error).all():
            axis.fill_between(x[seen], (values - error)[seen], (values + error)[seen], color=color, alpha=0.25, lw=0)
    for line, is_log, name in ((axis.xaxis, curve.log[0], "x"), (axis.yaxis, curve.log[1], "y")):
        if is_log:
            getattr(axis, f"set_{name}scale")("log")
            label_minor_ticks(line)
    axis.set_xlabel(header.replace("(A)", "(Å)").replace("1/A", "1/Å"), fontsize=9, color=INK)
    axis.set_ylabel(curve.label, fontsize=9, color=INK)
    open_axis(axis, labelsize=8)
    if len(shown) > 1 and not curve.bars:
        figure.legend(
            *axis.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False, fontsize=7,
            handlelength=1.4, labelcolor=INK,
        )  # fmt: skip
    return figure


#: Fraction of the progress for reading frames.
READING = 0.25


class AnalysisRequest(NamedTuple):
    """Names of analyses (all if empty), start (ps) and viscosity (mPa s), or None."""

    names: list[str]
    start: float | None = None
    viscosity: float | None = None


class AnalysisOutput(NamedTuple):
    """failed : analysis -> why it has failed, if it was not requested by name"""

    frames: RigidFrames
    results: list[AnalysisResult]
    failed: dict[str, str]
    files: list[Path]


def analyse_folder(
    folder: Path, request: AnalysisRequest, progress: Callable[[float, str], object] = lambda fraction, name: None
) -> AnalysisOutput:
    """Analyse the run in a folder and write the files into it. Raises OutputError.

    An analysis that is not possible is left out with a sentence, unless it was requested by name.

    progress : called with the fraction done and the name of the present work
    """
    entries = selected(request.names)
    reading = lambda fraction: progress(READING * fraction, "reading frames")  # noqa: E731
    reading(0.0)
    frames = frames_of_folder(read_record(folder), request.start, reading)
    results, failed = [], {}
    for k, entry in enumerate(entries):
        progress(READING + (1 - READING) * k / len(entries), entry.name)
        options = {"viscosity_mPa_s": request.viscosity}
        taken = options.keys() & signature(entry.function).parameters
        try:
            results.append(entry.function(frames, **{option: options[option] for option in taken}))
        except OutputError as error:
            if request.names:
                raise OutputError(f"{folder}: {error}") from None
            failed[entry.name] = str(error)
    if not results:
        raise OutputError(f"{folder}: no analysis is possible: {'; '.join(failed.values())}")
    files = write_results(folder, describe_range(frames), results, failed)
    progress(1.0, "")
    return AnalysisOutput(frames, results, failed, files)
