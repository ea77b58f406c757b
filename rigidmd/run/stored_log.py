"""Reading of the log of a run of molecules."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigidmd.core.quantities import energy_of_force
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.io.folder import LOG
from rigidmd.io.run_files import columns, read_columns
from rigidmd.scene.stage import Stage


def read_log(folder: Path, system: System) -> dict[str, np.ndarray]:
    """Columns of log.csv by their names in `results[...]`, with the index of the stage."""
    read = read_columns(folder / LOG)
    if read is None:
        raise OutputError(f"{folder / LOG} cannot be read: there is no such file")
    known = {header: name for name, header in columns(system.quantities).items()}
    unit = energy_of_force("E").header.removeprefix("E")
    headers = {
        known.get(header) or header.removesuffix(unit): header
        for header in read.cells
        if header in known or header.endswith(unit)
    }
    if lacking := [name for name in ("step", "time", "stage_name") if name not in headers]:
        header = system.quantities[lacking[0]].header
        raise OutputError(f"{read.path} is not a log of rigidmd: it has no column {header!r}")
    arrays = {
        name: np.array(read.cells[header])
        if name == "stage_name"
        else read.numbers(header, finite=name == "time")
        for name, header in headers.items()
    }
    stage = _stage_of(arrays["stage_name"], arrays["time"], system.scene.stages)
    return arrays | {"stage": stage}


def _stage_of(names: np.ndarray, time: np.ndarray, stages: Sequence[Stage]) -> np.ndarray:
    """Index of the stage of each row. Stages with the same name are distinguished by their
    times."""
    stage_of_row = np.full(len(names), len(stages) - 1)
    first = 0
    end = 0.0
    for k, stage in enumerate(stages[:-1]):
        end += stage.duration
        of_stage = (names[first:] == stage.label) & (time[first:] <= end + 0.5 * stage.step)
        count = len(of_stage) if of_stage.all() else int(of_stage.argmin())
        stage_of_row[first : first + count] = k
        first += count
    return stage_of_row
