"""The summary of a run as text."""

from collections.abc import Container, Sequence

from rigidmd.core.statistics import NO_ERROR, format_signed, format_with_error
from rigidmd.core.toml import Json

POSITIONS = {
    "unwrapped": "molecules follow continuous paths",
    "wrapped": "molecules are wrapped into the box. Displacements need unwrapped frames",
}


def summary_text(summary: dict, known: Container[str] = ()) -> str:
    """The summary of a run of molecules as text, without the notes in `known`."""
    species = ", ".join(f"{count} {name}" for name, count in summary["species"].items())
    freedom = summary["degrees_of_freedom"]
    lines = [
        f"{summary['scene']}: {species}; {summary['molecules']} bodies, {summary['sites']} sites,"
        f" {freedom} degrees of freedom ({summary['degrees_of_freedom_translation']} translation,"
        f" {summary['degrees_of_freedom_rotation']} rotation)"
    ]
    for stage in summary["stages"]:
        lines += ["", stage_title(stage), *as_lines(stage_rows(stage))]
    momentum = (
        f"|P| = {summary['momentum_u_A_ps']:.1e} u Å/ps, {summary['momentum_relative']:.1e} of the"
        " sum of |m v|"
    )
    rows = [("precision", summary["precision_reason"])] if summary["precision_reason"] else []
    rows += [orthogonality(summary), ("momentum", momentum)]
    for name, (calls, seconds) in summary.get("forces_by_python", {}).items():
        rows.append(("forces", f"{name}: {calls} calls, {seconds:.3g} s"))
    if removed := summary["momentum_removed"]:
        rows.append(
            (
                "",
                (
                    f"removed every {removed['interval_ps']:g} ps, {removed['energy_kJ_mol']:.1e}"
                    " kJ/mol in all"
                ),
            )
        )
    if summary["positions"]:
        rows.append(("positions", f"{summary['positions']}: {POSITIONS[summary['positions']]}"))
    return "\n".join([*lines, "", *as_lines(rows), *last_lines(summary, known)])


def as_lines(rows: list[tuple[str, str]]) -> list[str]:
    return [f"  {name:<16}{value}" for name, value in rows]


def last_lines(summary: dict, known: Container[str]) -> list[str]:
    notes = [f"\n  note: {note}" for note in summary["notes"] if note not in known]
    return [
        *notes,
        *(["", "  interrupted: these are the results so far"] if summary["interrupted"] else []),
    ]


def orthogonality(summary: dict) -> tuple[str, str]:
    error = summary["largest_orthogonality_error"]
    return "orthogonality", f"|QᵀQ - 1| at most {error:.1e}" if error else "exactly 0"


def stage_title(stage: dict) -> str:
    """Steps and speed of a stage, or how its minimisation ended."""
    if minimum := stage["minimum"]:
        ended = "converged" if minimum["converged"] else f"not converged ({minimum['ended_by']}),"
        steps = minimum["overlap_removal_steps"]
        removal = f" and {steps} of overlap removal" if steps else ""
        return (
            f"{stage['name']}: {ended} after {minimum['iterations']} iterations{removal};"
            f" {stage['computing_s']:.1f} s"
        )
    title = (
        f"{stage['name']}: {stage['steps']} steps of {stage['timestep_fs']:g} fs,"
        f" {stage['duration_ps']:g} ps"
    )
    if stage["steps_per_s"]:
        title += f"; {stage['steps_per_s']:,.0f} steps/s, {stage['ns_per_day']:,.4g} ns/day"
    return title


def _minimum_rows(stage: dict, minimum: dict) -> list[tuple[str, str]]:
    before = minimum["energy_before_kJ_mol_per_molecule"]
    after = minimum["energy_after_kJ_mol_per_molecule"]
    force, torque = minimum["largest_force_kJ_mol_A"], minimum["largest_torque_kJ_mol"]
    rows = [
        ("potential", f"{before:.6g} before, {after:.6f} kJ/mol per molecule after"),
        ("largest force", f"{force:.2g} kJ/(mol Å), torque {torque:.2g} kJ/mol"),
    ]
    if minimum["pressure_bar"] is not None:
        off = minimum["largest_pressure_deviation_bar"]
        deviation = "" if off is None else f", within {off:.2g} bar of the given pressure"
        rows.append(
            ("pressure", f"{minimum['pressure_bar']:.4g} bar without the kinetic part{deviation}")
        )
    if stage.get("density_g_cm3") is not None:
        rows.append(("density", f"{stage['density_g_cm3']:.4f} g/cm³"))
        edges = (f"{edge} {stage[f'{edge}_A']:.4f}" for edge in "abc")
        rows.append(("box", f"{', '.join(edges)} Å"))
    return rows


