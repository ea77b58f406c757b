"""What `rigidmd precision --averages` found: a table, sentences, precision.csv and .json, averages.png and .html."""

from itertools import groupby
from pathlib import Path

from rigidmd.figures.run import signed
from rigidmd.figures.style import FAINT, INK, bare_axis, curve_style, drawing, write_figure
from rigidmd.io.write import columns_text, write_csv, write_json
from rigidmd.studies.accuracy.bias import SHARE, AverageRun, Averages, Quantity
from rigidmd.view.page import chips, code, items, page, plain, section, table, wide

FILES = ("precision.csv", "precision.json", "averages.png", "averages.html")


def _unit(quantity: Quantity) -> str:
    """Of its biases."""
    return quantity.bias_unit or quantity.unit


def scale(quantity: Quantity) -> str:
    """Of what a share is told, in words."""
    if quantity.name == "U":
        return "kT per degree of freedom"
    return "N kT/V" if quantity.name == "pressure" else "its value"


def headers(found: Averages) -> list[str]:
    """Column titles of the table, units included."""
    titles = ["integrator", "thermostat", "step (fs)", "forces per ps", "seconds per ns"]
    for quantity in found.quantities:
        titles += [f"{quantity.name} ({quantity.unit})", "±", f"bias of {quantity.name} ({_unit(quantity)})", "±"]
    return [*titles, "fault"]


def row(found: Averages, run: AverageRun) -> list:
    """A line of the table."""
    values: list = [run.integrator, run.thermostat, run.timestep, run.forces_per_ps, run.seconds_per_ns]
    for quantity in found.quantities:
        point, bias = found.point(run, quantity), found.bias(run, quantity)
        values += [None, None, None, None] if point is None or bias is None else [point.mean, point.error, *bias]
    return [*values, run.fault]


def brief_headers(found: Averages) -> list[str]:
    """Column titles of the table as a person reads it."""
    titles = ["method", "step (fs)", "forces/ps", "s/ns"]
    return titles + [f"{q.name} ({'kT' if q.name == 'U' else _unit(q)})" for q in found.quantities]


def brief_rows(found: Averages) -> list[list[str]]:
    """Lines of that table: biases with their errors."""
    lines = []
    for run in found.runs:
        seconds = "-" if run.seconds_per_ns is None else f"{run.seconds_per_ns:.3g}"
        cells = [run.method, f"{run.timestep:g}", f"{run.forces_per_ps:.4g}", "fails" if run.fault else seconds]
        for quantity in found.quantities:
            bias = found.bias(run, quantity)
            cells.append(signed(*bias) if bias else "-")
        lines.append(cells)
    return lines


def table_text(found: Averages) -> str:
    """The table as a person reads it."""
    text = f"bias of averages over {found.sampled:g} ps of {found.stage} (U in kT per degree of freedom)\n"
    return text + columns_text([brief_headers(found), *brief_rows(found)])


def advice(found: Averages) -> list[str]:
    """Sentences: what biases are held against, at which step each is 1 %, what failed."""
    return [*references(found), *_off_words(found), *faults(found)]


def references(found: Averages) -> list[str]:
    """Sentences: what biases are held against."""
    lines = []
    for quantity in found.quantities:
        fit = found.fit(quantity)
        if fit is None or quantity.exact is not None:
            continue
        told = signed(fit.limit, fit.limit_error).lstrip("+")
        how = f"all methods at steps to {fit.longest:g} fs" if fit.slopes else "the shortest step alone"
        lines.append(f"{quantity.name} at a step of zero: {told} {quantity.unit}, from {how}")
    if any(quantity.exact is not None for quantity in found.quantities):
        lines.append(f"temperatures are held against {found.temperature:g} K")
    return lines


def off(found: Averages, method: str, quantity: Quantity) -> str:
    """The step at which a method's bias is 1 %, in words; empty where nothing tells it."""
    at = found.off_at(method, quantity)
    if at is None:
        return ""
    step, seen = at
    return f"{step:.2g} fs" if seen else f"none seen, more than {step:.2g} fs"


def methods_of(found: Averages) -> list[str]:
    """Integrators with their thermostats."""
    return list(dict.fromkeys(run.method for run in found.runs))


def _off_words(found: Averages) -> list[str]:
    lines = []
    for quantity in found.quantities:
        steps = [f"{method} {told}" for method in methods_of(found) if (told := off(found, method, quantity))]
        if steps:
            lines.append(f"{quantity.name} is off by {SHARE:.0%} of {scale(quantity)} at: {'; '.join(steps)}")
    return lines


def faults(found: Averages) -> list[str]:
    """Sentences: what failed."""
    asked = {quantity.name for quantity in found.quantities}
    failed = [(run, run.fault) for run in found.runs if run.fault]
    short = [(run, [name for name in run.short if name in asked]) for run in found.runs]
    failed += [
        (run, f"{', '.join(names)}: {found.sampled:g} ps are too short for an error; sample longer (--sample-ps)")
        for run, names in short
        if names
    ]
    return [f"{run.method} at {run.timestep:g} fs: {words}" for run, words in failed]


def write_averages(folder: Path, found: Averages, command: str) -> list[Path]:
    """All files; the paths written."""
    write_csv(folder / FILES[0], [headers(found), *(row(found, run) for run in found.runs)])
    write_json(folder / FILES[1], as_data(found, command), indent=2, allow_nan=False)
    title = f"{found.name}: bias of averages over {found.sampled:g} ps"
    write_figure(folder / FILES[2], lambda: figure_of(found), title)
    with drawing(folder / FILES[3]) as temporary:
        temporary.write_text(averages_page(found, command), encoding="utf-8")
    return [folder / name for name in FILES if (folder / name).is_file()]


