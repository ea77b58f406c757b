"""Report of `rigidmd stability`: a table, failures in words, stability.csv, .md and a self-contained page."""

import html
from collections import Counter
from math import inf, isfinite, isnan
from pathlib import Path

import numpy as np

from rigidmd.core.files import write_text
from rigidmd.figures.style import INK, bare_axis, curve_style, drawing, few_decades
from rigidmd.io.write import columns_text, write_csv
from rigidmd.studies.stability.outcomes import (
    BOUND,
    CRASH,
    REFUSED,
    RIGHT,
    SILENT,
    TOLD,
    VERDICTS,
    Finding,
    Limit,
    Trial,
)
from rigidmd.view.page import BAD, DOUBTFUL, GOOD, Raw, code, items, page, plain, section, table, wide

FILES = ("stability.csv", "stability.html", "stability.md")
HEADERS = ("case", "integrator", "runs", "verdicts", "largest error", "of allowed", "longest step", "beyond", "seconds")


def rows(finding: Finding) -> list[list[str]]:
    """Lines of the table: one for each integrator of a case."""
    return [_row(finding, family) for family in finding.families]


def _row(finding: Finding, family: str) -> list[str]:
    trials = [t for t in finding.trials if t.family == family]
    limits = [limit for limit in finding.limits if limit.family == family]
    verdicts = Counter(t.verdict for t in trials)
    # the worst of the finished runs, relative to the allowed error
    ended = [t for t in trials if isfinite(t.outcome.error)]
    worst = max(ended, key=_share, default=None)
    # the least of its limits if there are several settings
    least = min(limits, key=lambda limit: limit.longest, default=None)
    seconds = sum(t.outcome.seconds for t in trials) + sum(limit.seconds for limit in limits)
    return [
        finding.name,
        family or "-",
        str(len(trials)),
        ", ".join(f"{verdicts[v]} {v}" for v in VERDICTS if verdicts[v]),
        _short(worst.outcome.error) if worst else "-",
        _short(worst.allowed) if worst else "-",
        _limit(least, finding.step_unit) if least else "-",
        (least.beyond or "-") if least else "-",
        f"{seconds:.1f}",
    ]


def _share(trial: Trial) -> float:
    return trial.outcome.error / trial.allowed if trial.allowed > 0 else trial.outcome.error and inf


def _limit(limit: Limit, unit: str) -> str:
    if limit.longest == inf:
        return f"> {_short(max(step for step, _ in limit.curve))} {unit}"
    return f"{_short(limit.longest)} {unit}"


def _short(x: float) -> str:
    return f"{x:.3g}" if x == 0 or 1e-3 <= abs(x) < 1e5 else f"{x:.1e}"


def table_text(findings: list[Finding]) -> str:
    """The table as text."""
    return columns_text([HEADERS, *(line for finding in findings for line in rows(finding))], left=(0, 1, 3, 7))


def words(findings: list[Finding]) -> list[str]:
    """Sentences on failures, unexpected outcomes and the total."""
    silent = [line for finding in findings for line in finding.silent]
    others = [
        f"{f.name}, {t.setting} {t.family}: {t.verdict}, expected {' or '.join(t.expected)}"
        + (f" ({t.outcome.message})" if t.outcome.message else "")
        for f in findings
        for t in f.unexpected
        if t.verdict not in ("SILENT", "crash")
    ]
    counts = Counter(t.verdict for finding in findings for t in finding.trials)
    total = ", ".join(f"{counts[v]} {v}" for v in VERDICTS if counts[v])
    limits = sum(len(finding.limits) for finding in findings)
    return [
        *silent,
        *others,
        f"{len(findings)} cases, {sum(counts.values())} runs: {total}; {limits} longest steps bisected",
    ]


def failed(findings: list[Finding]) -> bool:
    """Whether anything was silently wrong or crashed."""
    return any(finding.silent for finding in findings)


