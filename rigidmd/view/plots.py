"""Plots of the columns of a run against its time, as small figures for a page, which a film can put a cursor on."""

from typing import NamedTuple

import numpy as np

from rigidmd.figures.style import COOL, FAINT, INK, WARM, bare_axis, shown_range, thin_series
from rigidmd.run.record import Record
from rigidmd.view.page import figure as figure_part

#: Inches: narrow, so that its letters can be read on a phone.
WIDTH, HEIGHT = 4.4, 2.3
COLORS = (COOL, WARM, "#4f8a5b", "#7a5ca3", "#b8862d")
#: Errors of exactly zero are drawn here.
FLOOR = 1e-17


class Panel(NamedTuple):
    """Curves on one axis: a title with the unit, (label, values) each; logarithmic or not."""

    title: str
    curves: list[tuple[str, np.ndarray]]
    log: bool = False


def panels(record: Record) -> list[Panel]:
    """The plots of a run."""
    found = _of_body(record) if record.is_body else _of_molecules(record)
    return [panel for panel in found if panel.curves]


def _of_molecules(record: Record) -> list[Panel]:
    seen, n, shown = record.columns, len(record.molecules.model.species), record.moving

    def curves(*names: tuple[str, str], per: int = 1) -> list[tuple[str, np.ndarray]]:
        return [
            (label, seen[name] / per) for name, label in names if name in seen and np.isfinite(seen[name][shown]).any()
        ]

    found = [
        Panel(
            "temperature (K)",
            curves(("temperature_translation", "translation"), ("temperature_rotation", "rotation")),
        ),
        Panel("potential energy (kJ/mol per molecule)", curves(("potential", ""), per=n)),
        Panel("drift of the conserved energy in a stage (kJ/mol per molecule)", curves(("drift", ""), per=n)),
        Panel("pressure (bar)", curves(("pressure_bar", ""))),
    ]
    if "density" in seen and np.ptp(np.nan_to_num(seen["density"])) > 0:
        found.append(Panel("density (g/cm³)", curves(("density", ""))))
        found.append(Panel("edges of the box (Å)", curves(("a", "a"), ("b", "b"), ("c", "c"))))
    return found


def _of_body(record: Record) -> list[Panel]:
    seen = record.columns
    found = []
    if "theta" in seen:
        found.append(Panel("θ (°)", [("", np.degrees(seen["theta"]))]))
        angles = [(name, np.unwrap(seen[key])) for name, key in (("φ", "phi"), ("ψ", "psi"))]
        in_turns = max(np.ptp(values) for _, values in angles) > 2 * np.pi
        unit, size = ("turns", 2 * np.pi) if in_turns else ("°", np.pi / 180)
        found.append(Panel(f"φ and ψ ({unit})", [(name, values / size) for name, values in angles]))
        omega = [("₁₂₃"[k], seen[f"omega_body_{k + 1}"]) for k in range(3)]
        found.append(Panel("ω along the body's axes (rad/s)", [(f"ω{k}", values) for k, values in omega]))
    if "x" in seen and any(np.ptp(seen[k]) > 0 for k in "xyz") and record.body.flies:
        found.append(Panel("centre of mass (m)", [(k, seen[k]) for k in "xyz"]))
    parts = [(name, seen[name]) for name in ("kinetic", "potential", "energy") if name in seen]
    found.append(Panel("energies (J)", parts))
    errors = [
        (name.removesuffix("_error"), np.maximum(np.abs(values), FLOOR))
        for name, values in seen.items()
        if name.endswith("_error") and np.isfinite(values).any()
    ]
    found.append(Panel(f"relative errors of what is conserved (0 is drawn at {FLOOR:.0e})", errors, log=True))
    return found


def draw(record: Record) -> str:
    """All plots as HTML. Each tells the film where its axis lies: data-left and data-right as shares of its width,
    data-from and data-to in the run's time."""
    return f'<div class="plots">{"".join(_draw(record, k, panel) for k, panel in enumerate(panels(record)))}</div>'


def _draw(record: Record, k: int, panel: Panel) -> str:
    from rigidmd.figures.picture import Picture

    figure = Picture(figsize=(WIDTH, HEIGHT), layout="constrained")
    axis = figure.subplots()
    draw_panel(axis, record, panel)
    axis.set_title(panel.title, loc="left", fontsize=9, color=INK)
    axis.set_xlabel(f"time ({record.time_unit})", fontsize=8, color=INK)
    svg = figure_part(figure, f"panel{k}", panel.title)
    place = axis.get_position()
    left, right = axis.get_xlim()
    where = f'data-left="{place.x0:.5f}" data-right="{place.x1:.5f}" data-from="{left:.9g}" data-to="{right:.9g}"'
    return f"<figure {where}>{svg}</figure>"


def draw_panel(axis, record: Record, panel: Panel) -> None:
    """Draw the curves of a panel where time passes, with the beginnings of stages."""
    shown, ranges = record.moving, []
    time, stages = record.time[shown], record.columns.get("stage", np.zeros(len(shown)))[shown]
    for color, (label, values) in zip(COLORS * len(panel.curves), panel.curves, strict=False):
        axis.plot(*thin_series(time, values[shown], 600), color=color, lw=0.9, label=label or None)
        ranges.append(None if panel.log or record.is_body else shown_range(values[shown], stages))
    if panel.log:
        axis.set_yscale("log")
    else:
        axis.ticklabel_format(axis="y", useOffset=False)
    if None not in ranges:
        axis.set_ylim(min(low for low, _ in ranges), max(high for _, high in ranges))
    for k in np.flatnonzero(stages[1:] != stages[:-1]):
        axis.axvline(time[k], color=FAINT, lw=0.6, ls=":")
    axis.margins(x=0)
    bare_axis(axis, labelsize=8)
    if len(panel.curves) > 1:
        axis.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.02), handlelength=1.2,
                    borderaxespad=0.2, labelcolor=INK)  # fmt: skip
