"""The summary of a run of molecules as text, in full and in short."""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from itertools import groupby

from rigidmd.core.quantities import QUANTITIES, Mean, Quantity, with_means
from rigidmd.core.statistics import NO_ERROR, format_signed, format_with_error
from rigidmd.core.toml import Json
from rigidmd.io.write import columns_text

POSITIONS = {
    "unwrapped": "molecules follow continuous paths",
    "wrapped": "molecules are wrapped into the box. Displacements need unwrapped frames",
}


#: Stages in the table of means of the short report.
SHOWN_STAGES = 2
#: The time-step error of a mean is shown from this fraction of the statistical error on, if it
#: exceeds its error by this factor. Number of its digits.
SHOWN_BIAS, SEEN, SHOWN_DIGITS = 1 / 3, 2.0, 2
NO_ERROR_MARK = " ± ?"
#: Names of ensembles.
ENSEMBLES = {"nve": "NVE", "nvt": "NVT", "npt": "NPT", "nph": "NPH"}


def summary_text(
    summary: dict, known: Container[str] = (), described: Mapping[str, Quantity] = QUANTITIES
) -> str:
    """The summary as text, without the notes in `known`. described : the quantities of the scene"""
    species = ", ".join(f"{count} {name}" for name, count in summary["species"].items())
    freedom = summary["degrees_of_freedom"]
    lines = [
        f"{summary['scene']}: {species}; {summary['molecules']} bodies, {summary['sites']} sites,"
        f" {freedom} degrees of freedom ({summary['degrees_of_freedom_translation']} translation,"
        f" {summary['degrees_of_freedom_rotation']} rotation)"
    ]
    for stage in summary["stages"]:
        lines += ["", stage_title(stage), *as_lines(stage_rows(stage, described))]
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
    """Lines of a report with names and values."""
    return [f"  {name:<16}{value}" for name, value in rows]


def last_lines(summary: dict, known: Container[str]) -> list[str]:
    """Notes that are not in `known`, and whether the run was interrupted."""
    notes = [f"\n  note: {note}" for note in summary["notes"] if note not in known]
    return [
        *notes,
        *(["", "  interrupted: these are the results so far"] if summary["interrupted"] else []),
    ]


def orthogonality(summary: dict) -> tuple[str, str]:
    """The row on the largest error of rotation matrices."""
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


def stage_rows(
    stage: dict, described: Mapping[str, Quantity] = QUANTITIES
) -> list[tuple[str, str]]:
    """Names and values of a stage. A row without a name belongs to the row before it."""
    if stage["minimum"]:
        return _minimum_rows(stage, stage["minimum"])
    rows = [("integrator", stage["choice"])] if stage["choice"] else []
    rows.append(("means", f"over {stage['means_over']}"))
    if (mean := _mean_volume(stage)) is not None:
        end = stage["volume_before_nm3"]
        text = f"{mean} nm³, the mean of the stage before, at whose end it was {end:.4g} nm³"
        rows.append(("volume", text))
    means = with_means(described)
    rows += _mean_rows(stage, [row for row in means if row[0].unit == "K"])
    if (scatter := _scatter(stage)) is not None:
        off, size, is_expected = scatter
        before = stage["temperature_before_K"]
        moment = "an NVE stage keeps the energy at its start. Such temperatures scatter by"
        hint = "" if is_expected else ", less than this: equilibrate longer"
        rows.append(("", f"{off:+.2g} K from the {before:g} K before: {moment} {size:.2g} K{hint}"))
    rows += _mean_rows(stage, [row for row in means if row[0].unit != "K"])
    if stage["moves_tried"]:
        accepted = stage["moves_accepted"] / stage["moves_tried"]
        rows.append(("box moves", f"{stage['moves_tried']}, {100 * accepted:.0f} % accepted"))
    if stage.get("acceptance_mean") is not None:
        accepted = 100 * stage["acceptance_mean"]
        size = stage["abs_dH_kT_mean"]
        rows.append(("trajectories", f"{stage['trajectories']}, {accepted:.0f} % accepted"))
        balance = _with_error(stage, "exp_minus_dH{}_mean", 3)
        rows.append(
            ("", f"mean abs(dH) {size:.2g} kT. Mean exp(-dH/kT) {balance}, 1 in equilibrium")
        )
    elif stage["drift_kJ_mol_ns_per_molecule"] is not None:
        rows += _drift_rows(stage)
    return rows


def _mean_rows(stage: dict, means: Iterable[tuple[Quantity, Mean]]) -> Iterator[tuple[str, str]]:
    for title, group in groupby(means, lambda row: row[1].title):
        texts, text, unit = [], None, ""
        for quantity, mean in group:
            if title is None or (text := _with_error(stage, mean.key, mean.digits)) is None:
                continue
            unit = f" {mean.unit or quantity.unit}"
            if mean.label:
                texts.append(f"{mean.label} {text}")
                continue
            if stage[mean.key.format("_error")] is None:
                unit += f" ({NO_ERROR})"
            if (set_point := _set_point(stage, mean)) is not None:
                unit += f", set point {set_point} {quantity.unit}"
            texts.append(text)
        if text is not None:  # T_trans without T_rot is the temperature
            yield str(title), f"{', '.join(texts)}{unit}"


