"""The page of `rigidmd precision --averages`: at which steps averages are off, the figure, all runs."""

from rigidmd.measure.bias import SHARE, Averages, Quantity
from rigidmd.output import averages_report as report
from rigidmd.output.figure import curve_style
from rigidmd.output.page import Raw, code, items, page, plain, section, table, wide


def averages_page(found: Averages, command: str) -> str:
    """A self-contained page."""
    methods = report.methods_of(found)
    colors = {name: curve_style(k)["color"] for k, name in enumerate(methods)}

    def named(method: str) -> Raw:
        return Raw(f'<span style="color:{colors[method]}">■</span> {plain(method)}')

    def step(method: str, quantity: Quantity) -> str:
        at = found.off_at(method, quantity)
        return "" if at is None else f"{'' if at[1] else '> '}{at[0]:.2g}"

    judged = [q for q in found.quantities if any(found.off_at(method, q) for method in methods)]
    rows = [[named(method), *(step(method, q) for q in judged)] for method in methods]
    scales = dict.fromkeys(report.scale(q) for q in judged)
    of = [f"{scale} ({', '.join(q.name for q in judged if report.scale(q) == scale)})" for scale in scales]
    runs = [[named(run.method), *line[1:]] for run, line in zip(found.runs, report.brief_rows(found), strict=True)]
    about = f"{found.molecules} molecules, {found.freedom} degrees of freedom, {found.stage} at {found.temperature:g} K"
    told = f"{SHARE:.0%} is of {', '.join(of)}. Where none was seen, > tells the step up to which it is smaller"
    parts = [
        f'<p class="faint">{plain(about)}; {found.sampled:g} ps at every step</p>',
        section(
            f"Steps (fs) at which an average is off by {SHARE:.0%}",
            table(["method", *(q.name for q in judged)], rows),
            items([told, *report.references(found)]),
        ),
        section("Bias against the time step", wide(report.figure_of(found), "averages", "biases over time steps")),
        section(
            "All runs: biases, U in kT per degree of freedom",
            table(report.brief_headers(found), runs),
            items(report.faults(found)),
        ),
    ]
    return page(f"{found.name}: bias of averages", [*parts, section("How to repeat it", code(command))])
