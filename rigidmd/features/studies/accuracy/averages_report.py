"""Report of `rigidmd accuracy --averages`: a table, conclusions, accuracy.csv and .json,
averages.png and .html."""

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from rigidmd.core.statistics import format_signed
from rigidmd.features.studies.accuracy.averages import (
    BIAS_LIMIT,
    AveragedQuantity,
    AverageRun,
    Averages,
)
from rigidmd.features.view.figures.style import (
    FAINT,
    INK,
    curve_style,
    open_axis,
    panel_grid,
    write_figure,
)
from rigidmd.features.view.page import chips, code, items, plain, section, table, wide, write_page
from rigidmd.io.write import Cell, Column, Table, with_error, write_json

FILES = ("accuracy.csv", "accuracy.json", "averages.png", "averages.html")


def full_table(averages: Averages) -> Table:
    """Means and biases of all runs, with their errors."""
    columns: list[Column[AverageRun]] = [
        Column("integrator", lambda run: run.integrator),
        Column("thermostat", lambda run: run.thermostat),
        Column("step (fs)", lambda run: run.timestep),
        Column("forces per ps", lambda run: run.forces_per_ps),
        Column("seconds per ns", lambda run: run.seconds_per_ns),
    ]
    for q in averages.quantities:

        def measured(run: AverageRun, q=q) -> tuple[Cell, Cell] | None:
            return (point := averages.point(run, q)) and point[2:]

        def bias(run: AverageRun, q=q) -> tuple[Cell, Cell] | None:
            return averages.bias(run, q)

        columns += with_error(f"{q.name} ({q.unit})", measured)
        columns += with_error(f"bias of {q.name} ({q.unit_of_bias})", bias)
    return Table([*columns, Column("failure", lambda run: run.failure)], averages.runs)


def brief_table(averages: Averages) -> Table:
    """Biases with their errors, as text."""
    return Table(
        [
            Column("method", lambda run: run.method),
            Column("step (fs)", lambda run: f"{run.timestep:g}"),
            Column("forces/ps", lambda run: f"{run.forces_per_ps:.4g}"),
            Column("s/ns", lambda run: "fails" if run.failure else run.seconds_per_ns),
            *(
                Column(
                    f"{q.name} ({'kT' if q.name == 'U' else q.unit_of_bias})",
                    lambda run, q=q: (bias := averages.bias(run, q)) and format_signed(*bias),
                )
                for q in averages.main
            ),
        ],
        averages.runs,
    )


def table_text(averages: Averages) -> str:
    text = (
        f"bias of averages over {averages.sampled:g} ps of {averages.stage} (U in kT per degree of"
        " freedom)\n"
    )
    return text + brief_table(averages).text()


def bias_conclusions(averages: Averages) -> list[str]:
    """Sentences: the reference of each bias, the step at which it is 1 %, and failures."""
    return [
        *describe_references(averages),
        *_describe_limits(averages),
        *describe_failures(averages),
    ]


def describe_references(averages: Averages) -> list[str]:
    lines = []
    for quantity in averages.main:
        fit = averages.fit(quantity)
        if fit is None or quantity.exact is not None:
            continue
        how = (
            f"all methods at steps to {fit.longest:g} fs"
            if fit.slopes
            else "the shortest step alone"
        )
        how += f" (chi² {fit.chi2:.2g} for {fit.freedom} degrees of freedom)" if fit.freedom else ""
        lines.append(
            f"{quantity.name} at a step of zero: {fit.describe_limit()} {quantity.unit}, from {how}"
        )
    if any(quantity.exact is not None for quantity in averages.quantities):
        lines.append(f"temperatures are compared with {averages.temperature:g} K")
    return lines


def _describe_limits(averages: Averages) -> list[str]:
    lines = []
    for quantity in averages.main:
        steps = [
            f"{method} {'' if at[1] else 'none seen, more than '}{at[0]:.2g} fs"
            for method in averages.methods
            if (at := averages.step_at_limit(method, quantity))
        ]
        scale = f"{BIAS_LIMIT:.0%} of {quantity.of}"
        lines += [f"{quantity.name} is off by {scale} at: {'; '.join(steps)}"] if steps else []
    return lines


def describe_failures(averages: Averages) -> list[str]:
    """Sentences: which runs failed or were too short."""
    names = {quantity.name for quantity in averages.main}
    failed = [(run, run.failure) for run in averages.runs if run.failure]
    why = f"{averages.sampled:g} ps are too short for an error. Sample longer (--sample-ps)"
    short = [(run, [name for name in run.short if name in names]) for run in averages.runs]
    failed += [(run, f"{', '.join(missing)}: {why}") for run, missing in short if missing]
    return [f"{run.method} at {run.timestep:g} fs: {reason}" for run, reason in failed]


def write_averages(folder: Path, averages: Averages, command: str) -> list[Path]:
    full_table(averages).write(folder / FILES[0])
    write_json(folder / FILES[1], to_json(averages, command), indent=2, allow_nan=False)
    title = f"{averages.name}: bias of averages over {averages.sampled:g} ps"
    write_figure(folder / FILES[2], lambda: averages_figure(averages), title)
    page_title = f"{averages.name}: bias of averages"
    write_page(folder / FILES[3], page_title, _page_parts(averages, command))
    return [folder / name for name in FILES if (folder / name).is_file()]


