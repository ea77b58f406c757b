"""What `rigidmd precision` found: a table, a recommendation in words, precision.csv, .png and a page by itself."""

import base64
import csv
import html
from pathlib import Path

import numpy as np

from rigidmd.measure.precision import Precision, Trial
from rigidmd.output.folder import whole_file
from rigidmd.output.report import FAINT, INK

FILES = ("precision.csv", "precision.png", "precision.html")
COLORS = ("#2b6f9e", "#8fb4cf", "#c8553d", "#e2a08f", "#4f8a5b", "#9bbf9f", "#7a5ca3", "#b8862d", INK, FAINT)


def headers(found: Precision) -> list[str]:
    """Column titles of the table, units included."""
    s = found.subject
    per = "ps" if s.time_unit == "fs" else "s"
    return [
        "integrator", f"step ({s.time_unit})", f"forces per {per}", f"seconds per {per}", "spread (%)", "error of Q",
        f"error of X ({s.length_unit})", "energy rms", "energy drift in the span", "±", "orthogonality",
    ]  # fmt: skip


def row(found: Precision, trial: Trial) -> list:
    """A line of the table."""
    span = found.subject.span
    if trial.diverged:
        return [trial.integrator, trial.timestep, trial.forces / span, "diverges", *[None] * 7]
    spread = 100 * (max(trial.seconds) - min(trial.seconds)) / trial.time
    values = [
        trial.integrator, trial.timestep, trial.forces / span, trial.time / span, spread, trial.rotation_error,
        trial.position_error, trial.energy_rms, trial.energy_drift, trial.energy_drift_error, trial.orthogonality,
    ]  # fmt: skip
    return [None if isinstance(x, float) and np.isnan(x) else x for x in values]


def table_text(found: Precision) -> str:
    """The table as a person reads it."""
    lines = [[_short(cell) for cell in line] for line in (headers(found), *(row(found, t) for t in found.trials))]
    kept = [k for k in range(len(lines[0])) if any(line[k] not in ("", "-") for line in lines[1:])]
    widths = [max(len(line[k]) for line in lines) for k in kept]
    text = ["  ".join(line[k].ljust(w) if k == 0 else line[k].rjust(w) for k, w in zip(kept, widths, strict=True))
            for line in lines]  # fmt: skip
    return "\n".join(text)


def _short(cell) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    return f"{cell:.3g}" if 1e-3 <= abs(cell) < 1e5 or cell == 0 else f"{cell:.1e}"


def advice(found: Precision) -> list[str]:
    """Sentences: the reference, the longest stable steps, and the cheapest integrator for each accuracy."""
    s = found.subject
    lines = [
        f"unit of energy errors: {s.energy_unit}{s.energy_note}",
        f"reference: {s.reference} in {found.reference_steps} steps, its own error about {found.reference_error:.0e}",
    ]
    for name in dict.fromkeys(t.integrator for t in found.trials):
        own = [t for t in found.trials if t.integrator == name]
        if any(t.diverged for t in own):
            step = found.stable_step(name)
            lines.append(f"{name} diverges" + (f" beyond {step:.3g} {s.time_unit}" if step else " at every step tried"))
    lines += _cheapest(found, "energy_rms", "an energy error", s.energy_unit)
    what = "Q" if any(not np.isnan(t.rotation_error) for t in found.trials) else "X"
    lines += _cheapest(found, "trajectory_error", f"an error of {what}", "" if what == "Q" else s.length_unit)
    return lines


def _cheapest(found: Precision, error: str, what: str, unit: str) -> list[str]:
    names = list(dict.fromkeys(t.integrator for t in found.trials))
    lines, common = [], "velocity_verlet"
    worst = max((getattr(t, error) for t in found.trials if not t.diverged), default=0.0)
    for target in 10.0 ** np.arange(0, -15, -2):
        reached = {name: at for name in names if (at := found.time_for(name, error, target))}
        if target > worst or len(reached) < 2 or (error == "trajectory_error" and target < 3 * found.reference_error):
            continue
        best = min(reached, key=lambda name: reached[name][0])
        seconds, step = reached[best]
        line = f"for {what} of {target:.0e} {unit}".rstrip()
        line += f" the cheapest is {best} at {step:.2g} {found.subject.time_unit}"
        if common in reached and best != common:
            other, its_step = reached[common]
            line += f": {other / seconds:.1f} times faster than {common} at {its_step:.2g} {found.subject.time_unit}"
        lines.append(line)
    return lines


