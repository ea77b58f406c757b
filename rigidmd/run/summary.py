"""The summary of a run of molecules: one dictionary with units in its keys, and its notes."""

from collections import Counter
from collections.abc import Iterable
from math import hypot, isnan, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.quantities import MOTIONS, QUANTITIES, Mean, Quantity, with_means
from rigidmd.core.state import REMOVED, State
from rigidmd.core.statistics import ENERGY_ERROR, format_with_error, mean_and_error, slope
from rigidmd.core.toml import Json
from rigidmd.engines.samples import (
    LEAST_SAMPLES,
    Sample,
    Samples,
    describe_equilibrated,
    equilibrated,
)
from rigidmd.engines.system import System
from rigidmd.features import providers
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, BOLTZMANN, COULOMB, FEMTOSECOND, KJ_PER_MOL

if TYPE_CHECKING:
    from rigidmd.run.molecular import MolecularRecord

#: The second half of a stage has notes if it has enough samples, on effects larger than some
#: standard errors. A drift is significant from there on: in random walks of the energy its errors
#: are up to 1.5 times too small (`slope`).
MIN_SAMPLES, STANDARD_ERRORS = 20, 4.0
#: Drift of the conserved energy per degree of freedom, kT/ns, and its sum over the time, kT.
DRIFT_LIMIT, DRIFT_SUM_LIMIT = 0.1, 1e-3
#: Smallest fraction of accepted trajectories without a note.
LEAST_ACCEPTANCE = 0.2
#: Largest error of the temperature by the step, and difference of T_trans and T_rot, without a
#: note, as fractions of the temperature.
HEATING_LIMIT, DIFFERENCE_LIMIT = 0.01, 0.01
#: Largest fraction of T_trans in a common drift of all molecules without a note. Where the total
#: momentum is thermal: its largest kinetic energy in kT, which one run in two million exceeds.
COMMON_DRIFT_LIMIT, THERMAL_LIMIT = 1e-4, 16.0
#: Growth of the estimated error of Coulomb forces that has a note.
ERROR_GROWTH_LIMIT = 1.5


class Minimum(NamedTuple):
    """The result of a minimisation; u, Å, ps."""

    converged: bool
    ended_by: str  # reason for its end if it has not converged, else empty
    iterations: int
    overlap_steps: int  # of steepest descent that removed overlaps before the iterations
    energy_before: float  # potential energy at the start
    energy_after: float  # at the end
    force: float  # largest force on a molecule that is not frozen
    torque: float  # largest torque about a principal axis
    #: Six, by `barostats.COMPONENTS`, without the kinetic part; None without a box
    pressure: tuple[float, ...] | None
    #: Largest deviation from the requested pressure; None if the cell does not relax
    deviation: float | None
    precision: str = "double"  # of the last forces


