"""The figure of errors against run time of integrators."""

from typing import TYPE_CHECKING

import numpy as np

from rigidmd.features.studies.accuracy.measurement import DOUBTFUL, IntegratorAccuracy
from rigidmd.features.view.figures.style import (
    DASHES,
    FAINT,
    INK,
    TEXT,
    TITLE,
    curve_style,
    label_ticks,
    new_figure,
    open_axis,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidmd.features.view.figures.picture import Picture

LABEL = (0.14, 0.045)  # width and height of the label of a step, as fractions of an axis


def _label_steps(axis: "Axes", points: list[tuple[float, float, float]], unit: str) -> None:
    """Label points (cost, error, step) in this order, each that is far enough from those labelled
    before."""
    left, right = axis.get_xlim()
    left *= (left / right) ** LABEL[0]  # space for the label of the first point
    axis.set_xlim(left, right)
    low, high = axis.get_ylim()
    size = np.array([np.log(right / left), np.log(high / low)])
    labelled = np.empty((0, 2))
    for cost, error, step in points:
        at = np.log([cost, error]) / size
        if (np.abs(at - labelled) > LABEL).any(axis=1).all():
            axis.annotate(
                f"{step:.2g} {unit}",
                (cost, error),
                xytext=(-6, -6),
                textcoords="offset points",
                fontsize=TEXT,
                color=INK,
                ha="right",
                va="top",
            )
            labelled = np.vstack([labelled, at])


def accuracy_figure(measured: IntegratorAccuracy, span: str) -> "Picture":
    """Log error against log run time, or force evaluations where timings scatter too much, a curve
    for each integrator in the order of its steps. Rings mark the best trials, bars the time spread.
    span : of a trial, as text"""
    s = measured.trial_system
    figure = new_figure(9, 4.2)
    left, right = figure.subplots(1, 2)
    of = "Q" if measured.rotates else f"X ({s.length_unit})"
    labels = {
        "trajectory_error": f"error of {of} after {span}",
        "energy_rms": f"rms energy error{_of_energy(s.energy_unit)}",
    }
    for axis, (error, label) in zip((left, right), labels.items(), strict=True):
        for k, name in enumerate(measured.integrators):
            _draw_trials(axis, measured, name, error, k)
        front = [t for t in measured.front(error) if getattr(t, error) > 0]
        points = [(measured.cost(t) / s.span, getattr(t, error), t.timestep) for t in front]
        axis.loglog(
            [cost for cost, *_ in points],
            [error for _, error, _ in points],
            "o",
            ms=9,
            mfc="none",
            mec=INK,
            mew=0.8,
            label=f"{'fastest' if measured.is_timed else 'cheapest'}, with its step",
        )
        _label_steps(axis, points, s.time_unit)
        axis.set_ylabel(label, fontsize=TITLE, color=INK)
        open_axis(axis, which="both")
        label_ticks(axis.xaxis)
        label_ticks(axis.yaxis)
    cost = "run time (s)" if measured.is_timed else "force evaluations"
    figure.supxlabel(f"{cost} per {s.span_unit} of motion", color=INK, fontsize=TITLE)
    left.axhline(measured.reference_error, color=FAINT, lw=0.8, ls=":")
    left.annotate(
        "error of the reference",
        (0.01, measured.reference_error),
        xycoords=("axes fraction", "data"),
        fontsize=TEXT,
        color=FAINT,
        va="bottom",
    )
    right.legend(
        frameon=False,
        fontsize=TEXT,
        handlelength=2.8,
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        labelcolor=INK,
    )
    return figure


def _of_energy(unit: str) -> str:
    """The unit of energy errors after their name."""
    size = unit.removeprefix("times the ")
    return f" ({unit})" if size == unit else f" / {size}"


def _draw_trials(
    axis: "Axes", measured: IntegratorAccuracy, integrator: str, error: str, k: int
) -> None:
    """Draw the curve of an integrator, dashed next to trials whose timings scatter."""
    trials, span = measured.bounded(integrator, error), measured.trial_system.span
    is_timed = measured.is_timed
    costs = np.array([measured.cost(t) / span for t in trials])
    errors = np.array([getattr(t, error) for t in trials])
    style = curve_style(k)
    uncertain = np.array([is_timed and (t.spread or 0.0) > DOUBTFUL for t in trials], bool)
    is_dashed = uncertain[1:] | uncertain[:-1]  # between neighbouring trials
    label = integrator if trials else None
    solid, dashed = (
        [np.insert(values, 1 + np.flatnonzero(omitted), np.nan) for values in (costs, errors)]
        for omitted in (is_dashed, ~is_dashed)
    )
    axis.loglog(*solid, ms=3.5, lw=1.2, label=label, **style)
    axis.loglog(*dashed, lw=1.2, color=style["color"], ls=(0, DASHES[1]))
    if is_timed and trials:
        bars = [[abs(end(t.seconds) - t.time) / span for t in trials] for end in (min, max)]
        axis.errorbar(costs, errors, xerr=bars, fmt="none", ecolor=style["color"], elinewidth=0.7)
