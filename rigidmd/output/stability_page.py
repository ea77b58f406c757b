"""The page of `rigidmd stability`: verdicts at a glance, each leading to its case; figures; messages."""

import html
from collections import Counter

from rigidmd.measure.stability import BOUND, CRASH, REFUSED, RIGHT, SILENT, TOLD, VERDICTS, Finding
from rigidmd.output import stability_report as report
from rigidmd.output.page import BAD, DOUBTFUL, GOOD, Raw, code, items, page, plain, section, table, wide

#: How a verdict is shown.
KINDS = {RIGHT: GOOD, REFUSED: GOOD, TOLD: DOUBTFUL, SILENT: BAD, CRASH: BAD}
#: Messages of a case at most.
MESSAGES = 3


def stability_page(findings: list[Finding], command: str, machine: str) -> str:
    """A self-contained page."""
    styles = report.styles_of(findings)
    glance = [[Raw(f'<a href="#{_anchor(f)}">{plain(f.name)}</a>'), *_counts(f), f.sentence] for f in findings]
    meanings = [[Raw(_badge(verdict)), meaning] for verdict, meaning in VERDICTS.items()]
    bound = f"The longest step is that at which conserved quantities stay within {BOUND:g} of the kinetic energy."
    rows = [
        [Raw(f'<a href="#{_anchor(f)}">{plain(cell)}</a>') if k == 0 else cell for k, cell in enumerate(line)]
        for f in findings
        for line in report.rows(f)
    ]
    parts = [
        items(report.words(findings)),
        section("At a glance", table(["case", *VERDICTS, ""], glance), table([], meanings, words=True)),
        section("All integrators", table(report.HEADERS, rows), f"<p>{html.escape(bound)}</p>"),
        *(_case(finding, styles) for finding in findings),
        section("How to repeat it", code(f"{command}    # on {machine}")),
    ]
    return page("Stability", parts)


def _anchor(finding: Finding) -> str:
    return html.escape(f"case-{finding.name}")


def _badge(verdict: str, count: str = "") -> str:
    return f'<span class="badge {KINDS[verdict]}">{html.escape(f"{count} {verdict}".strip())}</span>'


def _counts(finding: Finding) -> list[Raw]:
    """How many runs got each verdict, longest steps with a silent end among them."""
    counts = Counter(t.verdict for t in finding.trials)
    counts.update(limit.beyond for limit in finding.limits if limit.beyond in (SILENT, CRASH))
    return [Raw(f'<span class="{KINDS[v]}">{counts[v]}</span>' if counts[v] else "") for v in VERDICTS]


def _case(finding: Finding, styles: dict[str, dict]) -> str:
    counts = Counter(t.verdict for t in finding.trials)
    badges = " ".join(_badge(v, str(counts[v])) for v in VERDICTS if counts[v])
    drawn = report.picture(finding, styles)
    shown = "" if drawn is None else wide(drawn, finding.name, finding.name)
    messages = dict.fromkeys(t.outcome.message for t in finding.trials if t.outcome.message)
    told = [*finding.notes, *(Raw(f"<code>{plain(message)}</code>") for message in list(messages)[:MESSAGES])]
    sentence = f"<p>{plain(finding.sentence)}. {badges}</p>"
    return section(finding.name, sentence, shown, items(told), anchor=f"case-{finding.name}")