def as_data(found: Averages, command: str) -> dict:
    """Everything, for a program to read."""
    return {
        "command": command,
        "scene": found.name,
        "stage": found.stage,
        "temperature_K": found.temperature,
        "molecules": found.molecules,
        "degrees_of_freedom": found.freedom,
        "sampled_ps": found.sampled,
        "quantities": {quantity.name: _described(found, quantity) for quantity in found.quantities},
        "runs": [_told(found, run) for run in found.runs],
    }


def _described(found: Averages, quantity: Quantity) -> dict:
    fit = found.fit(quantity)
    if fit is None:
        return {"unit": quantity.unit}
    steps = {method: at for method in methods_of(found) if (at := found.off_at(method, quantity))}
    return {
        "unit": quantity.unit,
        "bias_unit": _unit(quantity),
        "reference": fit.limit,
        "reference_error": fit.limit_error,
        "longest_step_in_fit_fs": fit.longest,
        "bias_told_of": found.allowed(quantity),
        "step_of_that_bias_fs": {method: {"step": step, "seen": seen} for method, (step, seen) in steps.items()},
    }


def _told(found: Averages, run: AverageRun) -> dict:
    averages = {}
    for quantity in found.quantities:
        point, bias = found.point(run, quantity), found.bias(run, quantity)
        if point is not None and bias is not None:
            numbers = (point.mean, point.error, *bias)
            averages[quantity.name] = dict(zip(("mean", "error", "bias", "bias_error"), numbers, strict=True))
    return {
        "integrator": run.integrator,
        "thermostat": run.thermostat,
        "timestep_fs": run.timestep,
        "forces_per_ps": run.forces_per_ps,
        "seconds_per_ns": run.seconds_per_ns,
        "averages": averages,
        "fault": run.fault or None,
    }


def figure_of(found: Averages):
    """Bias against the step, a panel a quantity, with error bars and the band within 1 %."""
    from rigidmd.figures.picture import Picture

    shown = [quantity for quantity in found.quantities if found.points(quantity)]
    columns = min(3, max(1, len(shown)))
    rows = max(1, -(-len(shown) // columns))
    figure = Picture(figsize=(3.7 * columns, 3.0 * rows + 0.9), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    methods = methods_of(found)
    handles = {}
    for axis, quantity in zip(axes, shown, strict=False):
        allowed = found.allowed(quantity)
        axis.axhspan(-allowed, allowed, color=FAINT, alpha=0.15, lw=0)
        axis.axhline(0, color=INK, lw=0.7)
        for method, runs in groupby(found.runs, key=lambda run: run.method):
            at = [(run.timestep, *bias) for run in runs if (bias := found.bias(run, quantity))]
            if at:
                steps, values, errors = zip(*at, strict=True)
                style = curve_style(methods.index(method))
                handles[method] = axis.errorbar(steps, values, errors, ms=3.5, lw=1.1, capsize=2, **style)
        axis.set_title(f"{quantity.name}, {_unit(quantity)}", loc="left", fontsize=9, color=INK, pad=17)
        axis.annotate(f"band: {SHARE:.0%} of {scale(quantity)}", (0, 1), (0, 4), xycoords="axes fraction",
                      textcoords="offset points", fontsize=7, color=FAINT)  # fmt: skip
        axis.set_xlim(left=0)
        bare_axis(axis)
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    for axis in axes[max(0, len(shown) - columns) : len(shown)]:
        axis.set_xlabel("time step, fs", color=INK)
    figure.legend(handles.values(), handles.keys(), frameon=False, fontsize=8, loc="outside lower left", ncols=2,
                  labelcolor=INK)  # fmt: skip
    return figure


def averages_page(found: Averages, command: str) -> str:
    """A self-contained page."""
    methods = methods_of(found)
    named = chips(methods)

    def step(method: str, quantity: Quantity) -> str:
        at = found.off_at(method, quantity)
        return "" if at is None else f"{'' if at[1] else '> '}{at[0]:.2g}"

    judged = [q for q in found.quantities if any(found.off_at(method, q) for method in methods)]
    rows = [[named[method], *(step(method, q) for q in judged)] for method in methods]
    scales = dict.fromkeys(scale(q) for q in judged)
    of = [f"{its} ({', '.join(q.name for q in judged if scale(q) == its)})" for its in scales]
    runs = [[named[run.method], *line[1:]] for run, line in zip(found.runs, brief_rows(found), strict=True)]
    about = f"{found.molecules} molecules, {found.freedom} degrees of freedom, {found.stage} at {found.temperature:g} K"
    told = f"{SHARE:.0%} is of {', '.join(of)}. Where none was seen, > tells the step up to which it is smaller"
    parts = [
        f'<p class="faint">{plain(about)}; {found.sampled:g} ps at every step</p>',
        section(
            f"Steps (fs) at which an average is off by {SHARE:.0%}",
            table(["method", *(q.name for q in judged)], rows),
            items([told, *references(found)]),
        ),
        section("Bias against the time step", wide(figure_of(found), "averages", "biases over time steps")),
        section(
            "All runs: biases, U in kT per degree of freedom",
            table(brief_headers(found), runs),
            items(faults(found)),
        ),
    ]
    return page(f"{found.name}: bias of averages", [*parts, section("How to repeat it", code(command))])
