"""`rigidmd accuracy`: the errors and run times of integrators at several time steps, from the start
of a scene. As a table, recommendations, accuracy.csv, .png and a self-contained page."""

from collections.abc import Callable, Iterator
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import cast

import numpy as np

from rigidmd.core.integrators import RADAU, SCHEMES
from rigidmd.errors import SceneError, option
from rigidmd.features.studies.accuracy.figure import accuracy_figure
from rigidmd.features.studies.accuracy.measurement import (
    DOUBTFUL,
    IntegratorAccuracy,
    measure,
    plan,
)
from rigidmd.features.studies.accuracy.orders import ENERGY, FLOOR_MARK, order_table, with_marks
from rigidmd.features.studies.accuracy.start import (
    check_engine_is_rigidmd,
    check_number_of_steps,
    check_times,
    start_of_last_stage,
)
from rigidmd.features.studies.kind_study import AccuracyStart, study_of
from rigidmd.features.view.figures.style import write_figure
from rigidmd.features.view.page import chips, code, items, section, table, wide, write_page
from rigidmd.io.write import Column, ReportTable
from rigidmd.run.force_errors import single_precision_errors
from rigidmd.run.trial_systems import (
    COMPARATORS,
    NOT_MOLECULAR,
    SPAN_PS,
    molecular_trial_system,
)
from rigidmd.run.trials import Trial
from rigidmd.scene import MolecularScene, Scene, is_molecular
from rigidmd.scene.validation import did_you_mean

#: Default integrators: velocity Verlet, the best of each kind, those of [[integrators]]; where they
#: suit also solvers.
DEFAULT_INTEGRATORS = (
    *(name for name, scheme in SCHEMES.items() if scheme.is_default),
    *(name for name, (solver, _) in COMPARATORS.items() if solver != RADAU),
)
#: Time steps per force evaluation, relative to the scene's; longer ones follow until one fails.
LADDER = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
AT_A_POLE = "the start has theta = 0 or 180 degrees, where Euler angles are singular"


def measure_accuracy(
    scene: Scene,
    integrators: list[str] | None = None,
    timesteps: list[float] | None = None,
    span: float | None = None,
    repeats: int = 3,
    progress: Callable[[float], object] = lambda fraction: None,
) -> IntegratorAccuracy:
    """Error against run time of integrators at time steps, on the start of a scene. Raises
    SceneError.

    integrators : names. Default: the scene's and those that suit it. The others are in `left_out`.
        rk4, dop853 and radau use the scene's formulation, or matrix. A suffix _matrix, _quaternion
        or _euler_angles sets another
    timesteps : fs for molecules, s for a body, the same for all. Default: steps of equal cost
        around the scene's
    span : ps or s
    progress : called with the fraction that is done. At 0, after all arguments have been checked

    Molecules start where the last stage starts, after the earlier stages have run. No thermostat
    acts.
    """
    check_engine_is_rigidmd(scene)
    known = (*scene.schemes, *COMPARATORS)
    integrators = list(dict.fromkeys(_method_name(name, scene) for name in integrators or []))
    if unknown := [name for name in integrators if name not in known]:
        of_all = f"(known: {', '.join(known)})"
        errors = [
            f"unknown integrator {name}{did_you_mean(name, known)} {of_all}" for name in unknown
        ]
        raise SceneError(option("integrators"), errors)
    lengths = [*(timesteps or []), *([] if span is None else [span])]
    check_times(scene, lengths, f"time steps and {option('span')}")
    if repeats < 1:
        raise SceneError("accuracy", [f"{option('repeats')} must be at least 1"])
    if is_molecular(scene) and (refused := [name for name in integrators if name in COMPARATORS]):
        reasons = [f"{name} does not suit this scene: {NOT_MOLECULAR}" for name in refused]
        raise SceneError(scene.source, reasons)
    progress(0.0)
    study = study_of(scene)
    if study:
        start = study.accuracy_start(scene, span)
    else:
        start = _molecular_start(cast(MolecularScene, scene), span)
    trial_system = start.trial_system
    if refused := [name for name in integrators if name not in trial_system.methods]:
        reasons = [
            f"{name} does not suit this scene: {trial_system.refused[name]}" for name in refused
        ]
        raise SceneError(scene.source, reasons)
    left_out = {}
    if not integrators:
        defaults = [name for name in DEFAULT_INTEGRATORS if study or name in SCHEMES]
        defaults += [row.name for row in scene.integrators]
        left_out = {name: why for name, why in trial_system.refused.items() if name in defaults}
        left_out |= {name: AT_A_POLE for name in trial_system.singular if name in defaults}
        candidates = dict.fromkeys((*defaults, _method_name(start.integrator, scene)))
        integrators = [
            name for name in candidates if name in trial_system.methods and name not in left_out
        ]
    steps = {
        name: (
            timesteps
            or [start.base * rung * trial_system.methods[name].force_evaluations for rung in LADDER]
        )
        for name in integrators
    }
    for step in [step for of_method in steps.values() for step in of_method]:
        check_number_of_steps(trial_system.span, step * trial_system.time_size)
    measured = measure(
        trial_system, plan(trial_system, steps), repeats, progress=progress, extend=not timesteps
    )
    measured.left_out = left_out
    return measured


