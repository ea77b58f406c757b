"""Report of `rigidmd accuracy --averages`: a table, conclusions, accuracy.csv and .json,
averages.png and .html."""

from itertools import groupby
from pathlib import Path

from rigidmd.core.statistics import format_signed
from rigidmd.figures.style import FAINT, INK, curve_style, open_axis, panel_grid, write_figure
from rigidmd.io.write import Column, Table, with_error, write_json
from rigidmd.studies.accuracy.averages import BIAS_LIMIT, AveragedQuantity, Averages
from rigidmd.view.page import chips, code, items, page, plain, section, table, wide, write_page

FILES = ("accuracy.csv", "accuracy.json", "averages.png", "averages.html")


def full_table(found: Averages) -> Table:
    """Means and biases of all runs, with their errors."""
    columns = [
        Column("integrator", lambda run: run.integrator),
        Column("thermostat", lambda run: run.thermostat),
        Column("step (fs)", lambda run: run.timestep),
        Column("forces per ps", lambda run: run.forces_per_ps),
        Column("seconds per ns", lambda run: run.seconds_per_ns),
    ]
    for q in found.quantities:
        columns += with_error(
            f"{q.name} ({q.unit})", lambda run, q=q: (point := found.point(run, q)) and point[2:]
        )
        columns += with_error(
            f"bias of {q.name} ({q.unit_of_bias})", lambda run, q=q: found.bias(run, q)
        )
    return Table([*columns, Column("failure", lambda run: run.failure)], found.runs)


def brief_table(found: Averages) -> Table:
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
                    lambda run, q=q: (bias := found.bias(run, q)) and format_signed(*bias),
                )
                for q in found.main
            ),
        ],
        found.runs,
    )


def table_text(found: Averages) -> str:
    text = (
        f"bias of averages over {found.sampled:g} ps of {found.stage} (U in kT per degree of"
        " freedom)\n"
    )
    return text + brief_table(found).text()


def bias_conclusions(found: Averages) -> list[str]:
    """Sentences: the reference of each bias, the step at which it is 1 %, and failures."""
    return [*describe_references(found), *_describe_limits(found), *describe_failures(found)]


def describe_references(found: Averages) -> list[str]:
    lines = []
    for quantity in found.main:
        fit = found.fit(quantity)
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
    if any(quantity.exact is not None for quantity in found.quantities):
        lines.append(f"temperatures are compared with {found.temperature:g} K")
    return lines


def _describe_limits(found: Averages) -> list[str]:
    lines = []
    for quantity in found.main:
        steps = [
            f"{method} {'' if at[1] else 'none seen, more than '}{at[0]:.2g} fs"
            for method in found.methods
            if (at := found.step_at_limit(method, quantity))
        ]
        scale = f"{BIAS_LIMIT:.0%} of {quantity.of}"
        lines += [f"{quantity.name} is off by {scale} at: {'; '.join(steps)}"] if steps else []
    return lines


def describe_failures(found: Averages) -> list[str]:
    """Sentences: which runs failed or were too short."""
    names = {quantity.name for quantity in found.main}
    failed = [(run, run.failure) for run in found.runs if run.failure]
    why = f"{found.sampled:g} ps are too short for an error; sample longer (--sample-ps)"
    short = [(run, [name for name in run.short if name in names]) for run in found.runs]
    failed += [(run, f"{', '.join(missing)}: {why}") for run, missing in short if missing]
    return [f"{run.method} at {run.timestep:g} fs: {reason}" for run, reason in failed]


def write_averages(folder: Path, found: Averages, command: str) -> list[Path]:
    full_table(found).write(folder / FILES[0])
    write_json(folder / FILES[1], to_json(found, command), indent=2, allow_nan=False)
    title = f"{found.name}: bias of averages over {found.sampled:g} ps"
    write_figure(folder / FILES[2], lambda: averages_figure(found), title)
    write_page(folder / FILES[3], lambda: averages_page(found, command))
    return [folder / name for name in FILES if (folder / name).is_file()]