def summarise(
    system: System,
    record: "MolecularRecord",
    samples: Samples,
    state: State,
    preparing: float,
    wall: float,
    *,
    interrupted: bool,
) -> dict:
    """The summary of a run of molecules, without its `provenance`. Seconds as in
    `RunPart.summary`."""
    scene = system.scene
    minima = record.minima
    computing = record.position.computing
    last = samples.row(-1)
    # sum of |m v|
    size = float(system.model.mass[system.model.species] @ np.linalg.norm(state.velocity, axis=1))
    moving = [k for k in range(len(computing)) if k not in minima]
    stages = []
    for k in np.unique(samples["stage"]).tolist():
        if k in minima:
            values = _minimised(system, samples, k, computing[k], minima[k])
        else:
            values = stage_summary(system, samples, k, computing[k], record.moves.get(k, (0, 0)))
        stable = record.stable[k] / FEMTOSECOND if k in record.stable else None
        choice = _choice(system, samples.of_stage(k), k, record.choices.get(k))
        stages.append(values | {"choice": choice, "stable_timestep_fs": stable})
    removed = None
    interval = system.removes_momentum_every
    if interval is not None:
        removed = {
            "interval_ps": interval,
            "energy_kJ_mol": -float(state.energy_ledger[REMOVED]) / KJ_PER_MOL,
        }
    return {
        "interrupted": interrupted,
        "molecules": len(system.model.species),
        "species": (
            {m.name: 0 for m in system.species}
            | Counter(system.species[k].name for k in system.model.species)
        ),
        "sites": system.site_count,
        "degrees_of_freedom": system.last_freedom.total,
        "degrees_of_freedom_translation": system.last_freedom.translation,
        "degrees_of_freedom_rotation": system.last_freedom.rotation,
        "box_A": list(system.space) if system.density else None,
        "density_g_cm3": system.density or None,
        "cutoff_A": system.cutoff if np.isfinite(system.cutoff) else None,
        "positions": scene.output.positions if scene.output.trajectory and system.density else None,
        "precision_reason": (
            f"{system.precision}: {record.precision_reason}" if record.precision_reason else None
        ),
        "overlap_removal_steps": record.removal.steps if record.removal else 0,
        "preparing_s": preparing,
        "wall_s": wall,
        "largest_orthogonality_error": float(samples["orthogonality_error"].max()),
        "momentum_u_A_ps": last.momentum,
        "momentum_relative": last.momentum / size if size else 0.0,
        "momentum_conserved": [
            axis for axis, keeps in zip("xyz", system.model.keeps_momentum, strict=True) if keeps
        ],
        "user_forces": dict(system.user_terms),
        "forces_by_python": {
            name: [f.calls, f.seconds] for name, f in system.python_forces.items()
        },
        "momentum_removed": removed,
        "stages": stages,
        "notes": [
            *system.notes,
            *_common_drift_notes(system, state, last),
            *ewald_error_notes(system, state),
            *(note for k in moving for note in _notes_on_averages(system, samples, k)),
            *record.notes,
        ],
    }


def _choice(system: System, samples: Samples, k: int, text: str | None) -> str | None:
    """The text of the choice for a stage. Where it was for an error of the energy, also the error
    that was reached."""
    thermal = (
        BOLTZMANN
        / KJ_PER_MOL
        * (mean_and_error(samples["temperature"])[0] or 0.0)
        * system.freedom_in(k).total
    )
    if text is None or ENERGY_ERROR not in text or len(samples) < 2 or thermal == 0:
        return text
    rms = float(np.sqrt(np.mean(samples["drift"] ** 2))) / thermal
    time = samples["time"]
    return f"{text}. In the {time[-1] - time[0]:.4g} ps that ran it was {rms:.1e}"


def _common_drift_notes(system: System, state: State, last: Sample) -> list[str]:
    """A note if the molecules drift together: if a conserved momentum, whose degrees of freedom are
    not counted, adds to the temperatures, or if one that is not conserved exceeds a thermal one."""
    if not system.freedom.translation or not last.temperature_translation > 0:
        return []
    mass = system.model.mass[system.model.species]
    momentum = float(np.linalg.norm((mass @ state.velocity)[system.model.keeps_momentum]))
    together = f"the molecules drift together with |P| = {momentum:.3g} u Å/ps"
    energy = momentum**2 / (2 * float(mass.sum()) * BOLTZMANN)  # K
    if not system.keeps_momentum_in(last.stage):
        if energy <= THERMAL_LIMIT * last.temperature_translation:
            return []
        usual = sqrt(3 * float(mass.sum()) * BOLTZMANN * last.temperature_translation)
        return [
            f"{together}, where thermal motion has {usual:.3g}: the thermostat has not stopped it"
            " yet. Run longer"
        ]
    gain = 2 * energy / system.freedom.translation
    if gain <= COMMON_DRIFT_LIMIT * last.temperature_translation:
        return []
    remedy = "run.remove_momentum_interval_ps removes the total momentum"
    return [f"{together}, which adds {gain:.2g} K to T_trans; {remedy}"]


def ewald_error_notes(system: System, state: State) -> list[str]:
    """A note if the box has grown or shrunk until the k-vectors or grid of the start miss the
    accuracy of the scene."""
    if system.force_error is None or not any(stage.changes_box for stage in system.scene.stages):
        return []
    from rigidmd.run.force_errors import estimated_error  # SciPy is for such runs only

    now = estimated_error(system, state.cell)
    if now <= ERROR_GROWTH_LIMIT * system.force_error:
        return []
    before, after = (f"{error / COULOMB:.2g}" for error in (system.force_error, now))
    return [
        f"the box has changed, and with it the estimated error of Coulomb forces, from {before} to"
        f" {after} e²/Å²: alpha, k-vectors and grid are still from the start. A run with"
        " structure.file = 'final.npz' chooses new ones"
    ]


