"""Frames of a run as rigid bodies, fitted to the positions and velocities of sites: the input of
all analyses.

They are from the folder of a run or from results in memory, by default from where production
starts.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.state import NO_CELL
from rigidmd.engines.samples import equilibrated_from, moving
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.io.run_files import TENSOR_FILE, read_tensor
from rigidmd.io.trajectory import Frames, read_frames, without_rounding
from rigidmd.run.record import Record, read_record
from rigidmd.run.results import Results
from rigidmd.run.rigid_fit import Bodies, Kind, RigidFit, kinds_of
from rigidmd.scene import MolecularScene, is_molecular
from rigidmd.scene.models import Molecule
from rigidmd.scene.species import Molecules
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import did_you_mean
from rigidmd.units import BOLTZMANN

EVEN = 1e-3  # two intervals between frames that differ by less than this fraction are equal
#: Largest fraction of the box that a wrapped molecule may move between two frames to be followed.
MAX_WRAPPED_MOVE = 0.4


@dataclass(frozen=True, eq=False)
class RigidFrames:
    """Frames of a part of a run, for analyses. Molecules are whole and their paths continuous.

    f frames, n molecules. Å, ps, u:
    time (f,), cell (f, 3, 3) rows a, b, c, infinite edges without a box
    positions (f, n, 3) centres of mass, lab frame. Q (f, n, 3, 3) body to lab, principal axes
    velocities (f, n, 3) lab frame, L (f, n, 3) angular momentum along the body's axes. None where
    no frame has them
    columns : samples of the same time by their names in `results[...]`
    tensor : (l, 7) rows of pressure_tensor.csv, ps and bar, of the same time. None if the run wrote
        none
    notes : on the choice and the correction of frames
    why_no_frames : if there are none, which analyses of the samples do not need
    """

    system: System
    stage: Stage
    time: np.ndarray
    cell: np.ndarray
    positions: np.ndarray
    Q: np.ndarray
    velocities: np.ndarray | None
    L: np.ndarray | None
    columns: dict[str, np.ndarray]
    tensor: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)
    why_no_frames: str = ""

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        return f"<RigidFrames: {len(self)} frames over {self.span:g} ps>"

    @property
    def size(self) -> int:
        """Number of numbers in the arrays of frames."""
        arrays = (self.cell, self.positions, self.Q, self.velocities, self.L)
        return sum(array.size for array in arrays if array is not None)

    @property
    def ends(self) -> tuple[float, float]:
        """Times of the first and the last frame, or of the samples if there are no frames, ps."""
        time = self.time if len(self) else self.columns["time"]
        return float(time[0]), float(time[-1])

    @property
    def span(self) -> float:
        """Time from the first frame to the last, ps."""
        begin, end = self.ends
        return end - begin

    @cached_property
    def interval(self) -> float | None:
        """Time between frames, ps. None if they are not evenly spaced."""
        gaps = np.diff(self.time)
        # files hold times in single precision
        rounding = 2 * float(np.spacing(np.float32(np.abs(self.time).max())))
        if len(gaps) == 0 or gaps.min() <= 0 or np.ptp(gaps) > EVEN * gaps.max() + rounding:
            return None
        return self.span / len(gaps)

    @property
    def has_box(self) -> bool:
        cell = self.cell[0] if len(self) else self.system.state.cell
        return bool(np.isfinite(cell[0, 0]))

    @property
    def volume(self) -> np.ndarray:
        """Volume of the cell in each frame (f,), Å³."""
        return np.linalg.det(self.cell)

    @property
    def mean_volume(self) -> float:
        """Mean volume of the frames, or of the samples if there are no frames, Å³."""
        return float(self.volume.mean() if len(self) else 1e3 * self.columns["volume"].mean())

    @cached_property
    def stages(self) -> list[Stage]:
        """The stages of the frames, the last one first."""
        known = self.system.scene.stages
        index = self._stage_of_samples
        return [self.stage, *(known[k] for k in np.unique(index) if known[k] is not self.stage)]

    @property
    def begin_of_stage(self) -> float:
        """Time (ps) from which on all frames are of `stage`."""
        earlier = self._stage_of_samples != self.system.scene.stages.index(self.stage)
        return float(self.columns["time"][1:][earlier].max(initial=self.ends[0]))

    @property
    def _stage_of_samples(self) -> np.ndarray:
        """Index of the stage of each sample but the first, with which a stage begins."""
        return self.columns["stage"][1:] if "stage" in self.columns else np.zeros(0, int)

    @property
    def thermal_energy(self) -> float:
        """kB T at the mean temperature of the samples, u Å²/ps²."""
        return BOLTZMANN * float(np.mean(self.columns["temperature"]))

    @cached_property
    def kinds(self) -> list[Kind]:
        """The molecules by species, frozen and mobile ones separately."""
        return kinds_of(self.system)

    @property
    def moving(self) -> list[Kind]:
        """The mobile molecules by species."""
        return [kind for kind in self.kinds if kind.moves]

    @cached_property
    def paths(self) -> np.ndarray:
        """Paths of centres (f, n, 3), Å, without scaling by a barostat: sums of displacements in
        each cell."""
        if not self.has_box or np.ptp(self.cell, axis=0).max() == 0.0:
            return self.positions
        inside = np.einsum("fni,fij->fnj", self.positions, np.linalg.inv(self.cell))
        moves = np.einsum("fni,fij->fnj", np.diff(inside, axis=0), self.cell[1:])
        return np.concatenate([self.positions[:1], self.positions[0] + np.cumsum(moves, axis=0)])

    def sites(self, name: str, frames: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Positions (f, k, 3) of the sites called `name`, and the indices (k,) of their molecules.

        name : of a site (HW1, or HW for HW1 and HW2), element, or species (centres of mass). Raises
            OutputError.
        """
        at, molecules = [], []
        for kind in self.kinds:
            chosen = np.array(sites_named(kind.molecule, name), int)
            centre = self.positions[frames][:, kind.index]
            if kind.name == name:
                at.append(centre)
                molecules.append(kind.index)
            elif len(chosen):
                offset = kind.molecule.positions_body[chosen]
                arms = np.zeros((1, 1, 1, 3))
                if self.Q.shape[1]:
                    arms = np.einsum("fnij,sj->fnsi", self.Q[frames][:, kind.index], offset)
                at.append((centre[:, :, None] + arms).reshape(len(centre), -1, 3))
                molecules.append(np.repeat(kind.index, len(chosen)))
        if not at:
            species = self.system.species
            known = [
                *dict.fromkeys(
                    [n for m in species for n in m.site_names]
                    + [m.name for m in species]
                    + [e for m in species for e in m.elements if e]
                )
            ]
            raise OutputError(
                f"unknown site {name!r}{did_you_mean(name, known) or ';'} there are"
                f" {', '.join(known)}"
            )
        return np.concatenate(at, axis=1), np.concatenate(molecules)

    def __getitem__(self, frames: slice) -> "RigidFrames":
        """Some of the frames, with all samples."""
        return replace(
            self,
            time=self.time[frames],
            cell=self.cell[frames],
            positions=self.positions[frames],
            Q=self.Q[frames],
            velocities=None if self.velocities is None else self.velocities[frames],
            L=None if self.L is None else self.L[frames],
        )

    def copied(self) -> "RigidFrames":
        """These frames in memory of their own, so that the frames of which they are a part can be
        freed."""
        return replace(
            self,
            positions=self.positions.copy(),
            Q=self.Q.copy(),
            velocities=None if self.velocities is None else self.velocities.copy(),
            L=None if self.L is None else self.L.copy(),
        )


