"""Files of analyses in the folder of a run: analysis.json, a CSV file and a figure for each curve; and reading them."""

import csv
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from rigidmd.analysis.findings import Curve, Finding, Value
from rigidmd.analysis.history import History
from rigidmd.analysis.registry import ORDER, place
from rigidmd.errors import OutputError
from rigidmd.figures.style import COLORS, FAINT, INK, bare_axis, few_decades, thin_series, write_figure
from rigidmd.io.folder import add_to_folder, written_by_runs
from rigidmd.io.run_files import Bounded, read_columns, read_json
from rigidmd.io.write import nine_digits, write_csv, write_json

ANALYSIS = "analysis.json"
#: Inches of a figure, and curves that one holds.
WIDTH, HEIGHT, MOST_CURVES = 5.2, 3.2, 10
#: Headers of columns that are kept in the file and not drawn.
UNDRAWN = re.compile(r"n .+-.+")


def stretch_of(history: History) -> dict[str, Any]:
    """What analysis.json tells of the frames that were used."""
    return {
        "stage": history.stage.label,
        "from_ps": float(history.time[0]),
        "to_ps": float(history.time[-1]),
        "frames": len(history),
        "notes": history.notes,
    }


def write_findings(
    folder: Path, stretch: dict[str, Any], findings: list[Finding], failed: dict[str, str]
) -> list[Path]:
    """Write what was found; entries of other analyses that the folder holds stay. Returns the files.

    stretch : see `stretch_of`. failed : analysis -> the sentence that tells why it found nothing. Raises OutputError.
    """
    known = read_table(folder)
    owner = {name: analysis for analysis, entry in known.items() for name in entry["files"]}
    marked = written_by_runs(folder)
    own = {}
    for finding in findings:
        for name in (f"{curve.file}{ending}" for curve in finding.curves for ending in (".csv", ".png")):
            if own.setdefault(name, finding.name) != finding.name or owner.get(name, finding.name) != finding.name:
                other = own[name] if own[name] != finding.name else owner[name]
                raise OutputError(f"{folder / name} is of the analysis {other}; name {finding.name} otherwise")
            known_there = name in owner or (finding.name in ORDER and name in marked)
            if (folder / name).exists() and not known_there:
                raise OutputError(f"{folder / name} is there and no file of an analysis; name {finding.name} otherwise")
    add_to_folder(folder, [ANALYSIS, *own])
    written, pictures = [], {}
    entries = dict(known)
    for finding in findings:
        files = []
        for curve in finding.curves:
            path, picture = folder / f"{curve.file}.csv", folder / f"{curve.file}.png"
            write_csv(path, _rows(curve), csv.QUOTE_NONNUMERIC)
            pictures[picture] = curve
            written += [path, picture]
            files += [path.name, picture.name]
        entries[finding.name] = {
            "about": finding.about,
            "values": [value._asdict() for value in finding.values],
            "notes": finding.notes,
            "curves": [_described(curve) for curve in finding.curves],
            "files": files,
            "stretch": stretch,
        }
    for name, why in failed.items():
        entries[name] = {"about": name, "values": [], "notes": [why], "curves": [], "files": [], "stretch": stretch}
    entries = dict(sorted(entries.items(), key=lambda entry: place(entry[0])))
    write_json(folder / ANALYSIS, {"analyses": entries}, indent=1, ensure_ascii=False)
    for picture, curve in pictures.items():
        write_figure(picture, partial(drawn, curve))
    return [folder / ANALYSIS, *(path for path in written if path.is_file())]


def _described(curve: Curve) -> dict[str, Any]:
    return {"file": curve.file, "label": curve.label, "log": curve.log, "level": curve.level, "bars": curve.bars}


def _rows(curve: Curve) -> list[list[Any]]:
    """Rows of the curve's file: the axis, each column, and after it its error where it has one."""
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


class _Stretch(BaseModel):
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
    stretch: _Stretch


class _Analyses(BaseModel):
    """analysis.json."""

    analyses: dict[str, _Entry]


def read_table(folder: Path) -> dict[str, Any]:
    """The entries of analysis.json by analysis; empty without one. Raises OutputError."""
    found = read_json(folder / ANALYSIS, _Analyses, "; remove it, and analyse again")
    return {} if found is None else found.model_dump()["analyses"]


def read_findings(folder: Path) -> list[tuple[Finding, str]]:
    """What analyses found in the folder of a run, each with its stretch in words. Raises OutputError."""
    found = []
    for name, entry in read_table(folder).items():
        curves = [_read_curve(folder, told) for told in entry["curves"]]
        values = [Value(**value) for value in entry["values"]]
        stretch = entry["stretch"]
        words = f"{stretch['frames']} frames from {stretch['from_ps']:g} to {stretch['to_ps']:g} ps"
        found.append((Finding(name, entry["about"], values, curves, entry["notes"]), words))
    return found


def _read_curve(folder: Path, told: dict[str, Any]) -> Curve:
    path = folder / f"{Path(told['file']).name}.csv"
    read = read_columns(path)
    if read is None or not read.cells:
        raise OutputError(f"{path} cannot be read: there is no curve in it; analyse again")
    head = list(read.cells)
    table = {title: read.numbers(title) for title in head}
    columns = {title: table[title] for title in head[1:] if title.removesuffix(" error") not in set(head) - {title}}
    errors = {title.removesuffix(" error"): table[title] for title in head[1:] if title not in columns}
    return Curve(**told | {"axis": (head[0], table[head[0]]), "columns": columns, "errors": errors})


def drawn(curve: Curve):
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
            few_decades(line)
    axis.set_xlabel(header.replace("(A)", "(Å)").replace("1/A", "1/Å"), fontsize=9, color=INK)
    axis.set_ylabel(curve.label, fontsize=9, color=INK)
    bare_axis(axis, labelsize=8)
    if len(shown) > 1 and not curve.bars:
        figure.legend(
            *axis.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False, fontsize=7,
            handlelength=1.4, labelcolor=INK,
        )  # fmt: skip
    return figure
