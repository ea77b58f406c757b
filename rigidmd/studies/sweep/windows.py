"""The windows of a sweep over a restrained distance, and their potential of mean force."""

import re
from pathlib import Path
from typing import Any

from rigidmd.analysis.files import write_results
from rigidmd.analysis.mean_force import Window, potential_of_mean_force
from rigidmd.analysis.result import AnalysisResult
from rigidmd.analysis.rigid_frames import production_samples
from rigidmd.engines.samples import distance_column
from rigidmd.errors import OutputError
from rigidmd.run.record import read_record
from rigidmd.scene import MolecularScene
from rigidmd.scene.validation import not_none
from rigidmd.studies.sweep.folder import SEED, Manifest, SweepPoint, read_manifest, state_on_disk
from rigidmd.studies.sweep.table import Table
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

KEY = re.compile(r"fields\.restraints\.(\d+)\.(distance_A|stiffness_kJ_mol_A2)")


def is_of_windows(manifest: Manifest) -> bool:
    """Whether a sweep varies the distance of a restraint."""
    return any((found := KEY.fullmatch(key)) and found[2] == "distance_A" for key in manifest.keys)


def pmf(sweep: Table | str | Path) -> AnalysisResult:
    """The potential of mean force along the restrained distance of a sweep, by all its windows.

    Points that have not finished are left out. Nothing is written.

    Parameters
    ----------
    sweep
        What `rigidmd.sweep` or `rigidmd.read_run` returned, or the folder of a sweep

    Raises
    ------
    OutputError
    """
    folder = sweep.folder if isinstance(sweep, Table) else Path(sweep)
    manifest = read_manifest(folder)
    finished = [point for point in manifest.points if state_on_disk(folder, point) == "finished"]
    if not finished:
        raise OutputError(f"{folder}: no point of the sweep has finished")
    result, _ = mean_force_of_points(folder, manifest, finished)
    return result


def write_mean_force(
    folder: Path, manifest: Manifest, points: list[SweepPoint], figures: str
) -> tuple[AnalysisResult, list[Path]]:
    """`mean_force_of_points`, and the files that it is written to. Raises OutputError."""
    result, used = mean_force_of_points(folder, manifest, points)
    return result, write_results(folder, used, [result], {}, figures)


def mean_force_of_points(
    folder: Path, manifest: Manifest, points: list[SweepPoint]
) -> tuple[AnalysisResult, dict[str, Any]]:
    """The potential of mean force of finished points, and the samples used. Raises OutputError."""
    of = [(key, KEY.fullmatch(key)) for key in manifest.keys]
    if not is_of_windows(manifest):
        key = "fields.restraints.0.distance_A"
        raise OutputError(
            f"{folder}: pmf needs a sweep over the distance of a restraint, such as {key}"
        )
    if other := [key for key, found in of if found is None and key != SEED]:
        raise OutputError(
            f"{folder}: pmf needs windows that differ by their restraint alone, not by {other[0]}"
        )
    numbers = {int(found[1]) for _, found in of if found is not None}
    if len(numbers) > 1:
        raise OutputError(
            f"{folder}: pmf needs windows of one restraint; the sweep varies {len(numbers)}"
        )
    k = numbers.pop()
    windows, temperatures, used = [], set(), {"frames": 0}
    for point in points:
        window, temperature, times = _window(folder / point.folder, k)
        windows.append(window)
        temperatures.add(temperature)
        used = _together(used, times)
    if len(temperatures) > 1:
        raise OutputError(f"{folder}: the windows have different temperatures")
    return potential_of_mean_force(windows, BOLTZMANN * temperatures.pop() / KJ_PER_MOL), used


def _window(folder: Path, k: int) -> tuple[Window, float, dict[str, Any]]:
    """The window of a run, its temperature (K), and the samples used, as analysis.json has them."""
    record = read_record(folder)
    if not isinstance(record.scene, MolecularScene):
        raise OutputError(f"{folder} is a run of a single body, which has no distances")
    stage, production = production_samples(record)
    name, column = distance_column(k)
    if name not in record.columns:
        raise OutputError(
            f"{folder}: its log has no column {column.header!r}: fields.restraints.{k} has no"
            " `between`"
        )
    if stage.temperature_K is None or stage.ramps or stage.changes_box:
        raise OutputError(
            f"{folder}: the windows need a last stage at constant temperature and volume (nvt)"
        )
    entry, time = record.scene.fields.restraints[k], record.time[production]
    used = {
        "stage": stage.label,
        "from_ps": float(time[0]),
        "to_ps": float(time[-1]),
        "frames": len(time),
        "notes": [],
    }
    window = Window(
        not_none(entry.distance_A), entry.stiffness[0], record.columns[name][production]
    )
    return window, float(stage.temperatures[1]), used


def _together(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """The samples used of several runs."""
    if not first["frames"]:
        return second
    return second | {
        "from_ps": min(first["from_ps"], second["from_ps"]),
        "to_ps": max(first["to_ps"], second["to_ps"]),
        "frames": first["frames"] + second["frames"],
    }
