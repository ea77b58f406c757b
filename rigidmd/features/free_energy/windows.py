"""The windows of a sweep over a restrained distance, and their potential of mean force."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigidmd.core.quantities import restrained_distance
from rigidmd.core.toml import Json
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.features.analysis.registry import SweepAnalysis
from rigidmd.features.analysis.result import AnalysisResult
from rigidmd.features.analysis.rigid_frames import production_samples
from rigidmd.features.free_energy.mean_force import (
    ABOUT,
    NAME,
    OVER,
    Window,
    potential_of_mean_force,
)
from rigidmd.features.studies.sweep.folder import SEED, Manifest, read_manifest
from rigidmd.features.studies.sweep.table import Table
from rigidmd.run.record import Record, read_record
from rigidmd.scene import is_molecular
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

KEY = re.compile(r"fields\.restraints\.(\d+)\.(distance_A|stiffness_kJ_mol_A2)")
DISTANCE = "fields.restraints.0.distance_A"


def is_of_windows(manifest: Manifest) -> bool:
    """Whether a sweep varies the distance of a restraint."""
    return any(KEY.fullmatch(key) and key.endswith("distance_A") for key in manifest.keys)


def pmf(sweep: Table | str | Path) -> AnalysisResult:
    """The potential of mean force along the restrained distance of a sweep, by all its windows.

    Points that have not finished are omitted. Nothing is written.

    Parameters
    ----------
    sweep : Table, str or Path
        What `rigidmd.sweep` or `rigidmd.read_run` returned, or the folder of a sweep

    Returns
    -------
    AnalysisResult
        The curve of the potential of mean force (kJ/mol) against the distance (Å), with errors

    Raises
    ------
    OutputError
        If the folder has no such sweep, or no point has finished.
    """
    return _mean_force(manifest_of(sweep))[0]


def manifest_of(sweep: Table | str | Path) -> Manifest:
    """The manifest of a sweep or of its folder. Raises OutputError."""
    return read_manifest(sweep.folder if isinstance(sweep, Table) else Path(sweep))


def _mean_force(manifest: Manifest) -> tuple[AnalysisResult, Json]:
    """The potential of mean force, and the samples used, as analysis.json has them."""
    folder = manifest.folder
    points = manifest.points_in("finished")
    if not points:
        raise OutputError(f"{folder}: no point of the sweep has finished")
    keys = manifest.keys.keys() - {SEED}
    restraints = {match[1] for key in keys if (match := KEY.fullmatch(key))}
    others = [key for key in keys if not KEY.fullmatch(key)]
    problem = ""
    if not is_of_windows(manifest):
        problem = f"a sweep over the distance of a restraint, such as {DISTANCE}"
    elif others:
        problem = f"windows that differ by their restraint alone, not by {others[0]}"
    elif len(restraints) > 1:
        problem = f"windows of one restraint. The sweep varies {len(restraints)}"
    if problem:
        raise OutputError(f"{folder}: pmf needs {problem}")
    k = int(restraints.pop())
    windows, temperatures, uses = zip(
        *(_window(folder / point.folder, k) for point in points), strict=True
    )
    if len({*temperatures}) > 1:
        raise OutputError(f"{folder}: the windows have different temperatures")
    thermal_energy = BOLTZMANN * temperatures[0] / KJ_PER_MOL
    return potential_of_mean_force(windows, thermal_energy), used_together(uses)


def production_of(folder: Path) -> tuple[Record[System], Stage, np.ndarray]:
    """A run of molecules, its last stage and which samples are of production. Raises
    OutputError."""
    record = read_record(folder)
    if not is_molecular(record.scene):
        raise OutputError(f"{folder} is a run of {record.scene.subject}, which has no molecules")
    return record, *production_samples(record)


def used_samples(record: Record, stage: Stage, production: np.ndarray) -> Json:
    """The samples used, as analysis.json has them."""
    time = record.time[production]
    return {
        "stage": stage.label,
        "from_ps": float(time[0]),
        "to_ps": float(time[-1]),
        "frames": len(time),
        "notes": [],
    }


def used_together(uses: Sequence[Json]) -> Json:
    """The samples used of several runs."""
    return uses[-1] | {
        "from_ps": min(use["from_ps"] for use in uses),
        "to_ps": max(use["to_ps"] for use in uses),
        "frames": sum(use["frames"] for use in uses),
    }


def _window(folder: Path, k: int) -> tuple[Window, float, Json]:
    """The window of a run, its temperature (K), and the samples used."""
    record, stage, production = production_of(folder)
    column = restrained_distance(k)
    if column.name not in record.columns:
        problem = f"fields.restraints.{k} has no `between`"
        raise OutputError(f"{folder}: its log has no column {column.header!r}: {problem}")
    if stage.temperature_K is None or stage.ramps or stage.changes_box:
        raise OutputError(
            f"{folder}: the windows need a last stage at constant temperature and volume (nvt)"
        )
    restraint = record.system.scene.fields.restraints[k]
    samples = record.columns[column.name][production]
    window = Window(not_none(restraint.distance_A), restraint.stiffness[0], samples)
    return window, float(stage.temperatures[1]), used_samples(record, stage, production)


SWEEP_ANALYSIS = SweepAnalysis(NAME, ABOUT, OVER, "all windows", is_of_windows, _mean_force)
