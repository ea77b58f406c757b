"""The summary of a run: one dictionary with units in its keys."""

from collections import Counter
from collections.abc import Sequence
from math import isnan, sqrt

import numpy as np

from rigidmd.core.drift import OF_ENERGY, slope
from rigidmd.core.state import TAKEN, State
from rigidmd.core.statistics import mean, with_error
from rigidmd.engines.samples import Sample, Samples
from rigidmd.engines.system import System
from rigidmd.run.minimum import Minimum, minimum_figures
from rigidmd.units import BOLTZMANN, COULOMB, FEMTOSECOND, KJ_PER_MOL

#: Figures of a stage that a minimisation does not have.
OF_MOTION = (
    "integrator", "timestep_fs", "steps_per_s", "ns_per_day", "temperature_K", "temperature_error_K",
    "temperature_translation_K", "temperature_rotation_K", "temperature_translation_unbiased_K",
    "temperature_rotation_unbiased_K", "pressure_error_bar", "drift_kJ_mol_ns_per_molecule",
    "drift_error_kJ_mol_ns_per_molecule", "drift_kT_ns_per_degree_of_freedom",
    "drift_error_kT_ns_per_degree_of_freedom", "drift_over_kinetic_std", "energy_rms_kJ_mol_per_molecule",
)  # fmt: skip
#: Notes on the second half of a stage, of LEAST samples and where an effect exceeds SURE standard errors: drift of the
#: conserved energy (kT/ns per degree of freedom) that has added up to ADDED kT per degree of freedom; error of the
#: temperatures from the step, and difference of those of translation and rotation, as fractions.
DRIFTS, ADDED, HEATS, DIFFER, SURE, LEAST = 0.1, 1e-3, 0.01, 0.01, 4.0, 20
#: Largest fraction of the translational temperature in a common drift of all molecules without a note; where the total
#: momentum is thermal, its largest kinetic energy in kT, which one run in two million exceeds.
SHOWS, THERMAL = 1e-4, 16.0
MOTIONS = ("translation", "rotation")
#: Growth of the estimated error of Coulomb forces that is told.
COARSER = 1.5


def summarise(
    system: System,
    samples: Samples,
    state: State,
    relief_steps: int,
    preparing: float,
    wall: float,
    computing: Sequence[float],
    interrupted: bool,
    choices: dict[int, str],
    stable: dict[int, float],
    moves: dict[int, tuple[int, int]],
    minima: dict[int, Minimum],
    warnings: list[str],
) -> dict:
    """The summary of a run but for what it was computed with; times in s: preparing (compiling, relief), wall (stages
    with output), computing (steps).

    choices : choice and reason for stages that left their integrator open
    stable : the longest stable step (ps) of stages, as estimated at their start
    moves : of stages with a box that moves, how many moves were tried and accepted
    minima : results of the stages that are minimisations
    """
    scene = system.scene
    last = samples.row(-1)
    stages = [
        (
            _stage(system, samples, k, computing[k], moves.get(k, (0, 0)))
            if k not in minima
            else _minimised(system, samples, k, computing[k], minima[k])
        )
        | {
            "choice": _choice(system, samples.of_stage(k), k, choices.get(k)),
            "stable_timestep_fs": stable[k] / FEMTOSECOND if k in stable else None,
        }
        for k in np.unique(samples["stage"]).tolist()
    ]
    return {
        "interrupted": interrupted,
        "molecules": len(system.model.species),
        "species": {m.name: 0 for m in system.species} | Counter(system.species[k].name for k in system.model.species),
        "sites": system.site_count,
        "degrees_of_freedom": system.last_freedom.total,
        "degrees_of_freedom_translation": system.last_freedom.translation,
        "degrees_of_freedom_rotation": system.last_freedom.rotation,
        "box_A": list(system.space) if system.density else None,
        "density_g_cm3": system.density or None,
        "cutoff_A": system.cutoff if np.isfinite(system.cutoff) else None,
        "positions": scene.output.positions if scene.output.trajectory and system.density else None,
        "relief_steps": relief_steps,
        "preparing_s": preparing,
        "wall_s": wall,
        "largest_orthogonality_error": float(samples["orthogonality_error"].max()),
        "momentum_u_A_ps": last.momentum,
        "momentum_relative": _relative_momentum(system, state, last.momentum),
        "momentum_conserved": [axis for axis, kept in zip("xyz", system.model.keeps_momentum, strict=True) if kept],
        "own_forces": dict(system.user_terms),
        "momentum_removed": _removed(system, state),
        "stages": stages,
        "notes": [
            *system.notes,
            *_drifting(system, state, last),
            *outgrown_sums(system, state),
            *(doubt for k in range(len(computing)) if k not in minima for doubt in _doubts(system, samples, k)),
            *warnings,
        ],
    }