def sites_named(molecule: Molecule, name: str) -> list[int]:
    """Sites of a molecule with this name, or else with this name before a number, or else of this
    element."""
    indices = [k for k, site in enumerate(molecule.site_names) if site == name]
    indices = indices or [
        k for k, site in enumerate(molecule.site_names) if site.rstrip("0123456789") == name
    ]
    return indices or [
        k for k, element in enumerate(molecule.elements) if element == name and name != "X"
    ]


def fit_frames(
    system: System,
    sites: np.ndarray,
    velocities: np.ndarray | None,
    cells: np.ndarray,
    *,
    wrapped: bool,
    progress: Callable[[float], object] = lambda fraction: None,
) -> tuple[Bodies, list[str]]:
    """Bodies of frames, each array with a first axis (f,), and notes. Raises OutputError.

    sites (f, s, 3). Velocities alike or None. Cells (f, 3, 3)
    wrapped : whether centres are wrapped into the box. Their paths are made continuous
    progress : called with the fraction done
    """
    fit = RigidFit(system)
    n = len(system.model.species)
    f = len(sites)
    rotating = n if len(system.state.rotation) else 0
    position = np.empty((f, n, 3))
    Q = np.empty((f, rotating, 3, 3))
    velocity, L = (
        (None, None) if velocities is None else (np.empty((f, n, 3)), np.empty((f, rotating, 3)))
    )
    for k, frame in enumerate(sites):
        try:
            bodies = fit.bodies(frame, None if velocities is None else velocities[k])
        except OutputError as error:
            raise OutputError(f"frame {k + 1}: {error}") from None
        for array, values in zip((position, Q, velocity, L), bodies, strict=True):
            if array is not None:
                array[k] = values
        progress((k + 1) / f)
    notes = []
    if wrapped and f > 1 and np.isfinite(cells[0, 0, 0]):
        inside = np.einsum("fni,fij->fnj", position, np.linalg.inv(cells))
        moves = np.diff(inside, axis=0)
        moves -= np.round(moves)
        if (far := float(np.abs(moves).max())) > MAX_WRAPPED_MOVE:
            raise OutputError(
                f"molecules move by {far:.2f} of the box between two frames, in which they are"
                " wrapped: their paths cannot be determined. Write output.positions = 'unwrapped',"
                " or frames more often"
            )
        inside[1:] = inside[0] + np.cumsum(moves, axis=0)
        position = np.einsum("fni,fij->fnj", inside, cells)
        notes.append("molecules are wrapped in the frames. Their paths were made continuous")
    return Bodies(position, Q, velocity, L), notes