def write_stability(folder: Path, findings: list[Finding], command: str, machine: str) -> list[Path]:
    """Write all files. Returns their paths."""
    titles = ["case", "group", "kind", "setting", "integrator", "step", "step_unit", "error", "allowed",
              "conserved_error", "verdict", "expected", "beyond", "seconds", "message"]  # fmt: skip
    write_csv(folder / FILES[0], [titles, *(line for finding in findings for line in _csv_lines(finding))])
    write_text(folder / FILES[2], markdown(findings, command, machine))
    with drawing(folder / FILES[1]) as temporary:
        temporary.write_text(stability_page(findings, command, machine), encoding="utf-8")
    return [folder / name for name in FILES if (folder / name).is_file()]


def _csv_lines(finding: Finding) -> list[list]:
    lines = [
        [finding.name, finding.group, "run", t.setting, t.family, t.step, finding.step_unit, t.outcome.error,
         t.allowed, t.outcome.told, t.verdict, " or ".join(t.expected), "", t.outcome.seconds,
         t.outcome.message or t.outcome.crash]
        for t in finding.trials
    ]  # fmt: skip
    lines += [
        [finding.name, finding.group, "longest step", limit.setting, limit.family, limit.longest, finding.step_unit, "",
         "", "", "", "", limit.beyond, limit.seconds, limit.message]
        for limit in finding.limits
    ]  # fmt: skip
    return [["" if isinstance(x, float) and isnan(x) else x for x in line] for line in lines]


def markdown(findings: list[Finding], command: str, machine: str) -> str:
    """The table and the sentences as Markdown."""
    lines = ["# Stability", "", f"`{command}` on {machine}; {sum(f.seconds for f in findings):.0f} s.", ""]
    lines += [f"- *{verdict}*: {meaning}" for verdict, meaning in VERDICTS.items()]
    lines += [
        f"- *longest step*: at which conserved quantities stay within {BOUND:g} of the kinetic energy, bisected",
        "",
    ]
    lines += ["| " + " | ".join(HEADERS) + " |", "|" + "---|" * len(HEADERS)]
    lines += ["| " + " | ".join(x.replace("|", "\\|") for x in line) + " |" for f in findings for line in rows(f)]
    lines += ["", "## Cases", ""]
    for f in findings:
        lines.append(f"- **{f.name}** ({f.group}): {f.sentence}.")
        lines += [f"  - {note}" for note in f.notes]
    return "\n".join([*lines, "", *(f"- {line}" for line in words(findings)), ""])


def picture(finding: Finding, styles: dict[str, dict] | None = None):
    """A small figure of a case: errors over the varied quantity, and of conserved quantities over the step.

    styles : integrator -> colour and marker; None without numbers
    """
    from rigidmd.figures.picture import Picture

    styles = styles or styles_of([finding])
    varied = len({t.x for t in finding.trials if isfinite(t.x) and isfinite(t.outcome.error)}) > 1
    panels = [kind for kind, has in (("trials", varied), ("limits", finding.limits)) if has]
    if not panels:
        return None
    figure = Picture(figsize=(4.6 * len(panels), 3.0), layout="constrained")
    for axis, kind in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
        for family in finding.families:
            (_draw_trials if kind == "trials" else _draw_limits)(axis, finding, family, styles[family])
        axis.set_xscale("log" if _positive(axis) else "linear")
        axis.set_yscale("log")
        bare_axis(axis, labelsize=7, which="both")
        for line in (axis.xaxis, axis.yaxis):
            line.label.set(size=8, color=INK)
            if line.get_scale() == "log":
                few_decades(line)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(frameon=False, fontsize=6.5, loc="upper left", bbox_to_anchor=(1.0, 1.0), labelcolor=INK)
    return figure


def styles_of(findings: list[Finding]) -> dict[str, dict]:
    """Colour and marker of each integrator, the same in all figures."""
    names = dict.fromkeys(family for finding in findings for family in finding.families)
    return {name: {key: curve_style(k)[key] for key in ("color", "marker")} for k, name in enumerate(names)}