def write_precision(folder: Path, found: Precision, command: str) -> list[Path]:
    """All files; the paths written."""
    with whole_file(folder / FILES[0]) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(headers(found))
        writer.writerows(row(found, trial) for trial in found.trials)
    draw(folder / FILES[1], found)
    with whole_file(folder / FILES[2]) as temporary:
        temporary.write_text(page(found, (folder / FILES[1]).read_bytes(), command), encoding="utf-8")
    return [folder / name for name in FILES]


def draw(path: Path, found: Precision) -> None:
    """Log error against log run time, one curve an integrator, the front ringed."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    s = found.subject
    per = "ps" if s.time_unit == "fs" else "s"
    figure = Figure(figsize=(10, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    turning = any(not np.isnan(t.rotation_error) for t in found.trials)
    titles = {
        "trajectory_error": f"error of {'Q' if turning else f'X ({s.length_unit})'} after {s.span:g} {per}",
        "energy_rms": f"rms error of the energy, {s.energy_unit}",
    }
    names = list(dict.fromkeys(t.integrator for t in found.trials))
    for axis, (error, title) in zip((left, right), titles.items(), strict=True):
        for k, name in enumerate(names):
            own = [t for t in found.trials if t.integrator == name and not t.diverged and getattr(t, error) > 0]
            axis.loglog([t.time / s.span for t in own], [getattr(t, error) for t in own], "o-", ms=3.5, lw=1.2,
                        color=COLORS[k % len(COLORS)], label=name)  # fmt: skip
        front = found.front(error)
        ring = {"ms": 9, "mfc": "none", "mec": INK, "mew": 0.8, "label": "no other is faster and better"}
        axis.loglog([t.time / s.span for t in front], [getattr(t, error) for t in front], "o", **ring)
        axis.set_title(title, loc="left", fontsize=9, color=INK)
        axis.set_xlabel(f"seconds of computing per {per}")
        axis.spines[["top", "right"]].set_visible(False)
        axis.xaxis.set_minor_formatter(NullFormatter())
    left.axhline(found.reference_error, color=FAINT, lw=0.8, ls=":")
    left.annotate("error of the reference", (1, found.reference_error), xycoords=("axes fraction", "data"), fontsize=8,
                  color=FAINT, ha="right", va="bottom")  # fmt: skip
    right.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(f"{s.name}: error against run time", color=INK, x=0.01, ha="left", fontsize=11)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=150)


def page(found: Precision, picture: bytes, command: str) -> str:
    """A page that needs no other file."""
    cells = "".join(
        "<tr>" + "".join(f"<td>{html.escape(_short(cell))}</td>" for cell in row(found, trial)) + "</tr>\n"
        for trial in found.trials
    )
    head = "".join(f"<th>{html.escape(title)}</th>" for title in headers(found))
    words = "".join(f"<li>{html.escape(line)}</li>\n" for line in advice(found))
    name = html.escape(found.subject.name)
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{name}: error against run time</title>
<style>body{{font:15px/1.5 system-ui,sans-serif;color:{INK};max-width:1000px;margin:2em auto;padding:0 1em}}
img{{max-width:100%}}table{{border-collapse:collapse;font-size:13px}}td,th{{padding:2px 8px;text-align:right}}
td:first-child,th:first-child{{text-align:left}}tr:nth-child(even){{background:#f4f5f7}}code{{color:{FAINT}}}</style>
<h1>{name}: error against run time</h1>
<ul>
{words}</ul>
<img alt="log error against log run time" src="data:image/png;base64,{base64.b64encode(picture).decode()}">
<table><tr>{head}</tr>
{cells}</table>
<p><code>{html.escape(command)}</code></p></html>
"""
