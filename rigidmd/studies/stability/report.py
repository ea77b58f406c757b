"""`rigidmd stability`: runs named cases, each compared with a known answer; stability.csv and a
page."""

import html
import platform
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import inf, isfinite, isnan
from pathlib import Path

from rigidmd.core.files import write_text
from rigidmd.errors import SceneError
from rigidmd.io.write import columns_text, format_cell, write_csv
from rigidmd.scene.validation import did_you_mean
from rigidmd.studies.stability import bodies, molecules, water  # noqa: F401  (cases)
from rigidmd.studies.stability.cases import BOUND, CASES, CRASH, UNDETECTED, VERDICTS, CaseResult
from rigidmd.view.page import BAD, DOUBTFUL, GOOD, Raw, code, items, page, plain, section, table

FILES = ("stability.csv", "stability.html")
HEADERS = (
    "case",
    "integrator",
    "runs",
    "verdicts",
    "largest error",
    "of allowed",
    "longest step",
    "beyond",
    "seconds",
)
KINDS = dict(zip(VERDICTS, (GOOD, GOOD, DOUBTFUL, BAD, BAD), strict=True))  # how a verdict is shown
MESSAGES = 3  # messages of a case at most


def selected_cases(names: list[str] | None) -> list[CaseResult]:
    """The cases of these names, or all. Raises SceneError with a suggestion."""
    if unknown := [name for name in names or [] if name not in CASES]:
        known = f"(known: {', '.join(CASES)})"
        raise SceneError(
            "--case",
            [f"unknown case {name!r}{did_you_mean(name, CASES)} {known}" for name in unknown],
        )
    return sorted((CASES[name] for name in names or CASES), key=lambda case: case.group)


def run_cases(
    names: list[str] | None = None,
    quick: bool = False,
    progress: Callable[..., object] = lambda *_: None,
) -> Iterator[CaseResult]:
    """Yield the results of the named cases (default: all) in order. progress(fraction done, name) :
    before each"""
    cases = selected_cases(names)
    for k, case in enumerate(cases):
        progress(k / len(cases), case.name)
        result = replace(case, runs=[], limits=[], notes=[])
        case.run(result, quick)
        yield result


def _row(result: CaseResult, family: str) -> list[str]:
    runs = [t for t in result.runs if t.family == family]
    limits = [limit for limit in result.limits if limit.family == family]
    verdicts = Counter(t.verdict for t in runs)

    # the worst of the finished runs, relative to the allowed error
    def relative(t):
        return t.outcome.error / t.allowed if t.allowed > 0 else t.outcome.error and inf

    worst = max((t for t in runs if isfinite(t.outcome.error)), key=relative, default=None)
    # the least of its limits if there are several settings
    least = min(limits, key=lambda limit: limit.longest, default=None)
    seconds = sum(t.outcome.seconds for t in runs) + sum(limit.seconds for limit in limits)
    longest = "-"
    if least:
        limit = least.longest if least.longest < inf else least.tried
        longest = f"{'' if least.longest < inf else '> '}{format_cell(limit)} {result.step_unit}"
    return [
        result.name,
        family or "-",
        str(len(runs)),
        ", ".join(f"{verdicts[v]} {v}" for v in VERDICTS if verdicts[v]),
        format_cell(worst.outcome.error) if worst else "-",
        format_cell(worst.allowed) if worst else "-",
        longest,
        (least.beyond or "-") if least else "-",
        f"{seconds:.1f}",
    ]


def table_text(results: list[CaseResult]) -> str:
    return columns_text([HEADERS, *rows_of(results)], left=(0, 1, 3, 7))


def rows_of(results: list[CaseResult]) -> list[list[str]]:
    """A row for each case and integrator."""
    return [_row(result, family) for result in results for family in result.families]


def conclusions(results: list[CaseResult]) -> list[str]:
    """Sentences on failures, unexpected verdicts and the total."""
    failures = [line for result in results for line in result.failures]
    unexpected = [
        f"{f.name}, {t.setting} {t.family}: {t.verdict}, expected {' or '.join(t.expected)}"
        + (f" ({t.outcome.message})" if t.outcome.message else "")
        for f in results
        for t in f.unexpected
        if t.verdict not in (UNDETECTED, CRASH)
    ]
    counts = Counter(t.verdict for result in results for t in result.runs)
    total = ", ".join(f"{counts[v]} {v}" for v in VERDICTS if counts[v])
    limits = sum(len(result.limits) for result in results)
    total = (
        f"{len(results)} cases, {sum(counts.values())} runs: {total}; {limits} longest steps"
        " bisected"
    )
    return [*failures, *unexpected, total]


def write_stability(folder: Path, results: list[CaseResult], command: str) -> list[Path]:
    titles = [
        "case",
        "group",
        "kind",
        "setting",
        "integrator",
        "step",
        "step_unit",
        "error",
        "allowed",
        "conserved_error",
        "verdict",
        "expected",
        "beyond",
        "seconds",
        "message",
    ]
    lines: list[list] = []
    for of in results:
        begin, unit = [of.name, of.group], of.step_unit
        lines += [
            [
                *begin,
                "run",
                t.setting,
                t.family,
                t.step,
                unit,
                t.outcome.error,
                t.allowed,
                t.outcome.reported_error,
                t.verdict,
                " or ".join(t.expected),
                "",
                t.outcome.seconds,
                t.outcome.message or t.outcome.crash,
            ]
            for t in of.runs
        ]
        lines += [
            [
                *begin,
                "longest step",
                limit.setting,
                limit.family,
                limit.longest,
                unit,
                *[""] * 5,
                limit.beyond,
                limit.seconds,
                limit.message,
            ]
            for limit in of.limits
        ]
    cells = [["" if isinstance(x, float) and isnan(x) else x for x in line] for line in lines]
    write_csv(folder / FILES[0], [titles, *cells])
    write_text(folder / FILES[1], stability_page(results, command))
    return [folder / name for name in FILES]


def stability_page(results: list[CaseResult], command: str) -> str:
    links = {f.name: Raw(f'<a href="#case-{plain(f.name)}">{plain(f.name)}</a>') for f in results}
    meanings = [[Raw(_badge(verdict)), meaning] for verdict, meaning in VERDICTS.items()]
    bound = (
        f"The longest step is that at which conserved quantities stay within {BOUND:g} of the"
        " kinetic energy."
    )
    parts = [
        items(conclusions(results)),
        table([], meanings, words=True),
        section(
            "All cases",
            table(HEADERS, rows_of(results), marked=links),
            f"<p>{html.escape(bound)}</p>",
        ),
        *map(_case, results),
        section(
            "How to repeat it",
            code(f"{command}    # on {platform.processor() or platform.machine()}"),
        ),
    ]
    return page("Stability", parts)


def _badge(verdict: str, count: str = "") -> str:
    return (
        f'<span class="badge {KINDS[verdict]}">{html.escape(f"{count} {verdict}".strip())}</span>'
    )


def _case(result: CaseResult) -> str:
    counts = Counter(t.verdict for t in result.runs)
    badges = " ".join(_badge(v, str(counts[v])) for v in VERDICTS if counts[v])
    messages = dict.fromkeys(t.outcome.message for t in result.runs if t.outcome.message)
    notes = [
        *result.notes,
        *(Raw(f"<code>{plain(message)}</code>") for message in list(messages)[:MESSAGES]),
    ]
    error = f"; errors: {plain(result.error_title)}" if result.error_title else ""
    return section(
        result.name,
        f"<p>{plain(result.sentence)}{error}. {badges}</p>",
        items(notes),
        anchor=f"case-{result.name}",
    )
