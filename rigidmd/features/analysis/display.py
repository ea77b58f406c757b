"""Results of analyses in a notebook and on the page of a run."""

import html
from collections.abc import Iterator

from rigidmd.core.display import html as html_of
from rigidmd.core.statistics import format_with_error
from rigidmd.features.analysis.curve_figure import curve_figure
from rigidmd.features.analysis.files import read_results
from rigidmd.features.analysis.report import HEADERS, row
from rigidmd.features.analysis.result import AnalysisResult, Value
from rigidmd.features.view.notebook import drawing_of, framed, sides
from rigidmd.features.view.page import figure, items, notes, table
from rigidmd.run.record import Record


@html_of.register
def analysis_html(result: AnalysisResult) -> str:
    rows = [(value.name, _measured(value), value.note) for value in result.values]
    right = drawing_of(
        result.plot() if result.curves else None, f"analysis-{result.name}", result.about
    )
    left = f"{table([], rows, words=True)}{notes(result.notes)}"
    return framed(result.name, result.about, sides(left, right))


def _measured(value: Value) -> str:
    """A value with its error and unit. Empty without one, as its note has the reason."""
    unit = "" if value.unit in ("", "1") else f" {value.unit}"
    return "" if value.value is None else f"{format_with_error(value.value, value.error)}{unit}"


def page_part(record: Record) -> Iterator[str]:
    """HTML of the results of `rigidmd analyse` for a run: values, analyses left out, figures."""
    rows = []
    left_out = []
    figures = []
    phrases = []
    for result, phrase in read_results(record.folder):
        if not result.values and not result.curves:
            left_out += [f"{result.name}: {note}" for note in result.notes]
            continue
        phrases.append(phrase)
        for value in result.values:
            if value.value is None:
                left_out.append(f"{value.name}: {value.note}")
                continue
            rows.append([*row(value), value.note])
        for curve in result.curves:
            svg = figure(curve_figure(curve), f"analysis-{curve.file}", curve.label)
            caption = html.escape(result.title_of(curve))
            figures.append(f"<figure><figcaption>{caption}</figcaption>{svg}</figure>")
    if phrases:
        text = html.escape("; ".join(dict.fromkeys(phrases)))
        yield f'<p class="faint">Values ± one standard error, of {text}.</p>'
    yield table(["", *HEADERS[1:], "note"], rows, words=True)
    yield f'<div class="plots">{"".join(figures)}</div>' if figures else ""
    if left_out:
        title = f"{len(left_out)} values without a result, and why"
        yield f"<details><summary>{title}</summary>{items(left_out)}</details>"