def stage_rows(stage: dict) -> list[tuple[str, str]]:
    """Names and values of a stage. A row without a name belongs to the row before it."""
    if stage["minimum"]:
        return _minimum_rows(stage, stage["minimum"])
    rows = [("integrator", stage["choice"])] if stage["choice"] else []
    rows.append(("means", f"over {stage['means_over']}"))
    if stage.get("volume_nm3") is not None:
        mean = format_with_error(stage["volume_nm3"], stage["volume_error_nm3"])
        end = stage["volume_before_nm3"]
        rows.append(
            (
                "volume",
                f"{mean} nm³, the mean of the stage before, at whose end it was {end:.4g} nm³",
            )
        )
    if stage["temperature_K"] is not None:
        value = _with_error(stage["temperature_K"], stage["temperature_error_K"], 2, "K")
        rows.append(("temperature", value + _set_point(stage["set_temperature_K"], "K")))
        if stage["temperature_rotation_K"] is not None:
            rows.append(("", _temperatures(stage, "")))
        if (scatter := stage.get("temperature_scatter_K")) is not None:
            off = stage["temperature_K"] - stage["temperature_before_K"]
            before = stage["temperature_before_K"]
            moment = "an NVE stage keeps the energy at its start. Such temperatures scatter by"
            hint = "" if abs(off) < 3 * scatter else ", less than this: equilibrate longer"
            rows.append(
                ("", f"{off:+.2g} K from the {before:g} K before: {moment} {scatter:.2g} K{hint}")
            )
    error = stage["potential_error_kJ_mol_per_molecule"]
    rows.append(
        (
            "potential",
            _with_error(stage["potential_kJ_mol_per_molecule"], error, 3, "kJ/mol per molecule"),
        )
    )
    if stage["pressure_bar"] is not None:
        value = _with_error(stage["pressure_bar"], stage["pressure_error_bar"], 0, "bar")
        rows.append(("pressure", value + _set_point(stage["set_pressure_bar"], "bar")))
    if stage.get("density_g_cm3") is not None:
        rows.append(
            (
                "density",
                _with_error(stage["density_g_cm3"], stage["density_error_g_cm3"], 4, "g/cm³"),
            )
        )
        edges = (
            f"{edge} {_with_error(stage[f'{edge}_A'], stage[f'{edge}_error_A'], 3)}"
            for edge in "abc"
        )
        rows.append(("box", f"{', '.join(edges)} Å"))
    if stage["moves_tried"]:
        accepted = stage["moves_accepted"] / stage["moves_tried"]
        rows.append(("box moves", f"{stage['moves_tried']}, {100 * accepted:.0f} % accepted"))
    if stage.get("acceptance_mean") is not None:
        accepted = 100 * stage["acceptance_mean"]
        size = stage["abs_dH_kT_mean"]
        rows.append(("trajectories", f"{stage['trajectories']}, {accepted:.0f} % accepted"))
        balance = _with_error(stage["exp_minus_dH_mean"], stage["exp_minus_dH_error_mean"], 3)
        rows.append(
            ("", f"mean abs(dH) {size:.2g} kT. Mean exp(-dH/kT) {balance}, 1 in equilibrium")
        )
    elif stage["drift_kJ_mol_ns_per_molecule"] is not None:
        what = "energy" if stage["ensemble"] == "nve" else "conserved energy"
        value = stage["drift_kJ_mol_ns_per_molecule"]
        error = stage["drift_error_kJ_mol_ns_per_molecule"]
        verdict = f": {stage['drift_verdict']}" if stage["drift_verdict"] else ""
        rows.append(
            ("drift", f"{format_signed(value, error)} kJ/mol/ns per molecule ({what}){verdict}")
        )
        if stage["drift_kT_ns_per_degree_of_freedom"] is not None:
            value = stage["drift_kT_ns_per_degree_of_freedom"]
            error = stage["drift_error_kT_ns_per_degree_of_freedom"]
            rows.append(("", f"{format_signed(value, error)} kT/ns per degree of freedom"))
            total = f"in total {value * stage['duration_ps'] / 1000:+.2g} kT per degree of freedom"
            if stage["drift_over_kinetic_std"] is not None:
                total += (
                    f", {stage['drift_over_kinetic_std']:+.2g} standard deviations of the kinetic"
                    " energy"
                )
            rows.append(("", total))
        noise = stage["energy_rms_kJ_mol_per_molecule"]
        rows.append(
            ("energy noise", f"{noise:.2g} kJ/mol per molecule, rms deviation from the linear fit")
        )
    return rows