#: Maximum number of numbers of 8 bytes of frames in memory; a longer trajectory is thinned out.
MOST_NUMBERS = 150_000_000


def frames_of_folder(
    record: Record,
    start: float | None = None,
    progress: Callable[[float], object] = lambda fraction: None,
) -> RigidFrames:
    """The frames of a run of molecules in a folder, from `start` (ps) on, or from where production
    starts. Without a trajectory there are samples only.

    progress : called with the fraction done. Raises OutputError.
    """
    if not is_molecular(record.scene):
        what = f"a run of {record.scene.subject}, and analyses are for molecules"
        raise OutputError(f"{record.folder} is {what}. `rigidmd report` shows it")
    system = record.system
    frame_limit = max(2, MOST_NUMBERS // (3 * system.site_count + 18 * len(system.model.species)))
    tensor = read_tensor(record.folder / TENSOR_FILE)
    notes = list(record.missing)
    try:
        path = record.trajectory
    except OutputError as error:
        stored = str(error).removeprefix(f"{record.folder}: ")
    else:
        stored = read_frames(path, system.site_count, frame_limit)
        if stored.stride > 1:
            notes.append(
                f"every {stored.stride}th frame is used: {stored.count} need too much memory"
            )
        if stored.is_cut:
            notes.append(f"{path.name} ends within a frame, which is left out")
    try:
        return _rigid_frames(system, record.columns, stored, tensor, start, notes, progress)
    except OutputError as error:
        raise OutputError(f"{record.folder}: {error}") from None


def frames_of_start(scene: MolecularScene, count: int, model: str = "") -> RigidFrames:
    """The start of a scene as a number of frames, for molecules that do not move. Raises
    SceneError.

    model : of a trial molecule. If it is not a species of the scene, it becomes one without a
        molecule, whose sites [forces] may name
    """
    if model and model not in [entry.label for entry in scene.molecules]:
        is_file = model.endswith(".toml")
        of_file, of_model = (model, None) if is_file else (None, model)
        trial = Molecules.model_construct(file=of_file, model=of_model, count=0)
        scene = scene.model_copy(update={"molecules": (*scene.molecules, trial)})
    system = build(scene)
    state = system.state
    stages = system.scene.stages
    stage = next((stage for stage in reversed(stages) if stage.has_thermostat), stages[-1])
    shape = (count, len(system.model.species))
    return RigidFrames(
        system,
        stage,
        np.arange(count, dtype=float),
        np.broadcast_to(state.cell, (count, 3, 3)),
        np.broadcast_to(state.position, (*shape, 3)),
        np.broadcast_to(state.rotation, (count, *state.rotation.shape)),
        None,
        None,
        {"temperature": np.full(count, system.scene.start.temperature_K or 0.0)},
    )


def frames_of_results(results: Results, start: float | None = None) -> RigidFrames:
    """The frames of a run of molecules in this process. Raises OutputError."""
    system = results.system
    if not isinstance(system, System):
        raise OutputError("this is a run of a single body, and analyses are for molecules")
    if results.files:
        record = replace(read_record(results.files[0].parent), system=system)
        return frames_of_folder(record, start)
    frames = results._frames
    stored: Frames | str = "this run stored none (output.trajectory = false)"
    if frames:
        positions, velocities = (
            np.array([getattr(frame, of) for frame in frames]) for of in ("positions", "velocities")
        )
        stored = Frames(
            time=np.array([frame.time for frame in frames]),
            positions=positions,
            cells=np.array([frame.cell for frame in frames]),
            count=len(frames),
            stride=1,
            is_cut=False,
            velocities=velocities,
        )
    columns = {name: results[name] for name in results.units}
    return _rigid_frames(system, columns, stored, results._tensor, start, [], lambda fraction: None)


def production_samples(record: Record) -> tuple[Stage, np.ndarray]:
    """The last stage that is not a minimisation, and which samples are of its production. Raises
    OutputError."""
    stage, _, last, begin, shown = _last_stage(record.system, record.columns)
    time = record.columns["time"]
    return stage, shown & (time >= begin) & (time <= last)


def earlier_production(record: Record) -> Iterator[tuple[Stage, np.ndarray]]:
    """The stages of motion before the last one whose set points do not change, and which samples
    belong to their equilibrated parts. Raises OutputError."""
    columns = record.columns
    last = _last_stage(record.system, record.columns)[0]
    for k, stage in enumerate(record.system.scene.stages):
        if stage is last:
            return
        of_stage = np.flatnonzero(columns["stage"] == k)
        if stage.is_minimisation or stage.ramps or not len(of_stage):
            continue
        start = equilibrated_from(
            {name: values[of_stage] for name, values in columns.items()}, stage
        )
        samples = np.zeros(len(columns["stage"]), bool)
        samples[of_stage[start:]] = True
        yield stage, samples


def _rigid_frames(
    system: System,
    columns: dict[str, np.ndarray],
    stored: Frames | str,
    tensor: np.ndarray | None,
    start: float | None,
    notes: list[str],
    progress: Callable[[float], object],
) -> RigidFrames:
    """stored : the frames, or why there are none"""
    stage, first, last, detected, shown = _last_stage(system, columns)
    begin = detected if start is None else start
    if start is None:
        notes.append(
            f"production begins at {begin:g} ps, as detected in the stage from {first:g} to"
            f" {last:g} ps"
        )
    elif start < first:
        notes.append(f"frames before {first:g} ps belong to an earlier stage")
    if stage.ramps:
        notes.append("the set temperature or pressure changes: averages are over the whole ramp")
    if not stage.keeps_momentum:
        notes.append(
            f"the thermostat {stage.thermostat_kind} acts on each molecule: it slows diffusion and"
            " rotation, and changes spectra and viscosity. Use nve or velocity_rescaling for these"
        )
    slack = 1e-6 * max(abs(last), 1.0)
    why_none = ""
    if isinstance(stored, str):
        why_none = stored
        stored = Frames(np.zeros(0), np.zeros((0, system.site_count, 3)), None, 0, 1, is_cut=False)
    keep = np.flatnonzero((stored.time >= begin - slack) & (stored.time <= last + slack))
    times = without_rounding(stored.time[keep])
    keep, times = (of[np.diff(times, append=np.inf) > 0] for of in (keep, times))
    if len(keep) < 2:
        why_none = why_none or (
            f"from {begin:g} ps on there {'is' if len(keep) == 1 else 'are'} {len(keep)} of"
            f" {len(stored.time)} frames. An analysis needs at least two: run longer, or write"
            " frames more often (trajectory_interval_ps)"
        )
        keep, times = keep[:0], times[:0]
    samples = shown & (columns["time"] >= begin - slack) & (columns["time"] <= last + slack)
    if why_none and samples.sum() < 2:
        raise OutputError(why_none)
    velocities = None if stored.velocities is None else stored.velocities[keep]
    cells = np.tile(NO_CELL, (len(keep), 1, 1)) if stored.cells is None else stored.cells[keep]
    wrapped = system.scene.output.positions == "wrapped"
    bodies, corrections = fit_frames(
        system, stored.positions[keep], velocities, cells, wrapped=wrapped, progress=progress
    )
    if tensor is not None:
        tensor = tensor[(tensor[:, 0] >= begin - slack) & (tensor[:, 0] <= last + slack)]
    return RigidFrames(
        system,
        stage,
        times,
        cells,
        bodies.position,
        bodies.Q,
        bodies.velocity,
        bodies.L,
        {name: values[samples] for name, values in columns.items()},
        tensor,
        [*notes, *corrections],
        why_none,
    )


def _last_stage(system: System, columns: dict[str, np.ndarray]):
    """The last moving stage with samples, its start, end and equilibrated part, ps, and its samples
    of motion (l,)."""
    time = columns["time"]
    stages = system.scene.stages
    if all(stage.is_minimisation for stage in stages):
        raise OutputError(
            "this run is a minimisation, in which no time passes: there is nothing to average"
        )
    shown = moving(stages, columns["stage"])
    for k in reversed(range(len(stages))):
        of_stage = np.flatnonzero(shown & (columns["stage"] == k))
        if len(of_stage) and time[of_stage[-1]] > (first := time[max(0, of_stage[0] - 1)]):
            start = equilibrated_from(
                {name: values[of_stage] for name, values in columns.items()}, stages[k]
            )
            begin = time[of_stage[start]] if start or stages[k].volume else first
            return stages[k], float(first), float(time[of_stage[-1]]), float(begin), shown
    raise OutputError("the run has not reached a stage after its minimisations")