def _notes_on_averages(system: System, samples: Samples, k: int) -> list[str]:
    """Notes if the averages of stage k may be wrong: if energy drifts, or temperatures change by
    the step or differ.

    A thermostat hides the energy that a long step adds: it removes this energy, faster from some
    motions than from others, and by the temperatures at the steps, which are not the temperatures
    of the ensemble.
    """
    of_stage = samples.of_stage(k)
    if system.scene.stages[k].in_trajectories:  # its averages have no time-step error
        return _notes_on_trajectories(system.scene.stages[k], k, of_stage["acceptance"])
    half = len(of_stage) // 2
    if len(of_stage) - half < MIN_SAMPLES:
        return []
    time, drift, temperature = (of_stage[name][half:] for name in ("time", "drift", "temperature"))
    notes = []
    stage = system.scene.stages[k]
    freedom = system.freedom_in(k)
    level = float(temperature.mean())
    line = slope(time, drift)
    thermal = BOLTZMANN / KJ_PER_MOL * level * freedom.total
    of_heat, uncertain = drift_of_thermostats(system, of_stage, k)
    allowed = _drift_limit(time[-1] - time[0]) * thermal
    if thermal > 0 and abs(line.value - of_heat) > allowed + STANDARD_ERRORS * hypot(
        line.error, uncertain
    ):
        rate, error = (value * 1000 / thermal for value in (line.value, line.error))
        if system.scene.forces.truncation == "smooth_switch":
            smooth = ""
        else:
            smooth = " or truncation = 'smooth_switch'"
        if stage.has_thermostat:
            hides = ". The thermostat hides this and leaves temperatures wrong"
        else:
            hides = ""
        notes.append(
            f"stages.{k}: in its second half the conserved energy drifts by {rate:+.2g} ±"
            f" {error:.1g} kT/ns per degree of freedom, as from a step that is too long or forces"
            f" that jump at the cutoff{hides}. Try a shorter timestep_fs than"
            f" {stage.step_fs:g}{smooth}"
        )
    if not stage.has_thermostat:
        return notes
    from rigidmd.assemble.build import integrator_of_stage  # not for single bodies

    scheme = integrator_of_stage(system, k)
    if scheme.kinetic_correction == 0 and not stage.in_trajectories:
        squares = (of_stage["force_squares"] + of_stage["torque_squares"])[half:]
        step = stage.step
        per_square = 2 * scheme.shadow_correction * step**2 * KJ_PER_MOL / BOLTZMANN
        notes += _note_on_heating(stage, k, temperature, per_square / freedom.total * squares)
    moving, rotating = (of_stage[f"temperature_{motion}"][half:] for motion in MOTIONS)
    gap, error = mean_and_error(moving - rotating)
    if (
        gap is not None
        and error is not None
        and abs(gap) > max(DIFFERENCE_LIMIT * level, STANDARD_ERRORS * error)
    ):
        notes.append(
            f"stages.{k}: in its second half T_trans is {moving.mean():.4g} K and T_rot"
            f" {rotating.mean():.4g} K, a difference of {abs(gap):.2g} ± {error:.1g} K that"
            " sampling does not explain: timestep_fs is too long, or translation and rotation"
            " exchange energy too slowly in this stage. Try a shorter step, or run longer before"
            " means are taken"
        )
    return notes


def _note_on_heating(
    stage: Stage, k: int, temperature: np.ndarray, excess: np.ndarray
) -> list[str]:
    """A note if a thermostat at the ends of steps leaves the molecules at another temperature.

    temperature : (t,) at the ends of steps
    excess : (t,) of the temperature of the shadow Hamiltonian over it
    """
    heating, error = mean_and_error(excess)
    if heating is None or error is None:
        return []
    level = float(temperature.mean())
    if abs(heating) <= max(HEATING_LIMIT * level, STANDARD_ERRORS * error):
        return []
    shorter = stage.step_fs * sqrt(HEATING_LIMIT * level / 2 / abs(heating))
    shadow = temperature + excess
    mean = format_with_error(float(shadow.mean()), mean_and_error(shadow)[1])
    return [
        f"stages.{k}: the step of {stage.step_fs:g} fs leaves the molecules"
        f" {abs(heating):.2g} K too {'hot' if heating > 0 else 'cold'}: they move and rotate as at"
        f" {mean} K, while the thermostat controls the momenta at the ends of steps,"
        f" {level:.4g} K. Try timestep_fs = {shorter:.1g}, or integrator = 'baoab', the default,"
        " whose positions have barely such an error"
    ]


