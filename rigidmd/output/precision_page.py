"""The page of `rigidmd precision`: advice as a table, the figure, all trials."""

from rigidmd.measure.trials import Precision
from rigidmd.output import precision_report as report
from rigidmd.output.figure import curve_style
from rigidmd.output.page import Raw, code, items, page, plain, section, table, wide


def precision_page(found: Precision, command: str) -> str:
    """A self-contained page."""
    names = list(dict.fromkeys(t.integrator for t in found.trials))
    colors = {name: curve_style(k)["color"] for k, name in enumerate(names)}

    def named(integrator: str) -> Raw:
        return Raw(f'<span style="color:{colors[integrator]}">■</span> {plain(integrator)}')

    unit = found.subject.time_unit
    rows = [
        [c.error, named(c.integrator), f"{c.at.step:.2g}" + (f" ({c.at.limit})" if c.at.limit else ""),
         f"{c.at.seconds / found.subject.span:.2g}",
         f"{c.times_faster:.1f} (at {c.common_step:.2g})" if c.common else "",
         ", ".join(f"{name} at {at.step:.2g}" for name, at in c.rivals)]
        for c in report.cheapest(found)
    ]  # fmt: skip
    per = "ps" if unit == "fs" else "s"
    titles = [
        f"for, over {found.subject.span:g} {per}",
        "the cheapest is",
        f"at a step of ({unit})",
        f"seconds per {per}",
        "times faster than velocity_verlet",
        "as fast within the spread of the timings",
    ]
    trials = [[named(t.integrator), *map(report.short, report.row(found, t)[1:])] for t in found.trials]
    parts = [
        section("Advice", table(titles, rows), items(report.remarks(found))),
        section("Error against run time", wide(report.figure_of(found), "precision", "log error over log run time")),
        section("All trials", table(report.headers(found), trials)),
    ]
    if sampled := [trial for trial in found.trials if trial.averages]:
        lines = [[named(t.integrator), *map(report.short, report.brief_row(found, t)[1:])] for t in sampled]
        parts.append(section(f"Averages over {found.sampled:g} ps", table(report.brief_headers(), lines)))
    return page(f"{found.subject.name}: error against run time", [*parts, section("How to repeat it", code(command))])