def _molecular_start(scene: MolecularScene, span: float | None) -> AccuracyStart:
    """Molecules at the start of their last stage. Raises SceneError."""
    last = scene.stages[-1]
    if last.is_minimisation:
        what = "the last stage is a minimisation: accuracy needs another stage at the end"
        raise SceneError(scene.source, [what])
    simulation, state = start_of_last_stage(scene)
    trial_system = molecular_trial_system(simulation.system, state, last.rotor, span or SPAN_PS)
    trial_system.rounding = single_precision_errors(simulation.system, state)
    evaluations = last.row.force_evaluations if last.has_scheme else 1
    base = simulation.scene.stages[-1].step_fs / evaluations
    return AccuracyStart(trial_system, base, last.integrator)


def _method_name(name: str, scene: Scene) -> str:
    """The full name of a method, of a solver with the variables of the scene."""
    study = study_of(scene)
    return study.method_name(name, scene) if study else name


FILES = ("accuracy.csv", "accuracy.png", "accuracy.html")


def trial_table(measured: IntegratorAccuracy, *, marked: bool = False) -> ReportTable:
    """A row for each trial: its cost, the errors of Q, X, and of all conserved quantities.

    marked : whether errors at their floor have a mark
    """
    s = measured.trial_system
    per = s.span_unit

    def column(header: str, value: Callable[[Trial], float | None], short: str = "") -> Column:
        def known(trial: Trial) -> float | None:
            x = None if trial.diverged else value(trial)
            return None if x is None or np.isnan(x) else x

        return Column(header, known, short)

    def error(header: str, name: str, short: str) -> Column:
        plain = column(header, attrgetter(name), short)
        return with_marks(measured, name, plain) if marked else plain

    others = dict.fromkeys(name for trial in measured.trials for name in trial.conserved_errors)
    return ReportTable(
        [
            Column("integrator", lambda t: t.integrator),
            Column(f"step ({s.time_unit})", lambda t: t.timestep),
            Column(f"forces per {per}", lambda t: t.forces / s.span, f"forces/{per}"),
            Column(
                f"seconds per {per}",
                lambda t: "fails" if t.diverged else t.time / s.span,
                f"s/{per}",
            ),
            column("spread (%)", lambda t: t.spread and 100 * t.spread, "± %"),
            error("error of Q", "rotation_error", "Q"),
            error(f"error of X ({s.length_unit})", "position_error", f"X ({s.length_unit})"),
            error("energy rms", ENERGY, "energy"),
            column("energy drift in the span", lambda t: t.energy_drift, "drift"),
            column("±", lambda t: t.energy_drift_error),
            *(
                column(f"error of {name}", lambda t, name=name: t.conserved_errors.get(name), name)
                for name in others
            ),
            column("orthogonality error", lambda t: t.orthogonality_error, "QᵀQ"),
        ],
        measured.trials,
    )