def _notes_on_trajectories(stage: Stage, k: int, acceptance: np.ndarray) -> list[str]:
    """A note if few trajectories were accepted, in the second half of enough
    samples, or if none was.

    acceptance : (t,) between samples, NaN where no trajectory ended
    """
    known = acceptance[np.isfinite(acceptance)]
    enough = len(acceptance) - len(acceptance) // 2 >= MIN_SAMPLES
    judged, where = (known[len(known) // 2 :], "in its second half ") if enough else (known, "")
    accepted = float(judged.mean()) if len(judged) else 1.0
    if accepted > (LEAST_ACCEPTANCE if enough else 0.0):
        return []
    return [
        f"stages.{k}: {where}{accepted:.1%} of the trajectories were accepted: positions barely"
        " change and the errors of the means are too small. Try a shorter timestep_fs than"
        f" {stage.step_fs:g}, an integrator of higher order such as 'srkn_4', or integrator ="
        " 'auto'"
    ]


def drift_of_thermostats(system: System, of_stage: Samples, k: int) -> tuple[float, float]:
    """The drift of the conserved energy that heat between the thermostats of translation and
    rotation causes, and its standard error, kJ/mol/ps.

    In the middle of a drift the shadow Hamiltonian has 1 - x/12 of the kinetic energy, where x is
    the mean (w dt)² of these motions, so that equal heats at both thermostats are not equal in it.
    See "Temperatures" in the theory chapter `zero_step`.
    """
    stage = system.scene.stages[k]
    freedom = system.freedom_in(k)
    if not (stage.has_thermostat and freedom.translation and freedom.rotation):
        return 0.0, 0.0
    if not stage.thermostat_method.by_motion:
        return 0.0, 0.0
    from rigidmd.assemble.build import integrator_of_stage  # not for single bodies

    if integrator_of_stage(system, k).kinetic_correction == 0 or system.thermostat is not None:
        return 0.0, 0.0
    unit = BOLTZMANN / KJ_PER_MOL
    heats, squares = [], []
    target = np.linspace(*stage.temperatures, len(of_stage))
    parts = (freedom.translation, freedom.rotation)
    for count, motion, square in zip(parts, MOTIONS, ("force", "torque"), strict=True):
        off = target - of_stage[f"temperature_{motion}"]
        heats.append(0.5 * count * unit * off / stage.thermostat_time)
        square_mean = float(of_stage[f"{square}_squares"].mean())
        squares.append(stage.step**2 * square_mean / (count * unit * float(target.mean())))
    rate, error = mean_and_error(0.5 * (heats[0] - heats[1]))
    factor = (squares[1] - squares[0]) / 12
    return factor * (rate or 0.0), abs(factor) * (error or 0.0)


def _drift_limit(time: float) -> float:
    """The largest small drift in a time (ps), kT/ps per degree of freedom."""
    return max(DRIFT_LIMIT / 1000, DRIFT_SUM_LIMIT / time)


def _drift_verdict(
    drift: float, error: float, limit: float, expected: tuple[float, float]
) -> str | None:
    """Whether a drift is significant, against its standard error and the largest small drift. None
    without an error. expected : the drift by heat between thermostats, and its error"""
    if not error > 0:
        return None
    count = abs(drift) / error
    if count < STANDARD_ERRORS:
        return f"not significant, {count:.1f} standard errors"
    value, uncertain = expected
    if abs(drift) <= limit:
        size = "but small"
    elif abs(drift - value) <= limit + STANDARD_ERRORS * hypot(error, uncertain) and value:
        size = "by heat between its two thermostats at this step"
    else:
        size = "and large"
    return f"significant, {count:.1f} standard errors, {size}"


def stage_summary(
    system: System, samples: Samples, k: int, computing: float, moves: tuple[int, int]
) -> dict:
    """Values of one stage: means over its equilibrated part, and its drift since the last sample
    before it."""
    of_stage = samples.of_stage(k)
    before = samples.of_stage(k - 1)
    first = before.row(-1) if len(before) else of_stage.row(0)
    stage = system.scene.stages[k]
    steady = equilibrated(of_stage, stage)
    begin = steady.row(0).time if len(steady) < len(of_stage) else first.time
    n = len(system.model.species)
    steps = of_stage.row(-1).step - first.step
    speed = steps / computing if computing > 0 else None
    time, drift = of_stage["time"], of_stage["drift"]
    if len(before):
        line = slope(np.append(first.time, time), np.append(0.0, drift))
    else:
        line = slope(time, drift)
    rows = [row for row in with_means(samples.described) if row[0].is_averaged]
    rows = [row for row in rows if stage.has_barostat or not row[0].of_box]
    means = _means(steady, rows, n) | _step_biases(system, stage, steady, rows)
    spread = float(of_stage["kinetic"].std())
    duration = steps * stage.step
    thermal = BOLTZMANN / KJ_PER_MOL * (means["temperature_K"] or 0.0) * system.freedom_in(k).total
    per_kt = [_finite_or_none(rate * 1000 / thermal) if thermal > 0 else None for rate in line[:2]]
    values = {
        "name": stage.label,
        "ensemble": stage.ensemble,
        "integrator": stage.integrator,
        "timestep_fs": stage.step_fs,
        "steps": steps,
        "duration_ps": duration,
        "computing_s": computing,
        "steps_per_s": speed,
        "ns_per_day": speed * stage.step_fs * 1e-6 * 86400 if speed else None,
        "means_over": describe_equilibrated(of_stage, stage, first.time),
        "equilibrated_from_ps": begin if len(time) >= LEAST_SAMPLES else None,
        "set_temperature_K": stage.temperature_K,
        "set_pressure_bar": stage.pressure_bar,
        **means,
        "moves_tried": moves[0],
        "moves_accepted": moves[1],
        "drift_verdict": (
            _drift_verdict(
                line.value,
                line.error,
                _drift_limit(duration) * thermal,
                drift_of_thermostats(system, of_stage, k),
            )
            if duration
            else None
        ),
        "drift_kJ_mol_ns_per_molecule": _finite_or_none(line.value * 1000 / n),
        "drift_error_kJ_mol_ns_per_molecule": _finite_or_none(line.error * 1000 / n),
        "drift_kT_ns_per_degree_of_freedom": per_kt[0],
        "drift_error_kT_ns_per_degree_of_freedom": per_kt[1],
        "drift_over_kinetic_std": (
            _finite_or_none(line.value * duration / spread) if spread else None
        ),
        "energy_rms_kJ_mol_per_molecule": _finite_or_none(line.rms / n),
        "minimum": None,
    }
    earlier = system.scene.stages[k - 1] if k else stage
    if stage.ensemble == "nve" and earlier.has_thermostat and len(steady) >= MIN_SAMPLES:
        values["temperature_before_K"] = earlier.temperatures[1]
        # standard deviation of the mean temperatures of such stages that start from states of a
        # canonical ensemble, see "Temperatures after a thermostat" in the theory chapter `errors`;
        # None if sampling hides it
        level = steady["temperature"]
        freedom = system.freedom_in(k).total
        square = 2 * level.mean() ** 2 / freedom - level.var() if freedom else 0.0
        values["temperature_scatter_K"] = sqrt(square) if square > 0 else None
    if stage.in_trajectories:
        values["trajectories"] = steps // stage.steps_together
    if stage.volume:
        mean = mean_and_error(equilibrated(before, earlier)["volume"])
        values["volume_nm3"], values["volume_error_nm3"] = mean
        values["volume_before_nm3"] = first.volume
    return values


def _minimised(
    system: System, samples: Samples, k: int, computing: float, minimum: Minimum
) -> dict:
    """Values of a minimisation, at its end. None for those that only a stage of motion has."""
    stage = system.scene.stages[k]
    minimum_values = minimum_figures(minimum, len(system.model.species))
    end = Samples(samples.stages, samples.described, samples.of_stage(k).table()[-1:])
    of_box = [row for row in with_means() if row[0].of_box and stage.changes_box]
    return dict.fromkeys(stage_summary(system, samples, k, computing, (0, 0))) | {
        "name": stage.label,
        "ensemble": stage.ensemble,
        "steps": 0,
        "duration_ps": 0.0,
        "computing_s": computing,
        "potential_kJ_mol_per_molecule": minimum_values["energy_after_kJ_mol_per_molecule"],
        "pressure_bar": minimum_values["pressure_bar"],
        **_means(end, of_box),
        "moves_tried": 0,
        "moves_accepted": 0,
        "minimum": minimum_values,
    }


def _means(
    samples: Samples, rows: Iterable[tuple[Quantity, Mean]], molecules: int = 1
) -> dict[str, float | None]:
    """Means and their errors. Those of features where they have values."""
    means = {}
    for quantity, mean in rows:
        values = samples[quantity.name]
        values = values[np.isfinite(values)]  # no trajectory has ended at the first sample
        if len(values) or quantity.name in QUANTITIES:
            divisor = molecules if mean.per_molecule else 1
            means[mean.key.format("")], means[mean.key.format("_error")] = mean_and_error(
                values / divisor
            )
    return means


def _step_biases(
    system: System, stage: Stage, samples: Samples, rows: Iterable[tuple[Quantity, Mean]]
) -> dict[str, float]:
    """What the time step adds to means, with errors, where a feature knows it."""
    if not stage.has_thermostat or stage.in_trajectories:
        return {}
    columns = {name: samples[name] for name, row in samples.described.items() if row.unit}
    values = {}
    for feature in providers("step_biases"):
        found = feature.step_biases(system, stage, columns)
        for quantity, mean in rows:
            if not isinstance(found, str) and quantity.name in found:
                divisor = len(system.model.species) if mean.per_molecule else 1
                bias, error, _ = found[quantity.name]
                values[mean.key.format("_step")] = bias / divisor
                values[mean.key.format("_step_error")] = error / divisor
    return values


def _finite_or_none(value: float) -> float | None:
    return None if isnan(value) else float(value)


def minimum_figures(found: Minimum, molecules: int) -> Json:
    """The values of a minimum with units in their keys. Pressures are without the kinetic part.
    None without a box."""
    pressure = None if found.pressure is None else np.array(found.pressure) / BAR
    return {
        "converged": found.converged,
        "ended_by": found.ended_by or None,
        "iterations": found.iterations,
        "precision": found.precision,
        "overlap_removal_steps": found.overlap_steps,
        "energy_before_kJ_mol_per_molecule": found.energy_before / KJ_PER_MOL / molecules,
        "energy_after_kJ_mol_per_molecule": found.energy_after / KJ_PER_MOL / molecules,
        "largest_force_kJ_mol_A": found.force / KJ_PER_MOL,
        "largest_torque_kJ_mol": found.torque / KJ_PER_MOL,
        "pressure_bar": float(pressure[:3].mean()) if pressure is not None else None,
        "pressure_tensor_bar": pressure.tolist() if pressure is not None else None,
        "largest_pressure_deviation_bar": (
            None if found.deviation is None else found.deviation / BAR
        ),
    }


def describe_minimum(found: Minimum, stage: Stage) -> str:
    """A warning for a minimisation that has not converged, with the largest force, torque and
    deviation."""
    parts = [
        ("force", found.force / KJ_PER_MOL, stage.force_limit_kJ_mol_A, "kJ/(mol Å)"),
        ("torque", found.torque / KJ_PER_MOL, stage.torque_limit_kJ_mol, "kJ/mol"),
    ]
    if found.deviation is not None:
        parts.append(
            ("deviation of the pressure", found.deviation / BAR, stage.pressure_limit_bar, "bar")
        )
    reached = ", ".join(
        f"{what} {value:.3g} (limit {limit:g}) {unit}" for what, value, limit, unit in parts
    )
    how = f"after {found.iterations} iterations ({found.ended_by})"
    return f"the minimisation has not converged {how}: largest {reached}"
