"""What `rigidmd precision --averages` found: a table, sentences, precision.csv and .json, averages.png."""

import csv
import json
from itertools import groupby
from pathlib import Path

from rigidmd.core.files import whole_file
from rigidmd.measure.bias import SHARE, AverageRun, Averages, Quantity
from rigidmd.output.figure import FAINT, INK, curve_style, save_figure
from rigidmd.output.report import signed

FILES = ("precision.csv", "precision.json", "averages.png")


def _unit(quantity: Quantity) -> str:
    """Of its biases."""
    return quantity.bias_unit or quantity.unit


def _scale(quantity: Quantity) -> str:
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


def table_text(found: Averages) -> str:
    """The table as a person reads it: biases with their errors."""
    titles = ["method", "step (fs)", "forces/ps", "s/ns"]
    for quantity in found.quantities:
        unit = "kT" if quantity.name == "U" else _unit(quantity)
        titles.append(f"{quantity.name} ({unit})")
    lines = [titles]
    for run in found.runs:
        seconds = "-" if run.seconds_per_ns is None else f"{run.seconds_per_ns:.3g}"
        cells = [run.method, f"{run.timestep:g}", f"{run.forces_per_ps:.4g}", "fails" if run.fault else seconds]
        for quantity in found.quantities:
            bias = found.bias(run, quantity)
            cells.append(signed(*bias) if bias else "-")
        lines.append(cells)
    widths = [max(len(line[k]) for line in lines) for k in range(len(titles))]
    text = f"bias of averages over {found.sampled:g} ps of {found.stage} (U in kT per degree of freedom)\n"
    return text + "\n".join(
        "  ".join([line[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True))])
        for line in lines
    )


def advice(found: Averages) -> list[str]:
    """Sentences: what biases are held against, at which step each is 1 %, what failed."""
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
    for quantity in found.quantities:
        steps = [
            f"{method} {step:.2g} fs" if seen else f"{method} none seen, more than {step:.2g} fs"
            for method in dict.fromkeys(run.method for run in found.runs)
            if (at := found.off_at(method, quantity))
            for step, seen in [at]
        ]
        if steps:
            lines.append(f"{quantity.name} is off by {SHARE:.0%} of {_scale(quantity)} at: {'; '.join(steps)}")
    return lines + [f"{run.method} at {run.timestep:g} fs: {run.fault}" for run in found.runs if run.fault]


def write_averages(folder: Path, found: Averages, command: str) -> list[Path]:
    """All files; the paths written."""
    with whole_file(folder / FILES[0]) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(headers(found))
        writer.writerows(row(found, run) for run in found.runs)
    with whole_file(folder / FILES[1]) as temporary:
        temporary.write_text(json.dumps(as_data(found, command), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    draw(folder / FILES[2], found)
    return [folder / name for name in FILES]


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
    methods = dict.fromkeys(run.method for run in found.runs)
    off = {method: at for method in methods if (at := found.off_at(method, quantity))}
    return {
        "unit": quantity.unit,
        "bias_unit": _unit(quantity),
        "reference": fit.limit,
        "reference_error": fit.limit_error,
        "longest_step_in_fit_fs": fit.longest,
        "bias_told_of": found.allowed(quantity),
        "step_of_that_bias_fs": {method: {"step": step, "seen": seen} for method, (step, seen) in off.items()},
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


def draw(path: Path, found: Averages) -> None:
    """Bias against the step, a panel a quantity, with error bars and the 1 % lines."""
    from matplotlib.figure import Figure

    shown = [quantity for quantity in found.quantities if found.points(quantity)]
    columns = min(3, max(1, len(shown)))
    rows = max(1, -(-len(shown) // columns))
    figure = Figure(figsize=(3.7 * columns, 2.9 * rows + 0.9), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    methods = list(dict.fromkeys(run.method for run in found.runs))
    handles = {}
    for axis, quantity in zip(axes, shown, strict=False):
        axis.axhline(0, color=INK, lw=0.7)
        for side in (-1, 1):
            axis.axhline(side * found.allowed(quantity), color=FAINT, lw=0.8, ls=":")
        for method, runs in groupby(found.runs, key=lambda run: run.method):
            at = [(run.timestep, *bias) for run in runs if (bias := found.bias(run, quantity))]
            if at:
                steps, values, errors = zip(*at, strict=True)
                style = curve_style(methods.index(method))
                handles[method] = axis.errorbar(steps, values, errors, ms=3.5, lw=1.1, capsize=2, **style)
        axis.set_title(f"{quantity.name}, {_unit(quantity)}", loc="left", fontsize=9, color=INK)
        axis.set_xlim(left=0)
        axis.spines[["top", "right"]].set_visible(False)
        axis.annotate(f"{SHARE:.0%} of {_scale(quantity)}", (0.02, found.allowed(quantity)),
                      xycoords=("axes fraction", "data"), fontsize=7, color=FAINT, ha="left", va="bottom")  # fmt: skip
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    for axis in axes[max(0, len(shown) - columns) : len(shown)]:
        axis.set_xlabel("time step, fs")
    figure.legend(handles.values(), handles.keys(), frameon=False, fontsize=8, loc="outside lower left", ncols=2)
    figure.suptitle(f"{found.name}: bias of averages over {found.sampled:g} ps", color=INK, x=0.01, ha="left",
                    fontsize=11)  # fmt: skip
    with whole_file(path) as temporary:
        save_figure(figure, temporary, dpi=150)