def describe_accuracy(measured: IntegratorAccuracy, *, verbose: bool = False) -> list[str]:
    """The answer first: the fastest integrator for each error, measured orders, all trials, and
    remarks."""
    best = ReportTable(
        [
            Column("target error", lambda row: row[0].removeprefix("an ")),
            Column(
                "fastest integrator" if measured.is_timed else "fewest force evaluations",
                itemgetter(1),
            ),
            Column(f"compared with {COMMON}", lambda row: row[2].partition(f" than {COMMON}")[0]),
        ],
        cheapest(measured),
    )
    lines = [f"{measured.trial_system.name}, {_span(measured)}", ""]
    if best.rows:
        lines += [best.text(left=(0, 1, 2)), ""]
    lines += [order_table(measured).text(), "", trial_table(measured, marked=True).text()]
    lines.append(f"{FLOOR_MARK} at the floor: a shorter step does not reduce this error")
    return [*lines, "", *(recommendations(measured) if verbose else remarks(measured))]


def recommendations(measured: IntegratorAccuracy) -> list[str]:
    """Sentences on the cheapest integrator for each accuracy, and `remarks`."""
    s = measured.trial_system
    lines = []
    for error, best, faster, rivals in cheapest(measured):
        faster = f": {faster}" if faster else ""
        equal = "Equally fast within timing noise" if measured.is_timed else "As many"
        rivals = f". {equal}: {rivals}" if rivals else ""
        which = "the fastest is" if measured.is_timed else "the fewest force evaluations has"
        lines.append(f"for {error} over {_span(measured)} {which} {best}{faster}{rivals}")
    if lines and s.time_unit == "fs":
        lines.append(
            "energy errors grow over longer runs, by a random walk where forces are truncated:"
            f" --span measures them over more than {s.span:g} ps"
        )
    return [*lines, *remarks(measured)]


def _span(measured: IntegratorAccuracy) -> str:
    return f"{measured.trial_system.span:g} {measured.trial_system.span_unit}"


def remarks(measured: IntegratorAccuracy) -> list[str]:
    """Sentences on the reference, the longest stable steps, what failed or was omitted, and the
    timings."""
    s = measured.trial_system
    lines = [
        f"unit of energy errors: {s.energy_unit}{s.energy_note}",
        (
            f"reference: {s.reference} in {measured.reference_steps} steps, error about"
            f" {measured.reference_error:.0e}"
        ),
    ]
    if s.rounding is not None:
        force, torque = s.rounding
        torques = f", torques by {torque:.1e}" if torque else ""
        which = "the reference is in mixed precision too"
        if s.chooses_precision:
            which = (
                "trials with long steps have it, others and the reference are in double precision"
            )
        lines.append(
            f"mixed precision: forces differ from double ones by {force:.1e} of their rms{torques};"
            f" {which}"
        )
    for name in measured.integrators:
        failures = [t.failure for t in measured.trials if t.integrator == name and t.failure]
        if "diverges" in failures:
            bounded = measured.bounded(name)
            beyond = f"beyond {bounded[0].timestep:.3g} {s.time_unit}" if bounded else ""
            lines.append(f"{name} diverges {beyond or 'at every step tried'}")
        lines += [
            f"{name}: {failure}" for failure in dict.fromkeys(failures) if failure != "diverges"
        ][:1]
    for why in dict.fromkeys(measured.left_out.values()):
        names = ", ".join(name for name, reason in measured.left_out.items() if reason == why)
        lines.append(f"omitted: {names}: {why}")
    return lines + _describe_timings(measured)


def _describe_timings(measured: IntegratorAccuracy) -> list[str]:
    timed = [trial for trial in measured.trials if not trial.diverged]
    if timed and timed[0].spread is None:
        return ["timed once: the spread of the seconds is unknown; see --repeats"]
    doubtful = [
        (spread, trial)
        for trial in timed
        if (spread := trial.spread) is not None and spread > DOUBTFUL
    ]
    if not doubtful:
        return []
    spread, worst = max(doubtful, key=lambda pair: pair[0])
    which = f"{worst.integrator} at {worst.timestep:.3g} {measured.trial_system.time_unit}"
    ranked = "" if measured.is_timed else ". Force evaluations rank the integrators"
    return [
        f"warning: repeated timings of {len(doubtful)} of {len(timed)} trials differ by more than"
        f" {DOUBTFUL:.0%}, those of {which} by {spread:.0%} (± % in the table): was another program"
        f" running? An idle machine or more --repeats help{ranked}"
    ]


