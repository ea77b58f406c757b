"""The short summary of a run of molecules: its stages, a table of means, and notes."""

from collections.abc import Callable, Container
from typing import NamedTuple

from rigidmd.core.statistics import format_with_error
from rigidmd.io.write import columns_text

#: Stages in the table of means; --verbose prints all.
SHOWN_STAGES = 2
NO_ERROR_MARK = " ± ?"
#: Names of ensembles.
ENSEMBLES = {"nve": "NVE", "nvt": "NVT", "npt": "NPT", "nph": "NPH"}


def short_summary(summary: dict, known: Container[str] = ()) -> str:
    """The short summary of a run as text, without the notes in `known`."""
    stages = summary["stages"]
    moving = [stage for stage in stages if not stage["minimum"]][-SHOWN_STAGES:]
    lines = ["", *_stage_lines(stages)]
    if moving:
        lines += ["", *_table(moving)]
    notes = [note for stage in moving for note in _stage_notes(stage)]
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


def _stage_lines(stages: list[dict]) -> list[str]:
    """A line for each stage: its number in keys, name, and how it ran."""
    cells = [[f"{k}", stage["name"], _how(stage)] for k, stage in enumerate(stages)]
    return [f"  {line}" for line in columns_text(cells, left=(0, 1, 2)).splitlines()]


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


class Row(NamedTuple):
    """A row of the table: its title, its cell for a stage, or None without a value, and its
    unit."""

    title: str
    cell: Callable[[dict], str | None]
    unit: str = ""


def _measured(name: str, unit: str, places: int) -> Callable[[dict], str | None]:
    """The cell of a mean with its error, under the keys of a summary."""

    def cell(stage: dict) -> str | None:
        value, error = stage.get(f"{name}_{unit}"), stage.get(f"{name}_error_{unit}")
        if value is None:
            return None
        return format_with_error(value, error) if error else f"{value:.{places}f}{NO_ERROR_MARK}"

    return cell


def _set_point(key: str) -> Callable[[dict], str | None]:
    """The cell of the set point of a thermostat or barostat. Several values if it changes."""

    def cell(stage: dict) -> str | None:
        value = stage[key]
        if value is None:
            return None
        values = value if isinstance(value, list | tuple) else [value]
        return (" to " if len(values) == 2 else ", ").join(f"{each:g}" for each in values)

    return cell


def _averaged_over(stage: dict) -> str | None:
    if stage["means_over"] is None:
        return None
    length = stage["means_over"].partition(",")[0].removeprefix("the ")
    return f"{length.partition(' of ')[0].removesuffix(' ps')} ps"


def _fraction(accepted: str, tried: str) -> Callable[[dict], str | None]:
    def cell(stage: dict) -> str | None:
        return f"{100 * stage[accepted] / stage[tried]:.0f}" if stage.get(tried) else None

    return cell


def _accepted_trajectories(stage: dict) -> str | None:
    fraction = stage.get("acceptance_mean")
    return None if fraction is None else f"{100 * fraction:.0f}"


def _drift(stage: dict) -> str | None:
    if stage.get("acceptance_mean") is not None:
        return None
    return _measured("drift", "kT_ns_per_degree_of_freedom", 4)(stage)


def _verdict(stage: dict) -> str | None:
    verdict = stage["drift_verdict"]
    if _drift(stage) is None or not verdict:
        return None
    significance, _, *size = verdict.split(", ")  # without the number of standard errors
    return ", ".join([significance, *(words.split()[-1] for words in size)])


DRIFT_UNIT = "kT/ns per degree of freedom"
ROWS = (
    Row("averaged over", _averaged_over),
    Row("temperature", _measured("temperature", "K", 1), "K"),
    Row("  set point", _set_point("set_temperature_K"), "K"),
    Row("  translational", _measured("temperature_translation", "K", 1), "K"),
    Row("  rotational", _measured("temperature_rotation", "K", 1), "K"),
    Row(
        "potential energy", _measured("potential", "kJ_mol_per_molecule", 3), "kJ/mol per molecule"
    ),
    Row("pressure", _measured("pressure", "bar", 0), "bar"),
    Row("  set point", _set_point("set_pressure_bar"), "bar"),
    Row("density", _measured("density", "g_cm3", 4), "g/cm³"),
    Row("moves accepted", _fraction("moves_accepted", "moves_tried"), "%"),
    Row("moves accepted", _accepted_trajectories, "%"),
    Row("energy drift", _drift, DRIFT_UNIT),
    Row("", _verdict),
)


def _table(stages: list[dict]) -> list[str]:
    """Means of stages: a column for each stage, then the unit."""
    lines = [["", *(stage["name"] for stage in stages), ""]]
    for row in ROWS:
        cells = [row.cell(stage) for stage in stages]
        if any(cell is not None for cell in cells):
            lines.append([row.title, *("-" if cell is None else cell for cell in cells), row.unit])
    text = columns_text(lines, left=range(len(lines[0])))
    return [f"  {line}".rstrip() for line in text.splitlines()]


def _stage_notes(stage: dict) -> list[str]:
    """Sentences on a stage that its numbers need."""
    notes = []
    name = stage["name"]
    over = stage["means_over"] or ""
    if stage["choice"]:
        notes.append(f"{name}: {stage['choice']}")
    if "," in over and "too short" not in over:
        notes.append(f"{name}: averaged over {over}")
    if stage.get("volume_nm3") is not None:
        mean = format_with_error(stage["volume_nm3"], stage["volume_error_nm3"])
        notes.append(f"{name} has the mean volume of the stage before, {mean} nm³")
    scatter = stage.get("temperature_scatter_K")
    if stage["temperature_K"] is not None and scatter is not None:
        off = stage["temperature_K"] - stage["temperature_before_K"]
        side = "above" if off > 0 else "below"
        verdict = (
            f"± {scatter:.2g} K is expected"
            if abs(off) < 3 * scatter
            else f"± {scatter:.2g} K is expected, so equilibrate longer"
        )
        notes.append(
            f"{name} is {abs(off):.2g} K {side} the set point before; {verdict} at constant energy"
        )
    return notes