def _with_error(value: float, error: float | None, places: int, unit: str = "") -> str:
    text = format_with_error(value, error) if error else f"{value:.{places}f}"
    return f"{text} {unit}".rstrip() + (f" ({NO_ERROR})" if error is None and unit else "")


def _set_point(set_point: float | Sequence[float] | None, unit: str) -> str:
    """The set point of a thermostat or barostat, two values if it changes. Empty without one."""
    if set_point is None:
        return ""
    values = set_point if isinstance(set_point, Sequence) else [set_point]
    return (
        ", set point"
        f" {(' to ' if len(values) == 2 else ', ').join(f'{value:g}' for value in values)} {unit}"
    )


def _temperatures(stage: dict, kind: str) -> str:
    texts = []
    for name, motion in (("T_trans", "translation"), ("T_rot", "rotation")):
        if (value := stage[f"temperature_{motion}{kind}_K"]) is not None:
            texts.append(
                f"{name} {_with_error(value, stage[f'temperature_{motion}{kind}_error_K'], 2)}"
            )
    return f"{', '.join(texts)} K" if texts else ""


def energy_lines(name: str, energies: Json, unit: str) -> list[str]:
    """Energies of the start of molecules, of `MolecularRun.start_energy`, as text."""
    steps = energies["overlap_removal_steps"]
    removal = f", after {steps} steps of overlap removal" if steps else ""
    lines = [f"{name}: energies of the start, {energies['molecules']} molecules{removal}"]
    lines += [f"  {note}" for note in energies["notes"]]
    rows = [(term.replace("_", " "), value, unit) for term, value in energies["components"].items()]
    rows += [(key, energies[key], unit) for key in ("potential", "kinetic", "virial")]
    if (lattice_energy := energies["lattice_energy_per_molecule"]) is None:
        rows += [("per molecule", energies["potential_per_molecule"], f"{unit}, potential")]
    else:
        rows += [("lattice energy", lattice_energy, f"{unit} per molecule")]
    rows += (
        [] if energies["pressure_bar"] is None else [("pressure", energies["pressure_bar"], "bar")]
    )
    where = f"{unit}/Å on molecule {energies['largest_force_molecule']}"
    rows.append(("largest force", energies["largest_force_per_A"], where))
    lines += value_lines(rows, ">22.10g")
    lines += [f"  {key.replace('_', ' ')}: {text}" for key, text in energies["meaning"].items()]
    if error := energies.get("accuracy"):
        lines.append(f"Coulomb forces on sites, compared with {error['reference']}")
        relative = "" if error["relative"] is None else f"{error['relative']:.2g} of it, "
        relative += f"{error['in_e2_per_A2']:.2g} e²/Å²"
        rows = [
            ("rms force", error["rms_force_per_A"], f"{unit}/Å"),
            ("rms error", error["rms_error_per_A"], f"{unit}/Å: {relative}"),
            ("estimated", error["estimated_per_A"], f"{unit}/Å"),
            ("largest error", error["largest_error_per_A"], f"{unit}/Å"),
            ("error of the energy", error["energy_error"], unit),
        ]
        lines += value_lines(rows, ">22.4g")
    return lines


def value_lines(rows: list[tuple[str, float, str]], form: str) -> list[str]:
    """Lines with names, numbers and units."""
    return [f"  {name:<22}{value:{form}} {unit}" for name, value, unit in rows]