def to_json(averages: Averages, command: str) -> dict:
    quantities = {}
    methods = averages.methods
    for quantity in averages.quantities:
        quantities[quantity.name] = {"unit": quantity.unit}
        if (fit := averages.fit(quantity)) is not None:
            steps = {
                method: at for method in methods if (at := averages.step_at_limit(method, quantity))
            }
            quantities[quantity.name] |= {
                "bias_unit": quantity.unit_of_bias,
                "reference": fit.limit,
                "reference_error": fit.limit_error,
                "chi2": fit.chi2,
                "degrees_of_freedom": fit.freedom,
                "longest_step_in_fit_fs": fit.longest,
                "bias_limit": averages.bias_limit(quantity),
                "step_of_that_bias_fs": {
                    name: {"step": step, "seen": seen} for name, (step, seen) in steps.items()
                },
            }
    runs = []
    for run in averages.runs:
        means = {}
        for quantity in averages.quantities:
            if (point := averages.point(run, quantity)) and (bias := averages.bias(run, quantity)):
                numbers = (point.mean, point.error, *bias)
                means[quantity.name] = dict(
                    zip(("mean", "error", "bias", "bias_error"), numbers, strict=True)
                )
        runs.append(
            {
                "integrator": run.integrator,
                "thermostat": run.thermostat,
                "timestep_fs": run.timestep,
                "forces_per_ps": run.forces_per_ps,
                "seconds_per_ns": run.seconds_per_ns,
                "averages": means,
                "failure": run.failure or None,
            }
        )
    return {
        "command": command,
        "scene": averages.name,
        "stage": averages.stage,
        "temperature_K": averages.temperature,
        "molecules": averages.molecules,
        "degrees_of_freedom": averages.freedom,
        "sampled_ps": averages.sampled,
        "quantities": quantities,
        "runs": runs,
    }


def averages_figure(averages: Averages):
    """Bias against the step, a panel for each quantity, with error bars and the band within 1 %."""
    shown = [quantity for quantity in averages.main if averages.points(quantity)]
    figure, axes = panel_grid(len(shown), 3, 3.7, 3.0, 0.9)
    methods = averages.methods
    handles = {}
    for axis, quantity in zip(axes, shown, strict=True):
        limit = averages.bias_limit(quantity)
        axis.axhspan(-limit, limit, color=FAINT, alpha=0.15, lw=0)
        axis.axhline(0, color=INK, lw=0.7)
        for method, runs in groupby(averages.runs, key=lambda run: run.method):
            if at := [
                (run.timestep, *bias) for run in runs if (bias := averages.bias(run, quantity))
            ]:
                steps, values, errors = zip(*at, strict=True)
                style = curve_style(methods.index(method))
                handles[method] = axis.errorbar(
                    steps, values, errors, ms=3.5, lw=1.1, capsize=2, **style
                )
        axis.set_title(
            f"{quantity.name} ({quantity.unit_of_bias})", loc="left", fontsize=9, color=INK, pad=17
        )
        axis.annotate(
            f"band: {BIAS_LIMIT:.0%} of {quantity.of}",
            (0, 1),
            (0, 4),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize=7,
            color=FAINT,
        )
        axis.set_xlim(left=0)
        open_axis(axis)
    for axis in axes[-3:]:
        axis.set_xlabel("time step (fs)", color=INK)
    figure.legend(
        handles.values(),
        handles.keys(),
        frameon=False,
        fontsize=8,
        loc="outside lower left",
        ncols=2,
        labelcolor=INK,
    )
    return figure


def _page_parts(averages: Averages, command: str) -> Iterator[str]:
    methods = averages.methods
    colored = chips(methods)

    def step(method: str, quantity: AveragedQuantity) -> str:
        at = averages.step_at_limit(method, quantity)
        return "" if at is None else f"{'' if at[1] else '> '}{at[0]:.2g}"

    judged = [
        q for q in averages.main if any(averages.step_at_limit(method, q) for method in methods)
    ]
    rows = [[colored[method], *(step(method, q) for q in judged)] for method in methods]
    scales = dict.fromkeys(q.of for q in judged)
    of = [f"{scale} ({', '.join(q.name for q in judged if q.of == scale)})" for scale in scales]
    about = (
        f"{averages.molecules} molecules, {averages.freedom} degrees of freedom, {averages.stage}"
        f" at {averages.temperature:g} K"
    )
    note = (
        f"{BIAS_LIMIT:.0%} is of {', '.join(of)}. Where none was seen, > gives the step up to which"
        " it is smaller"
    )
    steps = (
        table(["method", *(q.name for q in judged)], rows),
        items([note, *describe_references(averages)]),
    )
    all_runs = (
        table(*brief_table(averages).shown(), marked=colored),
        items(describe_failures(averages)),
    )
    drawn = wide(averages_figure(averages), "averages", "biases over time steps")
    yield f'<p class="faint">{plain(about)}; {averages.sampled:g} ps at every step</p>'
    yield section(f"Steps (fs) at which an average is off by {BIAS_LIMIT:.0%}", *steps)
    yield section("Bias against the time step", drawn)
    yield section("All runs: biases, U in kT per degree of freedom", *all_runs)
    yield section("How to repeat it", code(command))
