"""Report of `rigidmd accuracy`: a table, recommendations, accuracy.csv, .png and a self-contained page."""

from math import hypot
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.core.statistics import format_signed
from rigidmd.figures.style import FAINT, INK, curve_style, drawing, label_minor_ticks, open_axis, write_figure
from rigidmd.io.write import columns_text, write_csv
from rigidmd.run.pilot.trials import IntegratorAccuracy, ReachedError, Trial
from rigidmd.view.page import chips, code, items, page, section, table, wide

FILES = ("accuracy.csv", "accuracy.png", "accuracy.html", "accuracy_averages.csv")
#: Shorter titles, so that the table fits a terminal.
SHORT_TITLES = {"error of ": "", "energy drift in the span": "drift", " per ": "/", "seconds": "s", "spread (%)": "± %",
                "energy rms": "energy", "orthogonality error": "QᵀQ"}  # fmt: skip
#: Spread of repeated timings that causes a warning.
DOUBTFUL = 0.2
ESTIMATORS = {"": "on the steps", " half-step": "between the kicks", " unbiased": "unbiased"}


def trial_headers(found: IntegratorAccuracy) -> list[str]:
    s = found.trial_system
    per = "ps" if s.time_unit == "fs" else "s"
    return [
        "integrator", f"step ({s.time_unit})", f"forces per {per}", f"seconds per {per}", "spread (%)", "error of Q",
        f"error of X ({s.length_unit})", "energy rms", "energy drift in the span", "±",
        *(f"error of {name}" for name in _other_invariants(found)), "orthogonality error",
    ]  # fmt: skip


def _other_invariants(found: IntegratorAccuracy) -> list[str]:
    """Conserved quantities besides the energy."""
    return list(dict.fromkeys(name for trial in found.trials for name in trial.conserved_errors))


def trial_row(found: IntegratorAccuracy, trial: Trial) -> list:
    span, kept = found.trial_system.span, _other_invariants(found)
    if trial.diverged:
        return [trial.integrator, trial.timestep, trial.forces / span, "fails", *[None] * (7 + len(kept))]
    spread = None if trial.spread is None else 100 * trial.spread
    values = [
        trial.integrator, trial.timestep, trial.forces / span, trial.time / span, spread, trial.rotation_error,
        trial.position_error, trial.energy_rms, trial.energy_drift, trial.energy_drift_error,
        *(trial.conserved_errors.get(name) for name in kept), trial.orthogonality_error,
    ]  # fmt: skip
    return [None if isinstance(x, float) and np.isnan(x) else x for x in values]


def average_headers(found: IntegratorAccuracy) -> list[str]:
    titles = ["integrator", "step (fs)"]
    for name in ("T_trans", "T_rot", "T_rot - T_trans"):
        for estimator in ESTIMATORS.values():
            titles += [f"{name} {estimator} (K)", "±"]
    return [*titles, "potential (kJ/mol)", "±", "bias", "±", "pressure (bar)", "±", "bias", "±"]


def average_row(found: IntegratorAccuracy, trial: Trial) -> list:
    """A line of the averages; biases are relative to the trial with the smallest energy error."""
    seen, best = trial.averages, found.most_exact.averages
    values = [trial.integrator, trial.timestep]
    for name in ("T_trans", "T_rot", "T_rot - T_trans"):
        for kind in ESTIMATORS:
            values += seen.get(name + kind, (None, None))
    for name in ("potential", "pressure"):
        value, error = seen[name]
        values += [value, error]
        values += [None, None] if trial is found.most_exact else [value - best[name][0], hypot(error, best[name][1])]
    return values


def table_text(found: IntegratorAccuracy) -> str:
    titles = trial_headers(found)
    for long, short in SHORT_TITLES.items():
        titles = [title.replace(long, short) for title in titles]
    text = "errors of Q, X, the energy (rms, drift over the span) and other conserved quantities\n"
    text += _nonempty_columns([titles, *(trial_row(found, t) for t in found.trials)])
    if found.sampled and (sampled := [t for t in found.trials if t.averages]):
        rows = [brief_average_headers(), *(brief_average_row(found, t) for t in sampled)]
        text += f"\n\naverages over {found.sampled:g} ps\n" + _nonempty_columns(rows)
    return text


def brief_average_headers() -> list[str]:
    first, *others = ESTIMATORS.values()
    return ["integrator", "step (fs)", "T_trans (K)", f"T_rot - T_trans (K): {first}", *others, "bias of U (kJ/mol)",
            "bias of P (bar)"]  # fmt: skip