def to_json(found: Averages, command: str) -> dict:
    quantities, methods = {}, found.methods
    for quantity in found.quantities:
        quantities[quantity.name] = {"unit": quantity.unit}
        if (fit := found.fit(quantity)) is not None:
            steps = {
                method: at for method in methods if (at := found.step_at_limit(method, quantity))
            }
            quantities[quantity.name] |= {
                "bias_unit": quantity.unit_of_bias,
                "reference": fit.limit,
                "reference_error": fit.limit_error,
                "chi2": fit.chi2,
                "degrees_of_freedom": fit.freedom,
                "longest_step_in_fit_fs": fit.longest,
                "bias_limit": found.bias_limit(quantity),
                "step_of_that_bias_fs": {
                    name: {"step": step, "seen": seen} for name, (step, seen) in steps.items()
                },
            }
    runs = []
    for run in found.runs:
        averages = {}
        for quantity in found.quantities:
            if (point := found.point(run, quantity)) and (bias := found.bias(run, quantity)):
                numbers = (point.mean, point.error, *bias)
                averages[quantity.name] = dict(
                    zip(("mean", "error", "bias", "bias_error"), numbers, strict=True)
                )
        runs.append(
            {
                "integrator": run.integrator,
                "thermostat": run.thermostat,
                "timestep_fs": run.timestep,
                "forces_per_ps": run.forces_per_ps,
                "seconds_per_ns": run.seconds_per_ns,
                "averages": averages,
                "failure": run.failure or None,
            }
        )
    return {
        "command": command,
        "scene": found.name,
        "stage": found.stage,
        "temperature_K": found.temperature,
        "molecules": found.molecules,
        "degrees_of_freedom": found.freedom,
        "sampled_ps": found.sampled,
        "quantities": quantities,
        "runs": runs,
    }


def averages_figure(found: Averages):
    """Bias against the step, a panel for each quantity, with error bars and the band within 1 %."""
    shown = [quantity for quantity in found.main if found.points(quantity)]
    figure, axes = panel_grid(len(shown), 3, 3.7, 3.0, 0.9)
    methods = found.methods
    handles = {}
    for axis, quantity in zip(axes, shown, strict=True):
        limit = found.bias_limit(quantity)
        axis.axhspan(-limit, limit, color=FAINT, alpha=0.15, lw=0)
        axis.axhline(0, color=INK, lw=0.7)
        for method, runs in groupby(found.runs, key=lambda run: run.method):
            if at := [(run.timestep, *bias) for run in runs if (bias := found.bias(run, quantity))]:
                steps, values, errors = zip(*at, strict=True)
                style = curve_style(methods.index(method))
                handles[method] = axis.errorbar(
                    steps, values, errors, ms=3.5, lw=1.1, capsize=2, **style
                )
        axis.set_title(
            f"{quantity.name}, {quantity.unit_of_bias}", loc="left", fontsize=9, color=INK, pad=17
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
        axis.set_xlabel("time step, fs", color=INK)
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


def averages_page(found: Averages, command: str) -> str:
    methods = found.methods
    colored = chips(methods)

    def step(method: str, quantity: AveragedQuantity) -> str:
        at = found.step_at_limit(method, quantity)
        return "" if at is None else f"{'' if at[1] else '> '}{at[0]:.2g}"

    judged = [q for q in found.main if any(found.step_at_limit(method, q) for method in methods)]
    rows = [[colored[method], *(step(method, q) for q in judged)] for method in methods]
    scales = dict.fromkeys(q.of for q in judged)
    of = [f"{scale} ({', '.join(q.name for q in judged if q.of == scale)})" for scale in scales]
    about = (
        f"{found.molecules} molecules, {found.freedom} degrees of freedom, {found.stage} at"
        f" {found.temperature:g} K"
    )
    note = (
        f"{BIAS_LIMIT:.0%} is of {', '.join(of)}. Where none was seen, > gives the step up to which"
        " it is smaller"
    )
    steps = (
        table(["method", *(q.name for q in judged)], rows),
        items([note, *describe_references(found)]),
    )
    all_runs = table(*brief_table(found).shown(), marked=colored), items(describe_failures(found))
    parts = [
        f'<p class="faint">{plain(about)}; {found.sampled:g} ps at every step</p>',
        section(f"Steps (fs) at which an average is off by {BIAS_LIMIT:.0%}", *steps),
        section(
            "Bias against the time step",
            wide(averages_figure(found), "averages", "biases over time steps"),
        ),
        section("All runs: biases, U in kT per degree of freedom", *all_runs),
        section("How to repeat it", code(command)),
    ]
    return page(f"{found.name}: bias of averages", parts)
