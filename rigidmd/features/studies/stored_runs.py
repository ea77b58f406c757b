"""Reads the folder of a run or a sweep as results. Nothing is written, locked or computed."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import overload

from rigidmd.core.state import State
from rigidmd.core.state_file import read_state
from rigidmd.errors import CheckpointError, StructureError
from rigidmd.features.studies.sweep.folder import read_manifest
from rigidmd.features.studies.sweep.table import Table, table_of
from rigidmd.formats.atoms import Frame
from rigidmd.io.checkpoint import latest
from rigidmd.io.folder import FINAL, SWEEP, written_by_runs
from rigidmd.run.kind import kind_of
from rigidmd.run.record import Record, read_record
from rigidmd.run.results import Results
from rigidmd.run.resume import state_from


def read_run(folder: str | Path) -> Results | Table:
    """Open the folder of a run, ended or not, or of a sweep. Nothing is written, locked or
    computed.

    A run gives the `Results` that `Simulation.run` returned, with three differences. Columns that
    log.csv does not have are NaN. The last frame of `results.atoms` has no forces, because nothing
    is computed. A run that has not ended has results so far: its summary has only `interrupted`,
    `notes` and an empty `stages`, its state is the one of the last checkpoint. A sweep gives the
    `Table` that `rigidmd.sweep` returned, with the points that have finished.

    Parameters
    ----------
    folder : str or Path
        Folder of the run or sweep

    Returns
    -------
    Results or Table
        The results of a run, or the table of a sweep

    Raises
    ------
    OutputError
        If the folder has no run, or a damaged one.

    Examples
    --------
        results = rigidmd.read_run("runs/water")
        print(results.mean("temperature"), results.summary)
        print(rigidmd.analysis.rdf(results, "OW", "OW"))

        table = rigidmd.read_run("runs/water-sweep")
        several = [rigidmd.read_run(path) for path in table.runs.values()]
    """
    folder = Path(folder)
    if (folder / SWEEP).is_file():
        return table_of(read_manifest(folder))
    return _results_of(read_record(folder))


def _results_of(record: Record) -> Results:
    summary = record.summary or {"interrupted": True, "notes": [], "stages": []}
    state, problem = _state_of(record)
    notes = [*record.missing, *summary["notes"], *([problem] if problem else [])]
    written = summary.get("files", written_by_runs(record.folder))
    names = dict.fromkeys(Path(name).name for name in written)  # the folder may have been moved
    samples = kind_of(record.scene).samples_of(record)
    results = Results(record.system, state, samples, summary | {"notes": notes})
    results.files = [path for name in names if (path := record.folder / name).is_file()]
    results.interrupted, results._is_stored, results._no_state = (
        bool(summary["interrupted"]),
        True,
        problem,
    )
    if record.scene.output.trajectory:
        results._frames = StoredFrames(record)
    return results


def _state_of(record: Record) -> tuple[State | None, str]:
    """The final state of a run, or the state of its last checkpoint. If there is none, None and
    why."""
    path = record.folder / FINAL
    start = record.system.state
    try:
        if record.summary is not None and path.is_file():
            found = read_state(path).state
            if found.position.shape != start.position.shape:
                raise ValueError(
                    f"{path} is of {len(found.position)} molecules, not of {len(start.position)}"
                )
            return found, ""
        arrays = latest(record.folder)[0].of("state").arrays
        return state_from(
            arrays, start._replace(extra_variables=arrays["extra_variables"]), exact=False
        ), ""
    except (CheckpointError, StructureError, ValueError, KeyError) as error:
        return None, f"the final state is not available: {error}"


class StoredFrames(Sequence[Frame]):
    """The frames of a trajectory file, of which only the times are read, when they are first
    needed."""

    def __init__(self, record: Record):
        self._record = record

    @cached_property
    def _frames(self) -> list[Frame]:
        from rigidmd.io.trajectory import read_times  # MDAnalysis is slow to import

        sites = len(self._record.system.sites.mass)
        return [Frame(time) for time in read_times(self._record.trajectory, sites).tolist()]

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...
    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        return self._frames[index]