def _choice(system: System, samples: Samples, k: int, text: str | None) -> str | None:
    """The choice for a stage; one for an error of the energy with the error that the stage has."""
    thermal = BOLTZMANN / KJ_PER_MOL * (mean(samples["temperature"])[0] or 0.0) * system.freedom_in(k).total
    if text is None or OF_ENERGY not in text or len(samples) < 2 or thermal == 0:
        return text
    rms, time = float(np.sqrt(np.mean(samples["drift"] ** 2))) / thermal, samples["time"]
    return f"{text}. In the {time[-1] - time[0]:.4g} ps that ran it was {rms:.1e}"


def _removed(system: System, state: State) -> dict | None:
    """Energy removed with the total momentum in the whole run; None without such removals."""
    if system.removes_momentum_every is None:
        return None
    return {"interval_ps": system.removes_momentum_every, "energy_kJ_mol": -float(state.books[TAKEN]) / KJ_PER_MOL}


def _drifting(system: System, state: State, last: Sample) -> list[str]:
    """A note if the molecules drift together: with a momentum that is conserved, whose degrees of freedom are not
    counted, and shows in the temperatures; or with one that is not, and exceeds what is thermal."""
    if not system.freedom.translation or not last.temperature_translation > 0:
        return []
    mass = system.model.mass[system.model.species]
    momentum = float(np.linalg.norm((mass @ state.velocity)[system.model.keeps_momentum]))
    together = f"the molecules drift together with |P| = {momentum:.3g} u Å/ps"
    energy = momentum**2 / (2 * float(mass.sum()) * BOLTZMANN)  # K
    if not system.keeps_momentum_in(last.stage):
        if energy <= THERMAL * last.temperature_translation:
            return []
        usual = sqrt(3 * float(mass.sum()) * BOLTZMANN * last.temperature_translation)
        return [f"{together}, where thermal motion has {usual:.3g}: the thermostat has not stopped it yet; run longer"]
    gain = 2 * energy / system.freedom.translation
    if gain <= SHOWS * last.temperature_translation:
        return []
    return [
        f"{together}, which adds {gain:.2g} K to T_trans; run.remove_momentum_interval_ps removes the total momentum"
    ]


def outgrown_sums(system: System, state: State) -> list[str]:
    """A note if the box has grown or shrunk until waves or grid of the start no longer give the accuracy asked for."""
    if system.force_error is None or not any(stage.changes_box for stage in system.scene.stages):
        return []
    from rigidmd.run.force_errors import estimated_error  # SciPy is for such runs only

    now = estimated_error(system, state.cell)
    if now <= COARSER * system.force_error:
        return []
    before, after = (f"{error / COULOMB:.2g}" for error in (system.force_error, now))
    return [
        f"the box has changed, and with it the estimated error of Coulomb forces, from {before} to {after} e²/Å²: "
        "alpha, k-vectors and grid are those of the start. A run with structure.file = 'final.npz' chooses them anew"
    ]


