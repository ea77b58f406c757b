"""The figures of a run: energy.png of molecules, and the figures of a single body."""

from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.core.statistics import format_signed
from rigidmd.engines.body_system import BodySystem
from rigidmd.engines.samples import Samples, moving
from rigidmd.figures.body import body_figures
from rigidmd.figures.style import COOL, FAINT, WARM, new_figure, shown_range, thin_series

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidmd.engines.system import System
    from rigidmd.figures.picture import Picture


def run_figures(
    system: "System | BodySystem", samples: Any, summary: dict[str, Any]
) -> "dict[str, Picture]":
    """The figures of a run by the names of their files, if there are enough samples."""
    if isinstance(system, BodySystem):
        return body_figures(system, samples)
    is_enough = moving(system.scene.stages, samples["stage"]).sum() > 1
    return {"energy": energy_figure(system, samples, summary)} if is_enough else {}


#: Mean width of a letter of a stage's name as a fraction of an axis of energy.png, and rows of
#: names at most.
LETTER_WIDTH, MOST_ROWS = 0.012, 5
#: Columns of the samples in energy.png.
DRAWN = ("time", "drift", "potential", "kinetic", "temperature_translation", "temperature_rotation")


def energy_figure(system: "System", samples: Samples, summary: dict) -> "Picture":
    """The drift of the conserved energy in each stage, on the scale of the last; energies and
    temperatures."""
    stages, n = system.scene.stages, len(system.model.species)
    shown = moving(stages, samples["stage"])
    column = {name: samples[name][shown] for name in DRAWN}
    time, stage = column["time"], samples["stage"][shown]
    # an external engine may not report it
    known = bool(np.isfinite(column["drift"][stage == stage[-1]]).any())
    figure = new_figure(8, 7, title=f"{system.scene.name}: {n} molecules")
    axes = figure.subplots(2 + known, 1, height_ratios=(1.2, 1, 1)[-2 - known :], sharex=True)
    *_, parts, temperature = axes
    if known:
        ended = summary["stages"][stage[-1] : stage[-1] + 1]  # none if the run has not ended
        _draw_drift(axes[0], time, column["drift"] / n, stage, ended[0] if ended else None)
    for name, color in (("potential", COOL), ("kinetic", WARM)):
        _draw(parts, time, (column[name] - column[name][-1]) / n, stage, color, name)
    parts.set_ylabel("energies less\ntheir last values\n(kJ/mol per molecule)")
    for label, color in (("translation", COOL), ("rotation", WARM)):
        if np.isfinite(values := column[f"temperature_{label}"]).all():
            _draw(temperature, time, values, stage, color, label)
    temperature.set_ylabel("temperature (K)")
    temperature.set_xlabel("time (ps)")
    starts = [float(time[stage == k][0]) for k in np.unique(stage)]
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0)
        axis.yaxis.label.set_fontsize(9)
        for start in starts:
            axis.axvline(start, color=FAINT, lw=0.6, ls=":")
        if axis.get_legend_handles_labels()[0]:
            axis.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9)
    for axis in (parts, temperature):
        _label_stages(axis, starts, [stages[k].label for k in np.unique(stage)])
    return figure


def _draw(
    axis: "Axes", time: np.ndarray, values: np.ndarray, stage: np.ndarray, color: str, label: str
) -> None:
    """Draw a curve, and widen the limits of the axis to its `shown_range`."""
    before = axis.get_ylim() if axis.lines else None
    axis.plot(*thin_series(time, values), color=color, lw=0.9, label=label)
    if (limits := shown_range(values, stage)) is not None:
        axis.set_ylim(min(limits[0], *(before or limits)), max(limits[1], *(before or limits)))


def _draw_drift(
    axis: "Axes", time: np.ndarray, drift: np.ndarray, stage: np.ndarray, summary: dict | None
) -> None:
    """Draw the conserved energy since each stage began, kJ/mol per molecule, and the line of the
    last drift, if there is a summary of its stage."""
    last = stage == stage[-1]
    for k in np.unique(stage):
        of_stage = stage == k
        axis.plot(
            *thin_series(time[of_stage], drift[of_stage]),
            color=COOL if of_stage[-1] else FAINT,
            lw=0.9,
        )
    low, high = np.nanmin(drift[last]), np.nanmax(drift[last])
    if high > low:
        axis.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
    axis.set_ylabel("conserved energy since\nthe stage began\n(kJ/mol per molecule)")
    if summary is None or last.sum() <= 2:
        return
    gradient, error = (
        summary["drift_kJ_mol_ns_per_molecule"],
        summary["drift_error_kJ_mol_ns_per_molecule"],
    )
    if gradient is not None:
        line = drift[last].mean() + gradient / 1000 * (time[last] - time[last].mean())
        axis.plot(time[last], line, color=WARM, lw=1.4)
        title = f"{summary['name']}: drift {format_signed(gradient, error)} kJ/mol/ns per molecule"
        if verdict := summary.get("drift_verdict"):
            title += f": {verdict.partition(',')[0]}"
        axis.set_title(title, loc="left", fontsize=9, color=WARM)


def _label_stages(axis: "Axes", starts: list[float], labels: list[str]) -> None:
    """Draw names of stages above the curves where they begin, each in the first free row."""
    left, right = axis.get_xlim()
    rows: list[float] = []  # where the last name of each row ends, as a fraction of the axis
    for start, label in zip(starts, labels, strict=True):
        at, long = (start - left) / ((right - left) or 1.0), 0.015 + LETTER_WIDTH * len(label)
        at_end = at > 0.5 and at + long > 1.0
        begin, end = (at - long, at) if at_end else (at, at + long)
        row = next((k for k, taken in enumerate(rows) if begin >= taken), len(rows))
        if row == MOST_ROWS:
            continue
        rows[row : row + 1] = [end]
        axis.annotate(
            label,
            (start, 1),
            xycoords=("data", "axes fraction"),
            xytext=(-4 if at_end else 4, -2 - 11 * row),
            textcoords="offset points",
            fontsize=9,
            color=FAINT,
            va="top",
            ha="right" if at_end else "left",
        )
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.09 * len(rows) * (high - low))