def brief_average_row(found: IntegratorAccuracy, trial: Trial) -> list[str | None]:
    """The averages that differ between steps."""
    seen, best = trial.averages, found.most_exact.averages
    cells: list[str | None] = [trial.integrator, f"{trial.timestep:.3g}", format_signed(*seen["T_trans"]).lstrip("+")]
    gaps = [seen.get(f"T_rot - T_trans{kind}") for kind in ESTIMATORS]
    cells += [gap and format_signed(*gap) for gap in gaps]
    for name in ("potential", "pressure"):
        (value, error), (right, its_error) = seen[name], best[name]
        cells.append(
            "(reference)" if trial is found.most_exact else format_signed(value - right, hypot(error, its_error))
        )
    return cells


def _nonempty_columns(rows: list[list]) -> str:
    """Rows as text in columns, without the columns that have no values."""
    lines = [[format_cell(cell) for cell in line] for line in rows]
    kept = [k for k in range(len(lines[0])) if any(line[k] not in ("", "-") for line in lines[1:])]
    return columns_text([[line[k] for k in kept] for line in lines])


def format_cell(cell) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    return f"{cell:.3g}" if 1e-3 <= abs(cell) < 1e5 or cell == 0 else f"{cell:.1e}"


def recommendations(found: IntegratorAccuracy) -> list[str]:
    """Sentences: the cheapest integrator for each accuracy, then the reference and the longest stable steps."""
    return [*describe_cheapest(found), *remarks(found)]


def remarks(found: IntegratorAccuracy) -> list[str]:
    """Sentences on the reference, the longest stable steps, what failed or was left out, and the timings."""
    s = found.trial_system
    lines = [
        f"unit of energy errors: {s.energy_unit}{s.energy_note}",
        f"reference: {s.reference} in {found.reference_steps} steps, error about {found.reference_error:.0e}",
    ]
    if s.rounding is not None:
        force, torque = s.rounding
        lines.append(
            f"mixed precision: forces differ from double ones by {force:.1e} of their rms"
            + (f", torques by {torque:.1e}" if torque else "")
            + "; the reference is in mixed precision too"
        )
    for name in dict.fromkeys(t.integrator for t in found.trials):
        failures = [t.failure for t in found.trials if t.integrator == name and t.failure]
        if "diverges" in failures:
            step = found.stable_step(name)
            lines.append(f"{name} diverges" + (f" beyond {step:.3g} {s.time_unit}" if step else " at every step tried"))
        lines += [f"{name}: {failure}" for failure in dict.fromkeys(failures) if failure != "diverges"][:1]
    for why in dict.fromkeys(found.left_out.values()):
        lines.append(f"left out: {', '.join(name for name in found.left_out if found.left_out[name] == why)}: {why}")
    lines += _describe_timings(found)
    if found.sampled:
        lines += _describe_temperatures(found)
    return lines


def _describe_timings(found: IntegratorAccuracy) -> list[str]:
    timed = [trial for trial in found.trials if not trial.diverged]
    if not timed:
        return []
    if timed[0].spread is None:
        return ["timed once: the spread of the seconds is unknown; see --repeats"]
    doubtful = [(spread, trial) for trial in timed if (spread := trial.spread) is not None and spread > DOUBTFUL]
    if not doubtful:
        return []
    spread, worst = max(doubtful, key=lambda pair: pair[0])
    which = f"{worst.integrator} at {worst.timestep:.3g} {found.trial_system.time_unit}"
    return [
        f"warning: repeated timings of {len(doubtful)} of {len(timed)} trials differ by more than {DOUBTFUL:.0%}, "
        f"those of {which} by {spread:.0%} (± % in the table): was another program running? An idle machine or "
        "more --repeats help"
    ]


def _describe_temperatures(found: IntegratorAccuracy) -> list[str]:
    """The effect of the longest step of velocity Verlet on the temperatures."""
    name = "T_rot - T_trans"
    verlet = [t for t in found.trials if f"{name} unbiased" in t.averages]
    if not verlet:
        return []
    longest = max(verlet, key=lambda t: t.timestep)
    on, unbiased = (format_signed(*longest.averages[name + kind]) for kind in ("", " unbiased"))
    return [
        f"velocity_verlet at {longest.timestep:.3g} fs: T_rot - T_trans is {on} K on the steps, {unbiased} unbiased"
    ]