def _doubts(system: System, samples: Samples, k: int) -> list[str]:
    """What shows that the averages of stage k are wrong, in its second half: energy that drifts, temperatures that the
    step changes or that differ.

    A thermostat hides the energy that a long step adds: it takes it out again, faster from some motions than from
    others, and by the temperatures at the steps, which are not those of the ensemble.
    """
    own = samples.of_stage(k)
    half = len(own) // 2
    if len(own) - half < LEAST:
        return []
    time, drift, whole = (own[name][half:] for name in ("time", "drift", "temperature"))
    found, stage, freedom, level = [], system.scene.stages[k], system.freedom_in(k), float(whole.mean())
    line, thermal = slope(time, drift), BOLTZMANN / KJ_PER_MOL * level * freedom.total
    limit = max(DRIFTS / 1000, ADDED / (time[-1] - time[0])) * thermal  # kJ/mol/ps
    if thermal > 0 and abs(line.value) > limit + SURE * line.error:
        rate, error = (value * 1000 / thermal for value in (line.value, line.error))
        smooth = "" if system.scene.forces.truncation == "smooth_switch" else " or truncation = 'smooth_switch'"
        hides = "; the thermostat hides this and leaves temperatures wrong" if stage.has_thermostat else ""
        found.append(
            f"stages.{k}: in its second half the conserved energy drifts by {rate:+.2g} ± {error:.1g} kT/ns per "
            f"degree of freedom, as from a step that is too long or forces that jump at the cutoff{hides}. Try a "
            f"shorter timestep_fs than {stage.timestep_fs:g}{smooth}"
        )
    if not stage.has_thermostat:
        return found
    moving, turning = pair = [own[f"temperature_{motion}"][half:] for motion in MOTIONS]
    unbiased, corrected = [own[f"temperature_{motion}_unbiased"][half:] for motion in MOTIONS], ""
    if any(np.isfinite(values).all() for values in unbiased):
        (moving, turning), corrected = unbiased, " without the error of the step"
        both = zip(unbiased, (freedom.translation, freedom.rotation), strict=True)
        right = sum((values * count for values, count in both if count), np.zeros(len(whole))) / freedom.total
        heat, doubt = mean(right - whole)
        if heat is not None and doubt is not None and abs(heat) > max(HEATS * level, SURE * doubt):
            parts = [f"{name} {v.mean():.4g}" for name, v in zip(("T_trans", "T_rot"), pair, strict=True) if v[0] > 0]
            shorter = stage.timestep_fs * sqrt(HEATS * level / 2 / abs(heat))
            found.append(
                f"stages.{k}: the step of {stage.timestep_fs:g} fs leaves the molecules {abs(heat):.2g} K too "
                f"{'hot' if heat > 0 else 'cold'}: their temperature{corrected} is "
                f"{with_error(float(right.mean()), mean(right)[1])} K; at the steps it is {level:.4g} K, "
                f"{', '.join(parts)}, by which the thermostat goes. Try timestep_fs = {shorter:.1g}, or integrator = "
                "'baoab' with thermostat = 'langevin', whose positions have hardly such an error"
            )
    apart, error = mean(moving - turning)
    if apart is not None and error is not None and abs(apart) > max(DIFFER * level, SURE * error):
        found.append(
            f"stages.{k}: in its second half T_trans is {moving.mean():.4g} K and T_rot {turning.mean():.4g} K"
            f"{corrected}, {abs(apart):.2g} ± {error:.1g} K apart, which sampling does not explain: timestep_fs is too "
            "long, or translation and rotation exchange energy too slowly for this stage. Try a shorter step, or run "
            "longer before means are taken"
        )
    return found


def _relative_momentum(system: System, state: State, momentum: float) -> float:
    """|P| over the sum of |m v|."""
    speed = np.linalg.norm(state.velocity, axis=1)
    total = float(system.model.mass[system.model.species] @ speed)
    return momentum / total if total else 0.0