def _drift_rows(stage: dict) -> Iterator[tuple[str, str]]:
    what = "energy" if stage["ensemble"] == "nve" else "conserved energy"
    value = stage["drift_kJ_mol_ns_per_molecule"]
    error = stage["drift_error_kJ_mol_ns_per_molecule"]
    verdict = f": {stage['drift_verdict']}" if stage["drift_verdict"] else ""
    yield "drift", f"{format_signed(value, error)} kJ/mol/ns per molecule ({what}){verdict}"
    if (value := stage["drift_kT_ns_per_degree_of_freedom"]) is not None:
        error = stage["drift_error_kT_ns_per_degree_of_freedom"]
        yield "", f"{format_signed(value, error)} kT/ns per degree of freedom"
        total = f"in total {value * stage['duration_ps'] / 1000:+.2g} kT per degree of freedom"
        if (ratio := stage["drift_over_kinetic_std"]) is not None:
            total += f", {ratio:+.2g} standard deviations of the kinetic energy"
        yield "", total
    noise = stage["energy_rms_kJ_mol_per_molecule"]
    yield "energy noise", f"{noise:.2g} kJ/mol per molecule, rms deviation from the linear fit"


def _with_error(stage: dict, key: str, places: int, no_error: str = "") -> str | None:
    """A mean with its error. `no_error`: stands for an error that it does not have. None without a
    mean."""
    value, error = (stage.get(key.format(of)) for of in ("", "_error"))
    if value is None:
        return None
    if not error:
        return f"{value:.{places}f}{no_error}"
    return format_with_error(value, error) + _step_part(stage, key, error)


def _step_part(stage: dict, key: str, error: float) -> str:
    """What the time step adds to a mean, where this is known and not small against its error."""
    bias, uncertain = (stage.get(key.format(of)) for of in ("_step", "_step_error"))
    if (
        bias is None
        or uncertain is None
        or not abs(bias) > max(SHOWN_BIAS * error, SEEN * uncertain)
    ):
        return ""
    return f", step {bias:+.{SHOWN_DIGITS}g}"


def _set_point(stage: dict, mean: Mean) -> str | None:
    """The set point of a thermostat or barostat, several values if it changes."""
    if (value := stage.get(mean.set_point)) is None:
        return None
    values = value if isinstance(value, Sequence) else [value]
    return (" to " if len(values) == 2 else ", ").join(f"{each:g}" for each in values)


def _mean_volume(stage: dict) -> str | None:
    """The mean volume of the stage before, in which a stage continues."""
    mean = stage.get("volume_nm3")
    return None if mean is None else format_with_error(mean, stage["volume_error_nm3"])


def _scatter(stage: dict) -> tuple[float, float, bool] | None:
    """The temperature of a stage at constant energy less the one before, the scatter of such
    temperatures, and whether this explains the difference."""
    scatter = stage.get("temperature_scatter_K")
    if stage["temperature_K"] is None or scatter is None:
        return None
    off = stage["temperature_K"] - stage["temperature_before_K"]
    return off, scatter, abs(off) < 3 * scatter


def short_summary(
    summary: dict, known: Container[str] = (), described: Mapping[str, Quantity] = QUANTITIES
) -> str:
    """The stages, a table of means of the last ones, and notes, as `summary_text`."""
    stages = summary["stages"]
    moving = [stage for stage in stages if not stage["minimum"]][-SHOWN_STAGES:]
    cells = [[f"{k}", stage["name"], _how(stage)] for k, stage in enumerate(stages)]
    lines = ["", *_indented(cells)]
    if moving:
        lines += ["", *_indented(means_table(moving, described))]
    notes = [note for stage in moving for note in stage_notes(stage)]
    notes += [note for note in summary["notes"] if note not in known]
    if summary["positions"] == "wrapped":
        notes.append("positions are wrapped into the box: displacements need unwrapped frames")
    if any(NO_ERROR_MARK in line for line in lines):
        notes.insert(
            0, f"{NO_ERROR_MARK.strip()} stands for an error that the stage is too short for"
        )
    lines += ["", *(f"  note: {note}" for note in notes)] if notes else []
    if summary["interrupted"]:
        lines += ["", "  interrupted: these are the results so far"]
    return "\n".join(lines)


def _how(stage: dict) -> str:
    if minimum := stage["minimum"]:
        ended = "converged" if minimum["converged"] else f"not converged ({minimum['ended_by']})"
        energy = minimum["energy_after_kJ_mol_per_molecule"]
        density = stage.get("density_g_cm3")
        return (
            f"{ended} in {minimum['iterations']} iterations, {energy:.6g} kJ/mol per molecule"
            + ("" if density is None else f", {density:.4f} g/cm³")
        )
    ensemble = ENSEMBLES.get(stage["ensemble"], stage["ensemble"])
    how = f"{ensemble}, {stage['duration_ps']:g} ps at {stage['timestep_fs']:g} fs"
    if stage["steps_per_s"]:
        how += f", {stage['steps_per_s']:,.0f} steps/s ({stage['ns_per_day']:,.4g} ns/day)"
    return how


