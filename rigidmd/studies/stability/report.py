"""The report of `rigidmd stability`: a table for the terminal, stability.csv and a page."""

import html
import platform
from collections import Counter
from math import inf, isfinite, isnan
from pathlib import Path
from typing import Any

from rigidmd.core.files import write_text
from rigidmd.io.write import columns_text, format_cell, write_csv
from rigidmd.studies.stability.cases import (
    BOUND,
    CRASH,
    REFUSED,
    REPORTED,
    RIGHT,
    UNDETECTED,
    Case,
)
from rigidmd.studies.stability.runner import FAILURES, CaseResult, TrialResult
from rigidmd.view.page import BAD, DOUBTFUL, GOOD, Raw, code, items, page, plain, section, table

#: Meaning of each verdict, and how it is shown.
VERDICTS = {
    RIGHT: ("the answer is right within the error stated", GOOD),
    REFUSED: ("an error message of rigidmd describes what is wrong", GOOD),
    REPORTED: (
        "the answer is wrong, the run finished, and the diagnostics that it reports show it",
        DOUBTFUL,
    ),
    UNDETECTED: ("the answer is wrong and nothing shows it", BAD),
    CRASH: ("an exception that is not an error of rigidmd", BAD),
}
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
COLUMNS = (
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
)
MESSAGES = 3  # messages of a case at most


def rows_of(results: list[CaseResult]) -> list[list[str]]:
    """A row for each case and integrator."""
    parts = [part for result in results for part in result.by_integrator.items()]
    return [_row(integrator, part) for integrator, part in parts]


def _row(integrator: str, part: CaseResult) -> list[str]:
    finished = [run for run in part.runs if isfinite(run.outcome.error)]
    worst = max(finished, key=_relative_error, default=None)
    seconds = sum(result.outcome.seconds for result in part.results)
    return [
        part.case.name,
        integrator or "-",
        str(len(part.runs)),
        ", ".join(f"{count} {verdict}" for verdict, count in counts_of([part]).items()),
        format_cell(worst.outcome.error) if worst else "-",
        format_cell(worst.allowed) if worst else "-",
        *_limit_cells(part),
        f"{seconds:.1f}",
    ]


def _relative_error(run: TrialResult) -> float:
    if run.allowed > 0:
        return run.outcome.error / run.allowed
    return inf if run.outcome.error else 0.0


def _limit_cells(part: CaseResult) -> tuple[str, str]:
    """The least of the longest steps of all settings, and how longer ones fail."""
    if not part.limits:
        return "-", "-"
    least = min(part.limits, key=lambda limit: limit.longest)
    is_limited = least.longest < inf
    step = format_cell(least.longest) if is_limited else f"> {format_cell(least.tried)}"
    return f"{step} {part.case.step_unit}", least.beyond or "-"


def counts_of(results: list[CaseResult]) -> dict[str, int]:
    """Numbers of runs by their verdicts, in the order of VERDICTS."""
    counts = Counter(run.verdict for result in results for run in result.runs)
    return {verdict: counts[verdict] for verdict in VERDICTS if counts[verdict]}


def table_text(results: list[CaseResult]) -> str:
    return columns_text([HEADERS, *rows_of(results)], left=(0, 1, 3, 7))


def conclusions(results: list[CaseResult]) -> list[str]:
    """Sentences on failures, unexpected verdicts and the total."""
    failures = [failure for result in results for failure in result.failures]
    unexpected = [
        f"{result.case.name}, {_unexpected(run)}"
        for result in results
        for run in result.runs
        if not run.is_expected and run.verdict not in FAILURES
    ]
    counts = counts_of(results)
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    limits = sum(len(result.limits) for result in results)
    runs = f"{len(results)} cases, {sum(counts.values())} runs: {verdicts}"
    return [*failures, *unexpected, f"{runs}; {limits} longest steps bisected"]


def _unexpected(run: TrialResult) -> str:
    trial, message = run.trial, run.outcome.message
    expected = " or ".join(trial.expected)
    sentence = f"{trial.setting} {run.integrator}: {run.verdict}, expected {expected}"
    return f"{sentence} ({message})" if message else sentence


def write_stability(folder: Path, results: list[CaseResult], command: str) -> list[Path]:
    rows = [
        _csv_row(result.case, each)
        for result in results
        for each in sorted(result.results, key=lambda each: each.limit is not None)
    ]
    write_csv(folder / FILES[0], [COLUMNS, *rows])
    write_text(folder / FILES[1], stability_page(results, command))
    return [folder / name for name in FILES]


def _csv_row(case: Case, result: TrialResult) -> list[Any]:
    trial, outcome, limit = result.trial, result.outcome, result.limit
    row = [
        case.name,
        case.group,
        "run" if limit is None else "longest step",
        trial.setting,
        result.integrator,
        trial.step if limit is None else limit.longest,
        case.step_unit,
        outcome.error,
        result.allowed,
        outcome.reported_error,
        result.verdict,
        " or ".join(trial.expected),
        "" if limit is None else limit.beyond,
        outcome.seconds,
        outcome.message or outcome.crash or outcome.remark if limit is None else limit.message,
    ]
    return ["" if isinstance(cell, float) and isnan(cell) else cell for cell in row]


def stability_page(results: list[CaseResult], command: str) -> str:
    names = [plain(result.case.name) for result in results]
    links = {name: Raw(f'<a href="#case-{name}">{name}</a>') for name in names}
    meanings = [[Raw(_badge(verdict)), meaning] for verdict, (meaning, _) in VERDICTS.items()]
    bound = (
        f"The longest step is that at which conserved quantities stay within {BOUND:g} of the"
        " kinetic energy."
    )
    all_cases = table(HEADERS, rows_of(results), marked=links)
    machine = platform.processor() or platform.machine()
    parts = [
        items(conclusions(results)),
        table([], meanings, words=True),
        section("All cases", all_cases, f"<p>{html.escape(bound)}</p>"),
        *map(_case_section, results),
        section("How to repeat it", code(f"{command}    # on {machine}")),
    ]
    return page("Stability", parts)


def _badge(verdict: str, count: str = "") -> str:
    text = html.escape(f"{count} {verdict}".strip())
    return f'<span class="badge {VERDICTS[verdict][1]}">{text}</span>'


def _case_section(result: CaseResult) -> str:
    case, outcomes = result.case, [(run.integrator, run.outcome) for run in result.runs]
    badges = " ".join(_badge(*count) for count in counts_of([result]).items())
    remarks = {f"{integrator}: {o.remark}" for integrator, o in outcomes if o.remark}
    messages = dict.fromkeys(o.message for _, o in outcomes if o.message)
    codes = [Raw(f"<code>{plain(message)}</code>") for message in list(messages)[:MESSAGES]]
    errors = f"; errors: {plain(case.error_title)}" if case.error_title else ""
    return section(
        case.name,
        f"<p>{plain(case.sentence)}{errors}. {badges}</p>",
        items([*sorted(remarks), *codes]),
        anchor=f"case-{case.name}",
    )