def _stage(system: System, samples: Samples, k: int, computing: float, moves: tuple[int, int]) -> dict:
    """Values of one stage. Its drift is counted from the last sample before it."""
    own, before = samples.of_stage(k), samples.of_stage(k - 1)
    first = before.row(-1) if len(before) else own.row(0)
    stage = system.scene.stages[k]
    n = len(system.model.species)
    steps = own.row(-1).step - first.step
    speed = steps / computing if computing > 0 else None
    time, drift = own["time"], own["drift"]
    line = slope(np.append(first.time, time), np.append(0.0, drift)) if len(before) else slope(time, drift)
    mean_t, error_t = mean(own["temperature"])
    spread = float(own["kinetic"].std())
    per_molecule = line.value * 1000 / n
    thermal = BOLTZMANN / KJ_PER_MOL * (mean_t or 0.0) * system.freedom_in(k).total
    per_kt = line.value * 1000 / thermal if thermal > 0 else None
    error_kt = line.error * 1000 / thermal if thermal > 0 else None
    return {
        "name": stage.label,
        "ensemble": stage.ensemble,
        "integrator": stage.integrator,
        "timestep_fs": stage.timestep_fs,
        "steps": steps,
        "duration_ps": steps * stage.timestep_fs * FEMTOSECOND,
        "computing_s": computing,
        "steps_per_s": speed,
        "ns_per_day": speed * stage.timestep_fs * 1e-6 * 86400 if speed else None,
        "temperature_K": mean_t,
        "temperature_error_K": error_t,
        "temperature_translation_K": mean(own["temperature_translation"])[0],
        "temperature_rotation_K": mean(own["temperature_rotation"])[0],
        "temperature_translation_unbiased_K": mean(own["temperature_translation_unbiased"])[0],
        "temperature_rotation_unbiased_K": mean(own["temperature_rotation_unbiased"])[0],
        "potential_kJ_mol_per_molecule": float(np.mean(own["potential"])) / n,
        "pressure_bar": mean(own["pressure_bar"])[0],
        "pressure_error_bar": mean(own["pressure_bar"])[1],
        **(_of_box(own) if stage.has_barostat else {}),
        "moves_tried": moves[0],
        "moves_accepted": moves[1],
        "drift_kJ_mol_ns_per_molecule": _known(per_molecule),
        "drift_error_kJ_mol_ns_per_molecule": _known(line.error * 1000 / n),
        "drift_kT_ns_per_degree_of_freedom": per_kt and _known(per_kt),
        "drift_error_kT_ns_per_degree_of_freedom": error_kt and _known(error_kt),
        "drift_over_kinetic_std": _known(line.value * steps * stage.timestep_fs * FEMTOSECOND / spread)
        if spread
        else None,
        "energy_rms_kJ_mol_per_molecule": _known(line.rms / n),
        "minimum": None,
    }


def _minimised(system: System, samples: Samples, k: int, computing: float, found: Minimum) -> dict:
    """Figures of a minimisation, at its end; None for those of OF_MOTION."""
    stage, figures = system.scene.stages[k], minimum_figures(found, len(system.model.species))
    own = samples.of_stage(k)
    end = Samples(samples.stages, samples.user_terms, own.table()[-1:])
    return dict.fromkeys(OF_MOTION) | {
        "name": stage.label,
        "ensemble": stage.ensemble,
        "steps": 0,
        "duration_ps": 0.0,
        "computing_s": computing,
        "potential_kJ_mol_per_molecule": figures["energy_after_kJ_mol_per_molecule"],
        "pressure_bar": figures["pressure_bar"],
        **(_of_box(end) if stage.changes_box else {}),
        "moves_tried": 0,
        "moves_accepted": 0,
        "minimum": figures,
    }


def _of_box(own: Samples) -> dict:
    """Means of what a barostat changes, with their errors."""
    found = {}
    for name, key in (("density", "density{}_g_cm3"), ("a", "a{}_A"), ("b", "b{}_A"), ("c", "c{}_A")):
        value, error = mean(own[name])
        found |= {key.format(""): value, key.format("_error"): error}
    return found


def _known(value: float) -> float | None:
    return None if isnan(value) else float(value)
