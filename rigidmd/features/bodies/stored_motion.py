"""Reading of the motion of a stored run of a body."""

from pathlib import Path

import numpy as np

from rigidmd.core.state import State
from rigidmd.errors import CheckpointError, OutputError
from rigidmd.features.bodies.keys.body import MOTION
from rigidmd.features.bodies.motion import COLUMNS, NAMES, motion, states_of
from rigidmd.features.bodies.system import BodySystem
from rigidmd.io.checkpoint import latest
from rigidmd.io.run_files import Columns, read_columns


def columns_of_run(folder: Path, system: BodySystem, missing: list[str]) -> dict[str, np.ndarray]:
    """Columns of motion.csv, or, of a run that has not written it, of its last checkpoint."""
    if (columns := read_motion(folder / MOTION)) is not None:
        needed = motion(system, [system.state]).columns
        if lacking := [COLUMNS[name].header for name in needed if name not in columns.cells]:
            raise OutputError(
                f"{columns.path} is not the motion of this run: it has no column {lacking[0]!r}"
            )
        return {name: columns.numbers(name, finite=name in needed) for name in columns.cells}
    try:
        checkpoint, _ = latest(folder)
    except CheckpointError:
        return {}
    for owner in checkpoint.values.get("of", {}):
        part = checkpoint.of(owner).arrays
        if "stacked/time" in part:  # of `run.Sampler`
            states = states_of({name: part[f"stacked/{name}"] for name in State._fields})
            missing.append(
                f"{MOTION} is written at the end. The motion shown ends at the last checkpoint."
            )
            return motion(system, states).columns
    return {}


def read_motion(path: Path) -> Columns | None:
    """motion.csv as `read_columns`, its columns by their names in Python, as far as they are known;
    of any version."""
    columns_read = read_columns(path)
    return columns_read and Columns(
        path,
        {NAMES.get(header, header): c for header, c in columns_read.cells.items()},
    )