def means_table(stages: list[dict], described: Mapping[str, Quantity]) -> list[list[str]]:
    """A header and rows of the means of stages: a column for each stage, then the unit."""
    lines = [["", *(stage["name"] for stage in stages), ""]]
    for title, cells, unit in _table_rows(stages, described):
        if any(cell is not None for cell in cells):
            lines.append([title, *("-" if cell is None else cell for cell in cells), unit])
    return lines


def _indented(cells: list[list[str]]) -> list[str]:
    text = columns_text(cells, left=range(len(cells[0])))
    return [f"  {line}".rstrip() for line in text.splitlines()]


def _table_rows(
    stages: list[dict], described: Mapping[str, Quantity]
) -> Iterator[tuple[str, list[str | None], str]]:
    yield "averaged over", list(map(_averaged_over, stages)), ""
    for quantity, mean in with_means(described):
        title = mean.short or ("" if mean.label else mean.title)
        if title and quantity.is_averaged:
            places = mean.digits if mean.short_digits is None else mean.short_digits
            cells = [_with_error(stage, mean.key, places, NO_ERROR_MARK) for stage in stages]
            yield title, cells, mean.unit or quantity.unit
            yield "  set point", [_set_point(stage, mean) for stage in stages], quantity.unit
    for fraction in (_accepted_moves, _accepted_trajectories):
        yield "moves accepted", list(map(fraction, stages)), "%"
    (drift,) = (mean for quantity, mean in with_means(described) if not quantity.is_averaged)
    yield drift.short, [_drift(stage, drift) for stage in stages], drift.unit
    yield "", [_verdict(stage, drift) for stage in stages], ""


def _averaged_over(stage: dict) -> str | None:
    if stage["means_over"] is None:
        return None
    length = stage["means_over"].partition(",")[0].removeprefix("the ")
    return f"{length.partition(' of ')[0].removesuffix(' ps')} ps"


def _accepted_moves(stage: dict) -> str | None:
    tried = stage.get("moves_tried")
    return f"{100 * stage['moves_accepted'] / tried:.0f}" if tried else None


def _accepted_trajectories(stage: dict) -> str | None:
    fraction = stage.get("acceptance_mean")
    return None if fraction is None else f"{100 * fraction:.0f}"


def _drift(stage: dict, drift: Mean) -> str | None:
    if stage.get("acceptance_mean") is not None:
        return None
    return _with_error(stage, drift.key, drift.digits, NO_ERROR_MARK)


def _verdict(stage: dict, drift: Mean) -> str | None:
    verdict = stage["drift_verdict"]
    if _drift(stage, drift) is None or not verdict:
        return None
    significance, _, *size = verdict.split(", ")  # without the number of standard errors
    return ", ".join([significance, *(words.split()[-1] for words in size)])


def stage_notes(stage: dict) -> list[str]:
    """Sentences on a stage that its numbers need."""
    notes = []
    name = stage["name"]
    over = stage["means_over"] or ""
    if stage["choice"]:
        notes.append(f"{name}: {stage['choice']}")
    if "," in over and "too short" not in over:
        notes.append(f"{name}: averaged over {over}")
    if (mean := _mean_volume(stage)) is not None:
        notes.append(f"{name} has the mean volume of the stage before, {mean} nm³")
    if (scatter := _scatter(stage)) is not None:
        off, size, is_expected = scatter
        side = "above" if off > 0 else "below"
        advice = "" if is_expected else ", so equilibrate longer"
        notes.append(
            f"{name} is {abs(off):.2g} K {side} the set point of the stage before; ± {size:.2g} K"
            f" is expected{advice} at constant energy"
        )
    return notes


def energy_lines(name: str, energies: Json, unit: str) -> list[str]:
    """Energies of the start of molecules, of `MolecularRun.start_energy`, as text."""
    molecules, steps = energies["molecules"], energies["overlap_removal_steps"]
    title = f"{name}: {molecules} molecules at the start"
    title += ", before the minimisation" * energies["before_minimisation"]
    lines = [f"{title}, after {steps} steps of overlap removal" if steps else title]
    lines += [f"  {note}" for note in energies["notes"]]
    terms = energies["components"] | {
        key: energies[key] for key in ("potential", "kinetic", "virial")
    }
    lines.append(f"  {f'energies ({unit})':<22}{'total':>22}{'per molecule':>22}")
    lines += [
        f"  {term.replace('_', ' '):<22}{value:>22.10g}{value / molecules:>22.10g}"
        for term, value in terms.items()
    ]
    rows = []
    if (lattice_energy := energies["lattice_energy_per_molecule"]) is not None:
        rows.append(("lattice energy", lattice_energy, f"{unit} per molecule"))
    if energies["pressure_bar"] is not None:
        rows.append(("pressure", energies["pressure_bar"], "bar"))
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
