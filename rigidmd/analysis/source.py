"""Where histories come from: the folder of a run, or results in memory; and where production begins."""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.analysis.history import History, rebuilt
from rigidmd.core.state import NO_CELL
from rigidmd.engines.samples import moving
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.io.pressure import TENSOR_FILE, read_tensor
from rigidmd.io.trajectory import read_frames
from rigidmd.run.record import Record
from rigidmd.scene.stage import Stage

if TYPE_CHECKING:
    from rigidmd.run.results import Results

#: Numbers of 8 bytes that frames may take in memory; a trajectory that needs more is thinned out.
MOST_NUMBERS = 150_000_000
#: Samples of a stage without which its equilibration is not looked for.
FEW = 40
#: Thermostats that act on the motion of single molecules.
DISTURBING = ("langevin", "andersen")


def of_folder(
    record: Record, start: float | None = None, step: Callable[[float], object] = lambda share: None
) -> History:
    """The history of a run of molecules from its folder, from `start` (ps) on or where production begins.

    step : called with the share that is done. Raises OutputError.
    """
    if record.is_body:
        raise OutputError(
            f"{record.folder} is the run of a single body, and analyses are of molecules; `rigidmd report` shows it"
        )
    system = record.molecules
    output = system.scene.output
    if not output.trajectory:
        raise OutputError(f"{record.folder}: this run wrote no trajectory (output.trajectory = false) to analyse")
    path = record.folder / output.trajectory
    if not path.is_file():
        raise OutputError(f"{record.folder}: its trajectory {output.trajectory} is not there")
    sites = system.site_count
    most = max(2, MOST_NUMBERS // (3 * sites + 18 * len(system.model.species)))
    frames = read_frames(path, sites, most)
    tensor = read_tensor(record.folder / TENSOR_FILE)
    notes = list(record.missing)
    if frames.stride > 1:
        notes.append(f"every {frames.stride}th frame is used: {frames.count} are more than memory should hold")
    if frames.is_cut:
        notes.append(f"{path.name} ends within a frame, which is left out")
    cells = np.tile(NO_CELL, (len(frames.time), 1, 1)) if frames.cells is None else frames.cells
    raw = _Raw(frames.time, frames.positions, frames.velocities, cells, output.positions == "wrapped")
    try:
        return _history(system, record.columns, raw, tensor, start, notes, step)
    except OutputError as error:
        raise OutputError(f"{path}: {error}") from None


def of_results(results: "Results", start: float | None = None) -> History:
    """The history of a run of molecules in this process. Raises OutputError."""
    from rigidmd.run.record import read_record

    system = results.system
    if not isinstance(system, System):
        raise OutputError("this is the run of a single body, and analyses are of molecules")
    if results.files:
        return of_folder(read_record(results.files[0].parent), start)
    frames = results._frames
    if not frames:
        raise OutputError("this run kept no frames (output.trajectory = false) to analyse")
    raw = _Raw(
        np.array([frame.time for frame in frames]),
        np.array([frame.positions for frame in frames]),
        np.array([frame.velocities for frame in frames]),
        np.array([frame.cell for frame in frames]),
        system.scene.output.positions == "wrapped",
    )
    columns = {name: results[name] for name in results.units}
    return _history(system, columns, raw, results._tensor, start, [], lambda share: None)


def production_of(record: Record) -> tuple[Stage, np.ndarray]:
    """The last stage of a run of molecules in which time passes, and which samples of the log are of its production.

    Raises OutputError.
    """
    columns = record.columns
    stage, first, last, shown = _last_stage(record.molecules, columns)
    time = columns["time"]
    begin = production(columns, shown & (time >= first) & (time <= last), stage.changes_box)
    return stage, shown & (time >= begin) & (time <= last)


class _Raw(NamedTuple):
    """Frames as they were written: times (f,), sites and velocities (f, s, 3), cells (f, 3, 3); whether centres were
    put into the box."""

    time: np.ndarray
    sites: np.ndarray
    velocities: np.ndarray | None
    cells: np.ndarray
    wrapped: bool


def _history(
    system: System,
    columns: dict[str, np.ndarray],
    raw: _Raw,
    tensor: np.ndarray | None,
    start: float | None,
    notes: list[str],
    step: Callable[[float], object],
) -> History:
    stage, first, last, shown = _last_stage(system, columns)
    if start is None:
        own = shown & (columns["time"] >= first) & (columns["time"] <= last)
        begin = production(columns, own, stage.changes_box)
        notes = [*notes, f"production begins at {begin:g} ps, as detected in the stage from {first:g} to {last:g} ps"]
    else:
        begin = start
        if begin < first:
            notes = [*notes, f"frames before {first:g} ps are of an earlier stage"]
    if stage.thermostat_kind in DISTURBING:
        notes = [
            *notes,
            f"the thermostat {stage.thermostat_kind} acts on each molecule: it slows diffusion and turning, and "
            "changes spectra and viscosity; take nve or velocity_rescaling for those",
        ]
    slack = 1e-6 * max(abs(last), 1.0)
    keep = np.flatnonzero((raw.time >= begin - slack) & (raw.time <= last + slack))
    times = _evened(raw.time[keep])
    keep, times = (of[np.diff(times, append=np.inf) > 0] for of in (keep, times))
    if len(keep) < 2:
        raise OutputError(
            f"from {begin:g} ps on there {'is' if len(keep) == 1 else 'are'} {len(keep)} of {len(raw.time)} "
            "frames; an analysis needs two at least: run longer, or write them more often (trajectory_interval_ps)"
        )
    velocities = None if raw.velocities is None else raw.velocities[keep]
    bodies, mended = rebuilt(system, raw.sites[keep], velocities, raw.cells[keep], raw.wrapped, step)
    if not all(np.isfinite(array).all() for array in bodies if array is not None):
        raise OutputError("a frame holds what is no finite number")
    samples = shown & (columns["time"] >= begin - slack) & (columns["time"] <= last + slack)
    if tensor is not None:
        tensor = tensor[(tensor[:, 0] >= begin - slack) & (tensor[:, 0] <= last + slack)]
    return History(
        system=system,
        stage=stage,
        time=times,
        cell=raw.cells[keep],
        positions=bodies.position,
        Q=bodies.Q,
        velocities=bodies.velocity,
        L=bodies.L,
        columns={name: values[samples] for name, values in columns.items()},
        tensor=tensor,
        notes=[*notes, *mended],
    )


def _evened(time: np.ndarray) -> np.ndarray:
    """Times (f,) of frames without the rounding of files to single precision, if nothing else makes them uneven."""
    even = np.linspace(time[0], time[-1], len(time)) if len(time) else time
    rounding = np.spacing(np.abs(time).max(initial=0.0).astype(np.float32))
    return even if np.all(np.abs(even - time) <= 2 * rounding) else time


def _last_stage(system: System, columns: dict[str, np.ndarray]):
    """The last stage in which time passes and of which there are samples, its begin and end, ps, and which samples (l,)
    are of motion."""
    time, stages = columns["time"], system.scene.stages
    if all(stage.is_minimisation for stage in stages):
        raise OutputError("this run is a minimisation, in which no time passes: there is nothing to average")
    shown = moving(stages, columns["stage"])
    for k in reversed(range(len(stages))):
        own = np.flatnonzero(shown & (columns["stage"] == k))
        if len(own) and time[own[-1]] > (first := time[max(0, own[0] - 1)]):
            return stages[k], float(first), float(time[own[-1]]), shown
    raise OutputError("the run has not come to a stage in which time passes")


def production(columns: dict[str, np.ndarray], own: np.ndarray, box_moves: bool) -> float:
    """Time (ps) at which a stage, the samples `own`, is equilibrated.

    By the potential energy, and by the density if the box moves; the later one of the two. See `steady_from`.
    """
    time = columns["time"][own]
    if len(time) < FEW:
        return float(time[0])
    begin = 0
    for name in ("potential", "density") if box_moves else ("potential",):
        begin = max(begin, steady_from(columns[name][own]))
    return float(time[begin])


def steady_from(values: np.ndarray) -> int:
    """Index in the first half of a series (n,) from which on its mean has the smallest standard error, were its values
    independent: the marginal standard error rule (White 1997, Simulation 69, 323)."""
    left = np.arange(len(values), 0, -1)
    sums, squares = (np.cumsum(x[::-1])[::-1] for x in (values - values.mean(), (values - values.mean()) ** 2))
    error = (squares - sums**2 / left) / left.astype(float) ** 2
    return int(np.argmin(error[: len(values) // 2 + 1]))
