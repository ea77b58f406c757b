"""Frames for analyses, from the folder of a run or from results in memory; and where production begins."""

from collections.abc import Callable

import numpy as np

from rigidmd.analysis.rigid_frames import RigidFrames, fit_frames
from rigidmd.core.state import NO_CELL
from rigidmd.engines.samples import moving
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.io.run_files import TENSOR_FILE, read_tensor
from rigidmd.io.trajectory import Frames, read_frames
from rigidmd.run.record import Record, read_record
from rigidmd.run.results import Results
from rigidmd.scene.stage import Stage

#: Most numbers of 8 bytes of frames in memory; a longer trajectory is thinned out.
MOST_NUMBERS = 150_000_000
#: Least samples of a stage for the detection of its equilibration.
MIN_SAMPLES = 40


def frames_of_folder(
    record: Record, start: float | None = None, progress: Callable[[float], object] = lambda fraction: None
) -> RigidFrames:
    """The frames of a run of molecules in a folder, from `start` (ps) on, or from where production begins.

    progress : called with the fraction done. Raises OutputError.
    """
    if record.is_body:
        raise OutputError(
            f"{record.folder} is a run of a single body, and analyses are for molecules; `rigidmd report` shows it"
        )
    system, path = record.molecules, record.trajectory
    most = max(2, MOST_NUMBERS // (3 * system.site_count + 18 * len(system.model.species)))
    frames = read_frames(path, system.site_count, most)
    tensor = read_tensor(record.folder / TENSOR_FILE)
    notes = list(record.missing)
    if frames.stride > 1:
        notes.append(f"every {frames.stride}th frame is used: {frames.count} need too much memory")
    if frames.is_cut:
        notes.append(f"{path.name} ends within a frame, which is left out")
    try:
        return _rigid_frames(system, record.columns, frames, tensor, start, notes, progress)
    except OutputError as error:
        raise OutputError(f"{path}: {error}") from None


def frames_of_results(results: Results, start: float | None = None) -> RigidFrames:
    """The frames of a run of molecules in this process. Raises OutputError."""
    system = results.system
    if not isinstance(system, System):
        raise OutputError("this is a run of a single body, and analyses are for molecules")
    if results.files:
        return frames_of_folder(read_record(results.files[0].parent), start)
    frames = results._frames
    if not frames:
        raise OutputError("this run has no frames (output.trajectory = false) to analyse")
    count, cells = len(frames), np.array([frame.cell for frame in frames])
    time, positions, velocities = (
        np.array([getattr(frame, name) for frame in frames]) for name in ("time", "positions", "velocities")
    )
    stored = Frames(time, positions, cells, count, 1, False, velocities)
    columns = {name: results[name] for name in results.units}
    return _rigid_frames(system, columns, stored, results._tensor, start, [], lambda fraction: None)


def production_samples(record: Record) -> tuple[Stage, np.ndarray]:
    """The last stage of a run in which time passes, and which samples are of its production. Raises OutputError."""
    columns = record.columns
    stage, first, last, shown = _last_stage(record.molecules, columns)
    time = columns["time"]
    begin = production_start(columns, shown & (time >= first) & (time <= last), stage.changes_box)
    return stage, shown & (time >= begin) & (time <= last)


def _rigid_frames(
    system: System, columns: dict[str, np.ndarray], stored: Frames, tensor: np.ndarray | None,
    start: float | None, notes: list[str], progress: Callable[[float], object],
) -> RigidFrames:  # fmt: skip
    stage, first, last, shown = _last_stage(system, columns)
    if start is None:
        of_stage = shown & (columns["time"] >= first) & (columns["time"] <= last)
        begin = production_start(columns, of_stage, stage.changes_box)
        notes.append(f"production begins at {begin:g} ps, as detected in the stage from {first:g} to {last:g} ps")
    else:
        begin = start
        notes += [f"frames before {first:g} ps are of an earlier stage"] if begin < first else []
    if not stage.keeps_momentum:
        notes.append(
            f"the thermostat {stage.thermostat_kind} acts on each molecule: it slows diffusion and rotation, and "
            "changes spectra and viscosity; use nve or velocity_rescaling for these"
        )
    slack = 1e-6 * max(abs(last), 1.0)
    keep = np.flatnonzero((stored.time >= begin - slack) & (stored.time <= last + slack))
    times = _without_rounding(stored.time[keep])
    keep, times = (of[np.diff(times, append=np.inf) > 0] for of in (keep, times))
    if len(keep) < 2:
        raise OutputError(
            f"from {begin:g} ps on there {'is' if len(keep) == 1 else 'are'} {len(keep)} of {len(stored.time)} "
            "frames; an analysis needs at least two: run longer, or write frames more often (trajectory_interval_ps)"
        )
    velocities = None if stored.velocities is None else stored.velocities[keep]
    cells = np.tile(NO_CELL, (len(keep), 1, 1)) if stored.cells is None else stored.cells[keep]
    wrapped = system.scene.output.positions == "wrapped"
    bodies, corrections = fit_frames(system, stored.positions[keep], velocities, cells, wrapped, progress)
    if not all(np.isfinite(array).all() for array in bodies if array is not None):
        raise OutputError("a frame has values that are not finite numbers")
    samples = shown & (columns["time"] >= begin - slack) & (columns["time"] <= last + slack)
    if tensor is not None:
        tensor = tensor[(tensor[:, 0] >= begin - slack) & (tensor[:, 0] <= last + slack)]
    return RigidFrames(
        system, stage, times, cells, bodies.position, bodies.Q, bodies.velocity, bodies.L,
        {name: values[samples] for name, values in columns.items()}, tensor, [*notes, *corrections],
    )  # fmt: skip


def _without_rounding(time: np.ndarray) -> np.ndarray:
    """Times (f,) of frames without the rounding of files to single precision, if nothing else makes them uneven."""
    even = np.linspace(time[0], time[-1], len(time)) if len(time) else time
    rounding = np.spacing(np.abs(time).max(initial=0.0).astype(np.float32))
    return even if np.all(np.abs(even - time) <= 2 * rounding) else time


def _last_stage(system: System, columns: dict[str, np.ndarray]):
    """The last stage with samples in which time passes, its begin and end, ps, and which samples (l,) are of motion."""
    time, stages = columns["time"], system.scene.stages
    if all(stage.is_minimisation for stage in stages):
        raise OutputError("this run is a minimisation, in which no time passes: there is nothing to average")
    shown = moving(stages, columns["stage"])
    for k in reversed(range(len(stages))):
        of_stage = np.flatnonzero(shown & (columns["stage"] == k))
        if len(of_stage) and time[of_stage[-1]] > (first := time[max(0, of_stage[0] - 1)]):
            return stages[k], float(first), float(time[of_stage[-1]]), shown
    raise OutputError("the run has not reached a stage in which time passes")


def production_start(columns: dict[str, np.ndarray], of_stage: np.ndarray, box_moves: bool) -> float:
    """Time (ps) at which a stage, the samples `of_stage`, is equilibrated: the later one of the times for the potential
    energy and, if the box moves, the density. See `steady_from`."""
    time = columns["time"][of_stage]
    if len(time) < MIN_SAMPLES:
        return float(time[0])
    names = ("potential", "density") if box_moves else ("potential",)
    return float(time[max(steady_from(columns[name][of_stage]) for name in names)])


def steady_from(values: np.ndarray) -> int:
    """Index in the first half of a series (n,) from which on its mean has the smallest standard error of independent
    values: the marginal standard error rule (White 1997, Simulation 69, 323)."""
    left = np.arange(len(values), 0, -1)
    sums, squares = (np.cumsum(x[::-1])[::-1] for x in (values - values.mean(), (values - values.mean()) ** 2))
    error = (squares - sums**2 / left) / left.astype(float) ** 2
    return int(np.argmin(error[: len(values) // 2 + 1]))
