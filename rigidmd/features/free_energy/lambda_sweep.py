"""The points of a sweep over coupling.lambda, and their free energy."""

from pathlib import Path

import numpy as np

from rigidmd.core.toml import Json
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.features.analysis.registry import SweepAnalysis
from rigidmd.features.analysis.result import AnalysisResult
from rigidmd.features.free_energy.coupling import energy_to_lambda
from rigidmd.features.free_energy.estimate import (
    ABOUT,
    NAME,
    OF_ALL,
    OVER,
    SampledLambda,
    free_energy_of,
)
from rigidmd.features.free_energy.keys import Coupling
from rigidmd.features.free_energy.windows import (
    manifest_of,
    production_of,
    used_samples,
    used_together,
)
from rigidmd.features.studies.sweep.folder import SEED, Manifest
from rigidmd.features.studies.sweep.table import Table
from rigidmd.scene.validation import not_none
from rigidmd.units import AVOGADRO, BOLTZMANN, KJ_PER_MOL

KEY = "coupling.lambda"
MOL_PER_LITRE = 1e27 / AVOGADRO  # of one molecule in an Å³


def is_of_coupling(manifest: Manifest) -> bool:
    """Whether a sweep varies lambda."""
    return KEY in manifest.keys


def free_energy(sweep: Table | str | Path) -> AnalysisResult:
    """The free energy of the molecules in [coupling], by all points of a sweep over its lambda.

    Points that have not finished are omitted. Nothing is written. It needs pymbar.

    Parameters
    ----------
    sweep : Table, str or Path
        What `rigidmd.sweep` or `rigidmd.read_run` returned, or the folder of a sweep

    Returns
    -------
    AnalysisResult
        The free energy (kJ/mol) with its error, and its curve against lambda

    Raises
    ------
    OutputError
        If the folder has no such sweep, or too few points have finished.
    """
    return _free_energy(manifest_of(sweep))[0]


def _free_energy(manifest: Manifest) -> tuple[AnalysisResult, Json]:
    folder = manifest.folder
    points = manifest.points_in("finished")
    if manifest.keys.keys() - {SEED} != {KEY}:
        raise OutputError(f"{folder}: {NAME} needs a sweep over {KEY} alone, and over {SEED}")
    lambdas = sorted({float(point.values[KEY]) for point in points})
    if len(lambdas) < 2:
        raise OutputError(f"{folder}: {NAME} needs two values of {KEY} that have finished")
    runs = []
    temperatures = set()
    uses = []
    volumes = []
    for point in points:
        record, stage, production = production_of(folder / point.folder)
        if stage.temperature_K is None or stage.ramps:
            raise OutputError(
                f"{record.folder}: {NAME} needs a last stage at constant temperature (nvt, npt)"
            )
        temperatures.add(float(stage.temperatures[1]))
        names = [energy_to_lambda(value).name for value in lambdas]
        missing = [f"{x:g}" for x, n in zip(lambdas, names, strict=True) if n not in record.columns]
        if missing:
            raise OutputError(
                f"{record.folder}: its log has no energy at lambda = {', '.join(missing)}. List all"
                " values of the sweep in coupling.lambdas"
            )
        changes = np.column_stack([record.columns[name][production] for name in names])
        runs.append((lambdas.index(float(point.values[KEY])), changes))
        uses.append(used_samples(record, stage, production))
        volumes.append(np.mean(record.columns["volume"][production]))
        system = record.system
    if len(temperatures) > 1:
        raise OutputError(f"{folder}: the points have different temperatures")
    thermal = BOLTZMANN * temperatures.pop() / KJ_PER_MOL
    sampled = [SampledLambda(k, changes / thermal) for k, changes in runs]
    parts = _parts(not_none(system.scene.coupling), lambdas)
    result = free_energy_of(lambdas, sampled, thermal, parts)
    value = result.values[0]
    result.values[0] = value._replace(note=_standard_state(system, 1e3 * float(np.mean(volumes))))
    return result, used_together(uses)


def _parts(coupling: Coupling, lambdas: list[float]) -> list[tuple[str, float, float]]:
    """Names of differences of the free energy, with their first and last lambda."""
    first = lambdas[0]
    middle = not_none(coupling.charges_from)
    last = lambdas[-1]
    whole = OF_ALL if (first, last) == (0, 1) else f"free energy from lambda {first:g} to {last:g}"
    parts = [(whole, first, last)]
    if first < middle < last and middle in lambdas:
        parts += [("of Lennard-Jones", first, middle), ("of charges", middle, last)]
    return parts


def _standard_state(system: System, volume: float) -> str:
    """What the free energy is the difference of. volume : Å³"""
    coupling = not_none(system.scene.coupling)
    members = [k for k, m in enumerate(system.species) if m.name == coupling.species]
    count = int(np.isin(system.model.species, members).sum())
    who = f"{count} {coupling.species}" + (" together" if count > 1 else "")
    density = f"{count / volume * MOL_PER_LITRE:.4g} mol/L"
    tail = "with" if system.tail is not None else "without"
    return (
        f"{who}, from an ideal gas of the same number density, {density}, so that no volume enters;"
        f" {tail} tail correction"
    )


SWEEP_ANALYSIS = SweepAnalysis(NAME, ABOUT, OVER, "all points", is_of_coupling, _free_energy)
