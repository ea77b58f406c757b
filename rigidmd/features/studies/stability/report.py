"""The report of `rigidmd stability`: verdict and table for the terminal, stability.csv, a page."""

import html
import platform
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from math import inf, isfinite, isnan
from pathlib import Path

from rigidmd.features.studies.stability.cases import (
    BOUND,
    CRASH,
    REFUSED,
    REPORTED,
    RIGHT,
    UNDETECTED,
)
from rigidmd.features.studies.stability.runner import FAILURES, TrialResult
from rigidmd.features.view.page import (
    BAD,
    DOUBTFUL,
    GOOD,
    Raw,
    code,
    items,
    plain,
    section,
    table,
    write_page,
)
from rigidmd.io.write import columns_text, format_cell, write_csv

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
HEADERS = "case,integrator,runs,verdicts,largest error,limit,longest step,beyond,seconds"
COLUMNS = (
    "case,group,kind,setting,integrator,step,step_unit,error,allowed,conserved_error,verdict,"
    "expected,beyond,seconds,message"
)
BOUND_TEXT = (
    f"The longest step is that at which conserved quantities stay within {BOUND:g} of the kinetic"
    " energy."
)
MESSAGES = 3  # messages of a case at most
Results = list[TrialResult]


def summary(results: Results, *, verbose: bool = False) -> list[str]:
    """The verdict, failures, the table, and the warnings if it is verbose."""
    lines = [*conclusions(results), "", table_text(results)]
    if verbose:
        lines += [f"{result.name}: {text}" for result in results for text in result.warnings]
    return lines


def conclusions(results: Results) -> list[str]:
    """The verdict and the total, and sentences on failures and unexpected verdicts."""
    failures = [result.failure for result in results if result.failure]
    unexpected = [_unexpected(result) for result in results if result.is_unexpected]
    counts = verdict_counts(results)
    runs = sum(counts.values())
    cases = len({result.case.name for result in results})
    warnings = sum(len(result.warnings) for result in results)
    bisected = len(results) - runs
    good = runs - sum(bool(result.failure) for result in results if result.limit is None)
    parts = [f"{good} of {runs} runs in {cases} case{'s' * (cases > 1)}", _described(counts)]
    parts += [f"{bisected} longest steps bisected"] * bool(bisected)
    parts += [f"{warnings} warnings, which -v lists"] * bool(warnings)
    total = f"{'failed' if failures else 'passed'}: {'; '.join(filter(None, parts))}"
    return [total, *failures, *filter(None, unexpected)]


def _unexpected(result: TrialResult) -> str:
    if result.verdict in FAILURES:
        return ""
    message = f" ({result.outcome.message})" if result.outcome.message else ""
    expected = " or ".join(result.trial.expected)
    return f"{result.name}: {result.verdict}, expected {expected}{message}"


def verdict_counts(results: Results) -> dict[str, int]:
    """Numbers of runs by their verdicts, in the order of VERDICTS."""
    counts = Counter(result.verdict for result in results)
    return {verdict: counts[verdict] for verdict in VERDICTS if counts[verdict]}


def _described(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {verdict}" for verdict, count in counts.items())


def grouped(results: Results, key: Callable[[TrialResult], Hashable]) -> list[Results]:
    groups: dict[Hashable, Results] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return list(groups.values())


def table_text(results: Results) -> str:
    return columns_text([HEADERS.split(","), *rows_of(results)], left=(0, 1, 3, 7))


def rows_of(results: Results) -> list[list[str]]:
    """A row for each case and integrator."""
    return [_row(group) for group in grouped(results, lambda r: (r.case.name, r.integrator))]


def _row(results: Results) -> list[str]:
    counts = verdict_counts(results)
    finished = [result for result in results if isfinite(result.outcome.error)]
    worst = max(finished, key=_relative_error, default=None)
    case = results[0].case
    return [
        case.name,
        results[0].integrator or "-",
        str(sum(counts.values())),
        _described(counts),
        format_cell(worst and worst.outcome.error),
        format_cell(worst and worst.allowed),
        *_limit_cells(results, case.step_unit),
        f"{sum(result.seconds for result in results):.1f}",
    ]


def _relative_error(result: TrialResult) -> float:
    if result.allowed > 0:
        return result.outcome.error / result.allowed
    return inf if result.outcome.error else 0.0


def _limit_cells(results: Results, unit: str) -> tuple[str, str]:
    """The least of the longest steps of all settings, and how longer ones fail."""
    limits = [result.limit for result in results if result.limit is not None]
    if not limits:
        return "-", "-"
    least = min(limits, key=lambda limit: limit.longest)
    is_limited = least.longest < inf
    step = format_cell(least.longest) if is_limited else f"> {format_cell(least.tried)}"
    return f"{step} {unit}", least.beyond or "-"


def write_stability(folder: Path, results: Results, command: str) -> None:
    write_csv(folder / FILES[0], [COLUMNS.split(","), *map(_csv_row, results)])
    write_page(folder / FILES[1], "Stability", _page_parts(results, command))


def _csv_row(result: TrialResult) -> list[object]:
    case = result.case
    trial = result.trial
    outcome = result.outcome
    limit = result.limit
    row = [case.name, case.group, "run" if limit is None else "longest step", trial.setting]
    row += [result.integrator, trial.step if limit is None else limit.longest, case.step_unit]
    if limit is None:
        expected = " or ".join(trial.expected)
        row += [outcome.error, result.allowed, outcome.reported_error, result.verdict, expected]
        message = outcome.message or outcome.crash or outcome.remark
        row += ["", result.seconds, message]
    else:
        row += [""] * 5 + [limit.beyond, result.seconds, limit.message]
    return ["" if isinstance(cell, float) and isnan(cell) else cell for cell in row]


def _page_parts(results: Results, command: str) -> Iterator[str]:
    cases = grouped(results, lambda result: result.case.name)
    names = [plain(group[0].case.name) for group in cases]
    links = {name: Raw(f'<a href="#case-{name}">{name}</a>') for name in names}
    meanings = [[Raw(_badge(verdict)), meaning] for verdict, (meaning, _) in VERDICTS.items()]
    all_cases = table(HEADERS.split(","), rows_of(results), marked=links)
    machine = platform.processor() or platform.machine()
    yield items(conclusions(results))
    yield table([], meanings, words=True)
    yield section("All cases", all_cases, f"<p>{BOUND_TEXT}</p>")
    yield from map(_case_section, cases)
    yield section("How to repeat it", code(f"{command}    # on {machine}"))


def _badge(verdict: str, count: str = "") -> str:
    text = html.escape(f"{count} {verdict}".strip())
    return f'<span class="badge {VERDICTS[verdict][1]}">{text}</span>'


def _case_section(results: Results) -> str:
    case = results[0].case
    badges = " ".join(
        _badge(verdict, str(count)) for verdict, count in verdict_counts(results).items()
    )
    remarks = [f"{r.name}: {r.outcome.remark}" for r in results if r.outcome.remark]
    messages = dict.fromkeys(r.outcome.message for r in results if r.outcome.message)
    codes = [Raw(f"<code>{plain(message)}</code>") for message in list(messages)[:MESSAGES]]
    errors = f"; errors: {plain(case.error_title)}" if case.error_title else ""
    return section(
        case.name,
        f"<p>{plain(case.sentence)}{errors}. {badges}</p>",
        items([*remarks, *codes]),
        anchor=f"case-{case.name}",
    )
