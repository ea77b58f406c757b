"""Report of `rigidmd accuracy`: a table, recommendations, accuracy.csv, .png and a self-contained page."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.figures.style import FAINT, INK, curve_style, label_minor_ticks, new_figure, open_axis, write_figure
from rigidmd.io.write import Column, Table
from rigidmd.run.pilot.trials import IntegratorAccuracy, ReachedError, Trial
from rigidmd.view.page import chips, code, items, page, section, table, wide, write_page

FILES = ("accuracy.csv", "accuracy.png", "accuracy.html")
DOUBTFUL = 0.2  # spread of repeated timings that causes a warning


def trial_table(found: IntegratorAccuracy) -> Table:
    """A row for each trial: its cost, the errors of Q, X, and of all conserved quantities."""
    s = found.trial_system
    per = "ps" if s.time_unit == "fs" else "s"

    def column(header: str, value: Callable[[Trial], float | None], short: str = "") -> Column:
        def known(trial: Trial) -> float | None:
            x = None if trial.diverged else value(trial)
            return None if x is None or np.isnan(x) else x

        return Column(header, known, short)

    others = dict.fromkeys(name for trial in found.trials for name in trial.conserved_errors)
    return Table([
        Column("integrator", lambda t: t.integrator),
        Column(f"step ({s.time_unit})", lambda t: t.timestep),
        Column(f"forces per {per}", lambda t: t.forces / s.span, f"forces/{per}"),
        Column(f"seconds per {per}", lambda t: "fails" if t.diverged else t.time / s.span, f"s/{per}"),
        column("spread (%)", lambda t: t.spread and 100 * t.spread, "± %"),
        column("error of Q", lambda t: t.rotation_error, "Q"),
        column(f"error of X ({s.length_unit})", lambda t: t.position_error, f"X ({s.length_unit})"),
        column("energy rms", lambda t: t.energy_rms, "energy"),
        column("energy drift in the span", lambda t: t.energy_drift, "drift"),
        column("±", lambda t: t.energy_drift_error),
        *(column(f"error of {name}", lambda t, name=name: t.conserved_errors.get(name), name) for name in others),
        column("orthogonality error", lambda t: t.orthogonality_error, "QᵀQ"),
    ], found.trials)  # fmt: skip


def table_text(found: IntegratorAccuracy) -> str:
    text = "errors of Q, X, the energy (rms, drift over the span) and other conserved quantities\n"
    return text + trial_table(found).text()


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
    return lines + _describe_timings(found)


def _describe_timings(found: IntegratorAccuracy) -> list[str]:
    timed = [trial for trial in found.trials if not trial.diverged]
    if timed and timed[0].spread is None:
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


COMMON = "velocity_verlet"  # integrator to compare with


class Cheapest(NamedTuple):
    """The integrator that reaches an error, or each of several errors, in the least run time."""

    error: str  # what error this is, with its unit
    target: float  # the largest
    integrator: str
    at: ReachedError
    common: ReachedError | None  # of `COMMON`; None if it is the cheapest or does not reach the target
    rivals: tuple[tuple[str, ReachedError], ...]  # others, as fast within the spread of the timings


def cheapest(found: IntegratorAccuracy) -> list[Cheapest]:
    """The cheapest integrator for each error of the energy, and of Q or X; errors with the same one are joined."""
    s = found.trial_system
    rotates = any(not np.isnan(t.rotation_error) for t in found.trials)
    kinds = {
        "energy_rms": ("an energy error", s.energy_unit),
        "trajectory_error": ("an error of Q", "") if rotates else ("an error of X", s.length_unit),
    }
    names, lines = list(dict.fromkeys(t.integrator for t in found.trials)), []
    for error, (what, unit) in kinds.items():
        worst = max((getattr(t, error) for t in found.trials if not t.diverged), default=0.0)
        same = None
        for target in 10.0 ** np.arange(0, -15, -2):
            reached = {name: at for name in names if (at := found.time_for(name, error, target))}
            blind = error == "trajectory_error" and target < 3 * found.reference_error
            if target > worst or len(reached) < 2 or blind:
                continue
            best = min(reached, key=lambda name: reached[name].seconds)
            at, common = reached.pop(best), reached.get(COMMON)
            slow = at.seconds * (1 + at.spread / 2)
            rivals = tuple((name, r) for name, r in reached.items() if r.seconds * (1 - r.spread / 2) < slow)
            described = f"{what} of {target:.0e} {unit}".rstrip()
            line = Cheapest(described, float(target), best, at, common, rivals)
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
        if c.common and COMMON not in [name for name, _ in c.rivals]:
            line += f": {c.common.seconds / c.at.seconds:.1f} times faster than {COMMON} at {c.common.step:.2g} {unit}"
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
    trial_table(found).write(folder / FILES[0])
    title = f"{found.trial_system.name}: error against run time"
    write_figure(folder / FILES[1], lambda: accuracy_figure(found), title)
    write_page(folder / FILES[2], lambda: accuracy_page(found, command))
    return [folder / name for name in FILES if (folder / name).is_file()]


def _label_steps(axis, points: list[tuple[float, float, float]]) -> None:
    """Label points (time, error, step) in this order, each that is far enough from the one labelled before."""
    (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
    size = np.array([np.log(right / left), np.log(high / low)])
    before = np.full(2, np.inf)
    for time, error, step in points:
        at = np.log([time, error]) / size
        if (np.abs(at - before) > [0.06, 0.04]).any():
            axis.annotate(f"{step:.2g}", (time, error), xytext=(-6, -6), textcoords="offset points", fontsize=7,
                          color=INK, ha="right", va="top")  # fmt: skip
            before = at


def accuracy_figure(found: IntegratorAccuracy):
    """Log error against log run time, a curve for each integrator; rings mark the best trials, bars the time spread."""
    s = found.trial_system
    per = "ps" if s.time_unit == "fs" else "s"
    figure = new_figure(10, 4.8)
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
    colored = chips(list(dict.fromkeys(t.integrator for t in found.trials)))
    unit = found.trial_system.time_unit
    rows = [
        [c.error, colored[c.integrator], f"{c.at.step:.2g}" + (f" ({c.at.limit})" if c.at.limit else ""),
         f"{c.at.seconds / found.trial_system.span:.2g}",
         f"{c.common.seconds / c.at.seconds:.1f} (at {c.common.step:.2g})" if c.common else "",
         ", ".join(f"{name} at {at.step:.2g}" for name, at in c.rivals)]
        for c in cheapest(found)
    ]  # fmt: skip
    per = "ps" if unit == "fs" else "s"
    titles = [
        f"for, over {found.trial_system.span:g} {per}", "the cheapest is", f"at a step of ({unit})",
        f"seconds per {per}", "times faster than velocity_verlet", "as fast within the spread of the timings",
    ]  # fmt: skip
    parts = [
        section("Recommendations", table(titles, rows), items(remarks(found))),
        section("Error against run time", wide(accuracy_figure(found), "accuracy", "log error over log run time")),
        section("All trials", table(*trial_table(found).shown(), marked=colored)),
        section("How to repeat it", code(command)),
    ]
    return page(f"{found.trial_system.name}: error against run time", parts)
