"""Descriptions of stages: steps, thermostat and barostat, sampled distribution, conserved
quantities."""

from rigidmd.scene.ensembles import COMPRESSIBILITY
from rigidmd.scene.stage import Stage

#: Range of compressibilities (1/bar): diamond, a gas at 0.01 bar.
STIFFEST, SOFTEST = 2e-7, 100.0
#: Ensemble -> the distribution that it samples, and the conserved energy.
DISTRIBUTIONS = {
    "nve": ("the microcanonical distribution", "energy"),
    "nph": ("the isoenthalpic distribution", "enthalpy with the energy of the piston"),
    "nvt": ("the canonical distribution, exp(-H/kT)", "energy less heat"),
    "npt": (
        "the isothermal-isobaric distribution, exp(-(H + p V)/kT)",
        "energy less heat and the work of the box",
    ),
}


def describe_stage(stage: Stage) -> list[str]:
    """Two lines: steps, thermostat and barostat. Sampled distribution and conserved quantities. For
    a minimisation: the minimised quantity. The limits of convergence."""
    if stage.is_minimisation:
        what = "the potential energy"
        limits = [f"forces of {stage.force_limit_kJ_mol_A:g} kJ/(mol Å)"]
        limits.append(f"torques of {stage.torque_limit_kJ_mol:g} kJ/mol")
        if stage.changes_box:
            what = (
                f"the enthalpy at {_pressure(stage)} bar, the cell"
                f" {stage.pressure_coupling.replace('_', '-')}"
            )
            limits.append(f"a pressure within {stage.pressure_limit_bar:g} bar")
        return [
            f"{stage.label}: to a minimum of {what}. No time passes and momenta do not change",
            (
                f"limits: {', '.join(limits[:-1])} and {limits[-1]}. At most"
                f" {stage.max_iterations} iterations"
            ),
        ]
    length = f"{stage.duration:g} ps"
    if stage.timestep_fs is not None:
        rounded = stage.steps * stage.step
        length = f"{stage.steps} steps of {stage.timestep_fs:g} fs = {rounded:g} ps"
    text = f"{stage.label}: {length}, {stage.integrator}"
    if stage.is_auto:
        error = f"{stage.trajectory_error or 0:g} of Q or X"
        if stage.energy_error_kT:
            error = (
                f"{stage.energy_error_kT:g} kT per degree of freedom of the energy, over the stage"
                " (rms)"
            )
        elif stage.bias_kT:
            error = f"{stage.bias_kT:g} kT per degree of freedom of the average potential energy"
        choice = f"integrator and step chosen at its start for an error of {error}"
        text = f"{stage.label}: {stage.duration_ps:g} ps, {choice}"
    if stage.has_thermostat:
        kind = stage.thermostat_method
        words = [kind.title, kind.describe(stage.thermostat_values)]
        text += f", {_ramp(stage.temperatures)} K by {', '.join(filter(None, words))}"
    if stage.has_barostat:
        text += f", {_barostat(stage)}"
    if stage.volume:
        text += ", in the mean box of the stage before"
    sampled, conserved = DISTRIBUTIONS[stage.ensemble]  # up to the time-step error
    if stage.ensemble == "npt" and stage.pressure_coupling != "isotropic":
        sampled += ", with the invariant measure of the shape"
    if stage.ramps:
        sampled += ", at the temperature and pressure of each moment"
    momentum = "total momentum" if stage.keeps_momentum else "not the total momentum"
    return [text, f"samples {sampled}; conserves {conserved}, {momentum}"]


def _barostat(stage: Stage) -> str:
    kind = stage.barostat_method
    values = stage.barostat_values
    text = f"{_pressure(stage)} bar by {kind.title}, {stage.pressure_coupling.replace('_', '-')}"
    if "barostat_time_ps" in values:
        text += f", {stage.barostat_time:g} ps"
    if "barostat_interval_ps" in values:
        text += (
            f", a move every {f'{stage.moves_every} steps' if stage.moves_every > 1 else 'step'}"
        )
    water = ", of water" if stage.compressibility == COMPRESSIBILITY else ""
    return f"{text}. Compressibility {stage.compressibility:g}/bar{water}"


def _pressure(stage: Stage) -> str:
    first, last = stage.pressures
    if len(set(first[:3])) == 1 and not any(first[3:]):
        return _ramp((first[0], last[0]))
    return ", ".join(f"{value:g}" for value in (first if any(first[3:]) else first[:3]))


def _ramp(ends: tuple[float, float]) -> str:
    return f"{ends[0]:g}" if ends[0] == ends[1] else f"{ends[0]:g} to {ends[1]:g}"


def stage_notes(stages: tuple[Stage, ...]) -> list[str]:
    """Notes on compressibilities that no substance has."""
    return [
        f"stages.{k}: compressibility_per_bar = {stage.compressibility:g} is outside the range of"
        f" substances (diamond {STIFFEST:g}, water {COMPRESSIBILITY:g}, a gas at 1 bar 1): is it in"
        " another unit? The box will"
        f" {'barely move' if stage.compressibility < STIFFEST else 'try moves that are too long'}"
        for k, stage in enumerate(stages)
        if stage.has_barostat and not STIFFEST / 10 <= stage.compressibility <= SOFTEST
    ]