class Cheapest(NamedTuple):
    """The integrator that reaches an error, or each of several errors, in the least run time."""

    error: str  # what error this is, with its unit
    target: float  # the largest
    integrator: str
    at: ReachedError
    common: str  # integrator to compare with; empty if it is the same or does not reach the target
    times_faster: float
    common_step: float
    rivals: tuple[tuple[str, ReachedError], ...]  # others, as fast within the spread of the timings


def cheapest(found: IntegratorAccuracy) -> list[Cheapest]:
    """The cheapest integrator for each error of the energy, and of Q or X; errors with the same one are joined."""
    s = found.trial_system
    rotates = any(not np.isnan(t.rotation_error) for t in found.trials)
    kinds = {
        "energy_rms": ("an energy error", s.energy_unit),
        "trajectory_error": ("an error of Q", "") if rotates else ("an error of X", s.length_unit),
    }
    names, common, lines = list(dict.fromkeys(t.integrator for t in found.trials)), "velocity_verlet", []
    for error, (what, unit) in kinds.items():
        worst = max((getattr(t, error) for t in found.trials if not t.diverged), default=0.0)
        same = None
        for target in 10.0 ** np.arange(0, -15, -2):
            reached = {name: at for name in names if (at := found.time_for(name, error, target))}
            blind = error == "trajectory_error" and target < 3 * found.reference_error
            if target > worst or len(reached) < 2 or blind:
                continue
            best = min(reached, key=lambda name: reached[name].seconds)
            at, other = reached.pop(best), reached.get(common)
            slow = at.seconds * (1 + at.spread / 2)
            rivals = tuple((name, r) for name, r in reached.items() if r.seconds * (1 - r.spread / 2) < slow)
            described = f"{what} of {target:.0e} {unit}".rstrip()
            faster, its_step = (other.seconds / at.seconds, other.step) if other else (0.0, 0.0)
            line = Cheapest(described, float(target), best, at, common if other else "", faster, its_step, rivals)
            if same is not None and line[2:] == same[2:]:
                described = f"{what} of {same.target:.0e} to {target:.0e} {unit}".rstrip()
                line = line._replace(error=described, target=same.target)
                lines.pop()
            lines.append(line)
            same = line
    return lines


def describe_cheapest(found: IntegratorAccuracy) -> list[str]:
    s, lines = found.trial_system, []
    per, unit = "ps" if s.time_unit == "fs" else "s", s.time_unit
    for c in cheapest(found):
        limit = f" ({c.at.limit})" if c.at.limit else ""
        line = f"for {c.error} over {s.span:g} {per} the cheapest is {c.integrator} at {c.at.step:.2g} {unit}{limit}"
        if c.common and c.common not in [name for name, _ in c.rivals]:
            line += f": {c.times_faster:.1f} times faster than {c.common} at {c.common_step:.2g} {unit}"
        if c.rivals:
            rivals = ", ".join(f"{name} at {at.step:.2g} {unit}" for name, at in c.rivals)
            line += f"; as fast within the spread of the timings: {rivals}"
        lines.append(line)
    if lines and s.time_unit == "fs":
        lines.append(
            f"energy errors grow over longer runs, by a random walk where forces are truncated: --span measures them "
            f"over more than {s.span:g} ps"
        )
    return lines


def write_accuracy(folder: Path, found: IntegratorAccuracy, command: str) -> list[Path]:
    write_csv(folder / FILES[0], [trial_headers(found), *(trial_row(found, trial) for trial in found.trials)])
    written: list[str] = list(FILES[:3])
    if sampled := [average_row(found, trial) for trial in found.trials if trial.averages]:
        written.append(FILES[3])
        write_csv(folder / FILES[3], [average_headers(found), *sampled])
    write_figure(folder / FILES[1], lambda: figure_of(found), f"{found.trial_system.name}: error against run time")
    with drawing(folder / FILES[2]) as temporary:
        temporary.write_text(accuracy_page(found, command), encoding="utf-8")
    return [folder / name for name in written if (folder / name).is_file()]