def _positive(axis) -> bool:
    data = np.concatenate([line.get_xdata() for line in axis.get_lines()])
    return data.min(initial=inf) > 0 and data.max(initial=0) > 20 * data.min(initial=inf)


#: Errors of nothing at all are drawn here.
FLOOR = 1e-17


def _draw_trials(axis, finding: Finding, family: str, style: dict) -> None:
    own = sorted((t for t in finding.trials if t.family == family and isfinite(t.x)), key=lambda t: t.x)
    right = [t for t in own if t.verdict == RIGHT]
    wrong = [t for t in own if t.verdict != RIGHT and isfinite(t.outcome.error)]
    hollow = {"ls": "none", "ms": 5, "mfc": "none", "label": family or None, **style}
    axis.plot([t.x for t in right], [max(t.outcome.error, FLOOR) for t in right], **hollow)
    color = style["color"]
    axis.plot([t.x for t in wrong], [max(t.outcome.error, FLOOR) for t in wrong], "x", ms=6, color=color)
    bound = [t for t in own if t.allowed > 0 and isfinite(t.allowed) and isfinite(t.outcome.error)]
    axis.plot([t.x for t in bound], [t.allowed for t in bound], "_", ms=6, color=color, alpha=0.6)
    axis.set_xlabel(finding.x_title)
    axis.set_ylabel(finding.error_title + "\n(dashes: allowed)")


def _draw_limits(axis, finding: Finding, family: str, style: dict) -> None:
    for n, limit in enumerate(one for one in finding.limits if one.family == family):
        points = [(step, min(max(told, FLOOR), 1e6)) for step, told in limit.curve if not isnan(told)]
        if points:
            axis.plot(*zip(*points, strict=True), lw=0.9, ms=3, label=None if n else family, **style)
        if isfinite(limit.longest) and limit.longest > 0:
            axis.axvline(limit.longest, color=style["color"], lw=0.6, ls=":")
    axis.set_xlabel(f"step ({finding.step_unit}); dotted: longest bounded")
    axis.set_ylabel("largest error of a conserved quantity")


#: How a verdict is shown.
KINDS = {RIGHT: GOOD, REFUSED: GOOD, TOLD: DOUBTFUL, SILENT: BAD, CRASH: BAD}
#: Messages of a case at most.
MESSAGES = 3


def stability_page(findings: list[Finding], command: str, machine: str) -> str:
    """A self-contained page."""
    styles = styles_of(findings)
    glance = [[_link(f), *_counts(f), f.sentence] for f in findings]
    meanings = [[Raw(_badge(verdict)), meaning] for verdict, meaning in VERDICTS.items()]
    bound = f"The longest step is that at which conserved quantities stay within {BOUND:g} of the kinetic energy."
    lines = [[_link(f), *line[1:]] for f in findings for line in rows(f)]
    parts = [
        items(words(findings)),
        section("At a glance", table(["case", *VERDICTS, ""], glance), table([], meanings, words=True)),
        section("All integrators", table(HEADERS, lines), f"<p>{html.escape(bound)}</p>"),
        *(_case(finding, styles) for finding in findings),
        section("How to repeat it", code(f"{command}    # on {machine}")),
    ]
    return page("Stability", parts)


def _link(finding: Finding) -> Raw:
    return Raw(f'<a href="#case-{plain(finding.name)}">{plain(finding.name)}</a>')


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
    drawn = picture(finding, styles)
    shown = "" if drawn is None else wide(drawn, finding.name, finding.name)
    messages = dict.fromkeys(t.outcome.message for t in finding.trials if t.outcome.message)
    told = [*finding.notes, *(Raw(f"<code>{plain(message)}</code>") for message in list(messages)[:MESSAGES])]
    sentence = f"<p>{plain(finding.sentence)}. {badges}</p>"
    return section(finding.name, sentence, shown, items(told), anchor=f"case-{finding.name}")
