"""The results of analyses as text for a terminal: values first, then what has none, and why."""

from collections.abc import Mapping, Sequence

from rigidmd.core.statistics import format_with_error
from rigidmd.features.analysis.result import AnalysisResult, Value
from rigidmd.io.write import columns_text
from rigidmd.scene.validation import not_none

DETAILS = "mean total dipole"  # begin of the names of values that are printed on request
MOST_UNCERTAIN = 0.5  # the largest error of a value that is known, relative to it
TIME = "correlation time (ps)"
HEADERS = ("quantity", "value", "unit", TIME)
#: Values of g(r) by the end of their names -> headers. A pair of sites has one row.
PEAK = {
    "first peak": "first peak (Å)",
    "height of that peak": "height",
    "neighbours up to the first minimum": "neighbours",
}


def frames_text(count: int, begin: float, end: float) -> str:
    """What results are from, of times in ps."""
    what = f"{count} frames" if count else "samples of the log, without frames,"
    return f"{what} from {begin:g} to {end:g} ps"


def results_text(
    results: Sequence[AnalysisResult], failed: Mapping[str, str], *, verbose: bool = False
) -> list[str]:
    """Lines with a table of all values, the values that a run is too short for, and the analyses
    that were not possible.

    failed : analysis -> a sentence on why; verbose : with components that are zero on average
    """
    values = [
        value
        for result in results
        for value in result.values
        if verbose or not value.name.startswith(DETAILS)
    ]
    known = [value for value in values if is_known(value)]
    missing = {
        value.name: value.note if value.value is None else uncertain(value)
        for value in values
        if value not in known
    }
    lines = []
    pairs = _pairs(known)
    if others := [value for value in known if _pair(value) is None]:
        table = columns_text([HEADERS, *map(row, others)], left=(0, 1, 2))
        lines = ["", *_indented(table.splitlines())]
    if pairs:
        table = columns_text([("g(r)", *PEAK.values(), TIME), *pairs], left=range(4))
        lines += ["", *_indented(table.splitlines())]
    lines += _section("Notes:", {value.name: value.note for value in known if value.note})
    lines += _section("No value yet:", missing)
    lines += _section("Not possible:", failed)
    return lines


def is_known(value: Value) -> bool:
    """Whether a value has an error of at most half of it, or none."""
    if value.value is None:
        return False
    return value.error is None or value.error <= MOST_UNCERTAIN * abs(value.value)


def uncertain(value: Value) -> str:
    """Why a value with an error is not known."""
    _, number, unit, _ = row(value)
    return f"{number} {unit}".rstrip() + " is too uncertain"


def row(value: Value) -> tuple[str, str, str, str]:
    """Name, number, unit and correlation time of a value that is known."""
    unit = "" if value.unit == "1" else value.unit
    time = "" if value.correlation_ps is None else f"{value.correlation_ps:.3g}"
    number = format_with_error(not_none(value.value), value.error)
    return value.name, number, unit, time


def _pair(value: Value) -> str | None:
    """The pair of sites of a value of g(r)."""
    begin, _, title = value.name.partition(": ")
    return begin.removeprefix("g ") if title in PEAK else None


def _pairs(known: Sequence[Value]) -> list[list[str]]:
    """Rows of g(r): pair, position and height of the first peak, neighbours, correlation time."""
    cells: dict[str, dict[str, str]] = {}
    for value in known:
        if pair := _pair(value):
            _, number, _, time = row(value)
            title = value.name.partition(": ")[2]
            cells.setdefault(pair, {TIME: time})[title] = number
    return [[pair, *(of.get(title, "-") for title in (*PEAK, TIME))] for pair, of in cells.items()]


def _section(title: str, reasons: Mapping[str, str]) -> list[str]:
    """A title and a line for each reason."""
    return ["", title, *_indented(by_reason(reasons))] if reasons else []


def by_reason(reasons: Mapping[str, str]) -> list[str]:
    """A line for each reason with its names, which it does not repeat."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason.removeprefix(f"{name} "), []).append(name)
    return [f"{', '.join(each)}: {reason}" for reason, each in names.items()]


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"  {line}" for line in lines]