def _label_steps(axis, points: list[tuple[float, float, float]]) -> None:
    """Label points (time, error, step) in this order, each that is far enough from the one labelled before."""
    if not points:
        return
    (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
    size = np.array([np.log(right / left), np.log(high / low)])
    before = None
    for time, error, step in points:
        at = np.log([time, error]) / size
        if before is None or np.abs(at - before)[0] > 0.06 or np.abs(at - before)[1] > 0.04:
            axis.annotate(f"{step:.2g}", (time, error), xytext=(-6, -6), textcoords="offset points", fontsize=7,
                          color=INK, ha="right", va="top")  # fmt: skip
            before = at


def figure_of(found: IntegratorAccuracy):
    """Log error against log run time, a curve for each integrator; rings mark the best trials, bars the time spread."""
    from rigidmd.figures.picture import Picture

    s = found.trial_system
    per = "ps" if s.time_unit == "fs" else "s"
    figure = Picture(figsize=(10, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    rotates = any(not np.isnan(t.rotation_error) for t in found.trials)
    titles = {
        "trajectory_error": f"error of {'Q' if rotates else f'X ({s.length_unit})'} after {s.span:g} {per}",
        "energy_rms": f"rms error of the energy, {s.energy_unit}",
    }
    names = list(dict.fromkeys(t.integrator for t in found.trials))
    for axis, (error, title) in zip((left, right), titles.items(), strict=True):
        for k, name in enumerate(names):
            trials = [t for t in found.trials if t.integrator == name and not t.diverged and getattr(t, error) > 0]
            times, errors = [t.time / s.span for t in trials], [getattr(t, error) for t in trials]
            style = curve_style(k)
            axis.loglog(times, errors, ms=3.5, lw=1.2, label=name, **style)
            low, high = ([abs(end(t.seconds) - t.time) / s.span for t in trials] for end in (min, max))
            axis.errorbar(times, errors, xerr=[low, high], fmt="none", ecolor=style["color"], elinewidth=0.7)
        front = [t for t in found.front(error) if getattr(t, error) > 0]
        ring = {"ms": 9, "mfc": "none", "mec": INK, "mew": 0.8, "label": f"best, with its step ({s.time_unit})"}
        axis.loglog([t.time / s.span for t in front], [getattr(t, error) for t in front], "o", **ring)
        _label_steps(axis, [(t.time / s.span, getattr(t, error), t.timestep) for t in front])
        axis.set_title(title, loc="left", fontsize=9, color=INK)
        open_axis(axis, which="both")
        label_minor_ticks(axis.xaxis)
        label_minor_ticks(axis.yaxis)
    figure.supxlabel(f"computing time (s) per {per} of motion", color=INK, fontsize=10)
    left.axhline(found.reference_error, color=FAINT, lw=0.8, ls=":")
    left.annotate("error of the reference", (1, found.reference_error), xycoords=("axes fraction", "data"), fontsize=8,
                  color=FAINT, ha="right", va="bottom")  # fmt: skip
    right.legend(frameon=False, fontsize=8, handlelength=2.8, loc="center left", bbox_to_anchor=(1.0, 0.5),
                 labelcolor=INK)  # fmt: skip
    return figure


def accuracy_page(found: IntegratorAccuracy, command: str) -> str:
    names = list(dict.fromkeys(t.integrator for t in found.trials))
    colored = chips(names)
    unit = found.trial_system.time_unit
    rows = [
        [c.error, colored[c.integrator], f"{c.at.step:.2g}" + (f" ({c.at.limit})" if c.at.limit else ""),
         f"{c.at.seconds / found.trial_system.span:.2g}",
         f"{c.times_faster:.1f} (at {c.common_step:.2g})" if c.common else "",
         ", ".join(f"{name} at {at.step:.2g}" for name, at in c.rivals)]
        for c in cheapest(found)
    ]  # fmt: skip
    per = "ps" if unit == "fs" else "s"
    titles = [
        f"for, over {found.trial_system.span:g} {per}", "the cheapest is", f"at a step of ({unit})",
        f"seconds per {per}", "times faster than velocity_verlet", "as fast within the spread of the timings",
    ]  # fmt: skip
    trials = [[colored[t.integrator], *map(format_cell, trial_row(found, t)[1:])] for t in found.trials]
    parts = [
        section("Recommendations", table(titles, rows), items(remarks(found))),
        section("Error against run time", wide(figure_of(found), "accuracy", "log error over log run time")),
        section("All trials", table(trial_headers(found), trials)),
    ]
    if sampled := [trial for trial in found.trials if trial.averages]:
        lines = [[colored[t.integrator], *map(format_cell, brief_average_row(found, t)[1:])] for t in sampled]
        parts.append(section(f"Averages over {found.sampled:g} ps", table(brief_average_headers(), lines)))
    return page(
        f"{found.trial_system.name}: error against run time", [*parts, section("How to repeat it", code(command))]
    )