COMMON = "velocity_verlet"  # integrator to compare with


def cheapest(measured: IntegratorAccuracy) -> list[tuple[str, str, str, str]]:
    """For each error of the energy, and of Q or X: the cheapest integrator, how much faster than
    `COMMON` it is, others that are as fast. Errors with the same answer are one row. Where timings
    scatter too much, force evaluations rank the integrators."""
    s = measured.trial_system
    rows = []
    unit = s.time_unit
    # A motion of a body with the right energy is not advised if QᵀQ or another invariant is worse.
    energy = "energy_rms" if s.time_unit == "fs" else "conservation_error"
    kinds = {
        energy: ("an energy error", s.energy_unit),
        "trajectory_error": (
            ("an error of Q", "") if measured.rotates else ("an error of X", s.length_unit)
        ),
    }
    for error, (what, of) in kinds.items():
        worst = max((getattr(t, error) for t in measured.trials if not t.diverged), default=0.0)
        answers: dict[tuple[str, str, str], list[float]] = {}  # -> the targets that have it
        for target in 10.0 ** np.arange(0, -15, -2):
            reached = {
                name: at
                for name in measured.integrators
                if (at := measured.time_for(name, error, target))
            }
            blind = error == "trajectory_error" and target < 3 * measured.reference_error
            if target > worst or len(reached) < 2 or blind:
                continue
            costs = {name: measured.cost(at) for name, at in reached.items()}
            noise = {name: at.spread / 2 * measured.is_timed for name, at in reached.items()}
            best = min(costs, key=lambda name: costs[name])
            at, common = reached.pop(best), reached.get(COMMON)
            slow = costs[best] * (1 + noise[best])
            rivals = {
                name: r.step
                for name, r in reached.items()
                if costs[name] * (1 - noise[name]) < slow
            }
            chosen = f"{best} at {at.step:.2g} {unit}{f' ({at.limit})' if at.limit else ''}"
            faster = ""
            if common and COMMON not in rivals:
                gain = "times faster" if measured.is_timed else "times fewer"
                faster = (
                    f"{costs[COMMON] / costs[best]:.1f} {gain} than {COMMON} at {common.step:.2g}"
                    f" {unit}"
                )
            others = ", ".join(f"{name} at {step:.2g} {unit}" for name, step in rivals.items())
            answers.setdefault((chosen, faster, others), []).append(target)
        for answer, targets in answers.items():
            span = " to ".join(
                f"{target:.0e}" for target in dict.fromkeys((targets[0], targets[-1]))
            )
            rows.append((f"{what} of {span} {of}".rstrip(), *answer))
    return rows


def write_accuracy(folder: Path, measured: IntegratorAccuracy, command: str) -> None:
    trial_table(measured).write(folder / FILES[0])
    title = f"{measured.trial_system.name}: error against run time"
    write_figure(folder / FILES[1], lambda: accuracy_figure(measured, _span(measured)), title)
    write_page(folder / FILES[2], title, _page_parts(measured, command))


def _page_parts(measured: IntegratorAccuracy, command: str) -> Iterator[str]:
    colored = chips(measured.integrators)
    titles = [
        f"error over {_span(measured)}",
        "least run time" if measured.is_timed else "fewest force evaluations",
        "gain",
        "equally fast within timing noise" if measured.is_timed else "as many",
    ]
    advice = table(titles, cheapest(measured), words=True)
    drawn = wide(
        accuracy_figure(measured, _span(measured)), "accuracy", "log error over log run time"
    )
    yield section("Recommendations", advice, items(remarks(measured)))
    yield section("Error against run time", drawn)
    yield section("All trials", table(*trial_table(measured).shown(), marked=colored))
    yield section("How to repeat it", code(command))
