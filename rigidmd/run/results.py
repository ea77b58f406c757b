"""Results of a run: samples, summary, final state, frames. The value that `Simulation.run`
returns."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np

from rigidmd.core.display import Displayed
from rigidmd.core.state import State
from rigidmd.core.toml import Json
from rigidmd.errors import OutputError
from rigidmd.formats import BY_EXTENSION
from rigidmd.run.production import Estimate, mean_of_production

if TYPE_CHECKING:
    import ase
    import MDAnalysis
    import pandas

    from rigidmd.engines.samples import SampleTable
    from rigidmd.engines.sites import AnySystem
    from rigidmd.engines.system import System
    from rigidmd.formats.atoms import Frame


@dataclass(repr=False)
class Results(Displayed):
    """Results of a run: samples as arrays, summary, final state, files.

    results["energy"] is a column of the samples as an array, in the unit of log.csv (kJ/mol of the
    whole system, K, bar, Å, ps) or, for a body, in SI units. `units` lists all columns with their
    units.

    Attributes
    ----------
    summary : dict
        Values with units in their keys, as in summary.json
    files : list of Path
        Paths of the files written
    interrupted : bool
        Whether the run ended early, by a signal or at its walltime (`out_of_time`)
    signal : int or None
        Number of the signal, 2 for Ctrl-C, 15 for SIGTERM
    out_of_time : bool
        Whether the run ended at its walltime
    """

    system: "AnySystem"
    _state: State | None
    samples: "SampleTable"
    summary: Json = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    interrupted: bool = False
    signal: int | None = None
    out_of_time: bool = False
    _frames: "Sequence[Frame]" = field(default_factory=list)
    _tensor: np.ndarray | None = None  # (n, 7) rows of the pressure tensor of a run without files
    #: Kept by rigidmd.analysis, by their start
    _analysis_frames: dict[float | None, Any] = field(default_factory=dict)
    _is_stored: bool = False  # read from a folder, without user-defined forces
    _no_state: str = ""  # why a stored run has no final state

    def __repr__(self) -> str:
        name = self.system.scene.name
        return (
            f"<Results of {name}: {self._summary_line}; results[column], .units, .summary,"
            " .universe()>"
        )

    @property
    def _summary_line(self) -> str:
        files = f"{len(self.files)} files in {self.files[0].parent}" if self.files else "no files"
        return f"{'interrupted, ' if self.interrupted else ''}{len(self.samples)} samples, {files}"

    @property
    def state(self) -> State:
        """The final state, for molecules in Å, Å/ps and u Å²/ps, for a body in SI units.

        Raises
        ------
        OutputError
            If a run that was read from a folder has none.
        """
        if self._state is None:
            raise OutputError(self._no_state)
        return self._state

    def __contains__(self, column: object) -> bool:
        return column in self.samples.described

    def __iter__(self) -> Iterator[str]:
        """The names of the columns."""
        return iter(self.samples.described)

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of the samples as an array (n,), in its unit of `units`: results["energy"].

        For a body that rotates, results["Q"] holds its rotation matrices (n, 3, 3). Raises KeyError
        with all names.
        """
        return self.samples[column]

    @property
    def units(self) -> dict[str, str]:
        """Name -> unit of each column. "1" for numbers, empty for text."""
        return {name: column.unit for name, column in self.samples.described.items()}

    def mean(self, name: str, *, zero_step: bool = False) -> Estimate:
        """The mean of a quantity over the production of the last stage of molecules, with its
        error, as in the summary: the potential energy is per molecule.

        Parameters
        ----------
        name : str
            Name of a column, or of a row of the summary with underscores: "potential_energy"
        zero_step : bool, optional
            At a time step of zero, from the fluctuations in the run: see `rigidmd analyse RUN
            zero_step`

        Returns
        -------
        Estimate
            `value`, `error` (NaN if the run is too short for one) and `unit`

        Raises
        ------
        KeyError
            With all names.
        OutputError
            For a single body, without a value, or if what the step adds to it is not known.
        """
        return mean_of_production(self, name, zero_step=zero_step)

    def to_dataframe(self) -> "pandas.DataFrame":
        """The samples under the headers of log.csv (motion.csv of a body).

        Returns
        -------
        pandas.DataFrame
            A line for each sample

        Raises
        ------
        ImportError
            Without pandas.
        """
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe() needs pandas: pip install pandas") from None
        from rigidmd.io.run_files import columns

        tensor = getattr(self.system.scene.output, "pressure_tensor", True)
        headers = columns(self.samples.described, tensor=tensor)
        return pandas.DataFrame({header: self[name] for name, header in headers.items()})

    def universe(self) -> "MDAnalysis.Universe":
        """The trajectory as an MDAnalysis Universe, from the files if there are any, or else from
        memory.

        Lengths in Å, times in ps. For a body a second becomes a picosecond. Every frame has its
        time in the run, also where the file format has none. Warns if frames are not evenly spaced.

        Returns
        -------
        MDAnalysis.Universe
            All sites, with elements, masses, charges and bonds

        Raises
        ------
        ValueError
            Without a trajectory.
        """
        from rigidmd.io import trajectory

        output = self.system.scene.output
        if not output.trajectory:
            raise ValueError("this run wrote no trajectory (output.trajectory = false)")
        if self.files:
            times = [frame.time for frame in self._frames]
            return trajectory.from_files(
                self.system, self._file(output.topology), self._file(output.trajectory), times
            )
        return trajectory.in_memory(self.system, self._frames)

    def _file(self, name: str | None) -> Path:
        """Path of a file of the run. Raises ValueError if it is missing."""
        for path in self.files:
            if path.name == name:
                return path
        raise ValueError(f"{name} is missing in {self.files[0].parent}")

    @overload
    def atoms(self, frame: int | None = None) -> "ase.Atoms": ...
    @overload
    def atoms(self, frame: slice) -> "list[ase.Atoms]": ...
    @overload
    def atoms(self, frame: str) -> "ase.Atoms | list[ase.Atoms]": ...
    def atoms(self, frame: int | slice | str | None = None) -> "ase.Atoms | list[ase.Atoms]":
        """The final state of molecules as an `ase.Atoms`, or frames of the trajectory.

        Atoms are the sites with mass, with the masses of the models, cell, periodicity,
        `info["time_ps"]` and, where frames have velocities, momenta. The final state, and a last
        frame at its time, is exact, with energy, forces and stress. Other frames have the digits of
        the trajectory (single precision but for .traj), and the energy where the log has a line at
        their time. So has the final state of a run that was read from a folder, without forces.

        Parameters
        ----------
        frame : int, slice or str, optional
            Index of a frame, or several as a slice or a text like ":" or "::10", as in
            `ase.io.read`. Default: the final state

        Returns
        -------
        ase.Atoms or list of ase.Atoms
            A list for several frames. Positions in Å, energies in eV

        Raises
        ------
        ValueError
            For a body, or without frames.
        IndexError
            If there are fewer frames.
        """
        from rigidmd.run.atom_forces import atoms_of_results

        return atoms_of_results(self, frame)

    @property
    def rotation(self) -> np.ndarray:
        """The rotation matrices Q, body to lab, at the frames of `universe()` (frames, n, 3, 3).

        For molecules Q rotates the principal axes of `rigidmd models NAME`, for a body the body's
        axes, at all samples. A trajectory.gsd stores Q. With other files it is fitted to the
        positions of sites, as exact as these, with an arbitrary rotation of linear molecules about
        their axes.

        Raises
        ------
        ValueError
            If nothing rotates.
        """
        if "Q" in self.samples.described:
            return self["Q"][:, None]
        if len(self.system.state.rotation) == 0:
            raise ValueError("nothing rotates in this run: it has points only")
        if not self._frames:
            raise ValueError("this run has no frames (output.trajectory = false)")
        if self.files:
            path = self._file(str(self.system.scene.output.trajectory))
            if not BY_EXTENSION[path.suffix].rotations:
                from rigidmd.run.rigid_fit import RigidFit

                fit = RigidFit(cast("System", self.system))
                return np.array(
                    [fit.bodies(frame.positions, None).Q for frame in self.universe().trajectory]
                )
            from rigidmd.io.trajectory import read_exactly

            return np.array([frame.rotation for frame in read_exactly(path)])
        return np.array([frame.rotation for frame in self._frames])
