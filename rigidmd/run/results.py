"""Results of a run."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np

from rigidmd.core.state import State
from rigidmd.validation import settled

if TYPE_CHECKING:
    import ase
    import MDAnalysis
    import pandas
    from chemiscope.widget import StructureWidget

    from rigidmd.analyse.findings import Finding
    from rigidmd.analyse.history import History
    from rigidmd.assemble.body import BodySystem
    from rigidmd.assemble.system import System
    from rigidmd.looking.inline import Film
    from rigidmd.measure.motion import Motion
    from rigidmd.measure.samples import Samples
    from rigidmd.output.frame import Frame
    from rigidmd.output.picture import Picture


@dataclass(repr=False)
class Results:
    """Results of a run: samples as arrays, summary, final state, files.

    results["energy"] is a column of the samples as an array, in the unit of log.csv (kJ/mol of the whole system, K,
    bar, Å, ps) or, for a body, in SI units. `units` lists all columns with their units.

    summary : values with units in their keys, as in summary.json
    state : the final one, for molecules in Å, Å/ps and u Å²/ps, for a body in SI units
    files : paths of the files written
    interrupted : whether the run ended early, by a signal or because its time was up (`out_of_time`)
    signal : number of the signal, 2 for Ctrl-C, 15 for SIGTERM
    """

    system: "System | BodySystem"
    state: State
    samples: "Samples | Motion"
    summary: dict[str, Any] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    interrupted: bool = False
    signal: int | None = None
    out_of_time: bool = False
    _frames: "list[Frame]" = field(default_factory=list)
    _tensor: np.ndarray | None = None  # (n, 7) lines of the pressure tensor, where no file holds them
    _histories: "dict[float | None, History]" = field(default_factory=dict)  # by the time at which they begin

    def __repr__(self) -> str:
        return f"<Results of {self.system.scene.name}: {self._told}; results[column], .units, .summary, .universe()>"

    def _repr_html_(self) -> str:
        from rigidmd.looking.notebook import results_html

        return results_html(self)

    @property
    def _told(self) -> str:
        files = f"{len(self.files)} files in {self.files[0].parent}" if self.files else "no files"
        return f"{'interrupted, ' if self.interrupted else ''}{len(self.samples)} samples, {files}"

    def __contains__(self, column: object) -> bool:
        return column in self.samples.described

    def __iter__(self) -> Iterator[str]:
        """The names of the columns."""
        return iter(self.samples.described)

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of the samples as an array (n,), in its unit of `units`: results["energy"].

        For a body that turns, results["Q"] holds its rotation matrices (n, 3, 3). Raises KeyError with all names.
        """
        return self.samples[column]

    @property
    def units(self) -> dict[str, str]:
        """Name -> unit of each column; "1" for numbers, empty for words."""
        return {name: column.unit for name, column in self.samples.described.items()}

    def to_dataframe(self) -> "pandas.DataFrame":
        """The samples under the headers of log.csv (motion.csv of a body). Raises ImportError without pandas."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe() needs pandas: pip install pandas") from None
        from rigidmd.output.log import TENSOR

        left_out = () if getattr(self.system.scene.output, "pressure_tensor", True) else TENSOR
        written = {
            name: column.header
            for name, column in self.samples.described.items()
            if column.header and name not in left_out
        }
        return pandas.DataFrame({header: self[name] for name, header in written.items()})

    def plot(self, *columns: str, log: bool = False) -> "Picture":
        """A figure of Matplotlib, which a notebook shows and `savefig` writes.

        columns : names, drawn against time, those of one unit together; log: absolute values on a logarithmic axis.
        Without names it is the figure that the run is known by: energy.png, of a body the path of its axis. The name of
        another figure of a body ("angles", "ellipsoids", "path", "invariants") gives that. Raises KeyError.
        """
        from rigidmd.looking.columns import plot

        return plot(self, columns, log)

    def view(self) -> "StructureWidget | Film":
        """The film of the run in a notebook: molecules by chemiscope, a body on a small page of its own.

        Raises ImportError without chemiscope (rigidmd[view]), ValueError without a trajectory.
        """
        from rigidmd.looking.inline import view

        return view(self)

    def universe(self) -> "MDAnalysis.Universe":
        """The trajectory as an MDAnalysis Universe: from the files if there are any, else from memory.

        Lengths in Å, times in ps; every frame has its time in the run, even if the file cannot hold it. For a body a
        second becomes a picosecond. Warns if frames are not evenly spaced. Raises ValueError without a trajectory.
        """
        from rigidmd.output import trajectory

        output = self.system.scene.output
        if not output.trajectory:
            raise ValueError("this run wrote no trajectory (output.trajectory = false)")
        if self.files:
            by_name = {path.name: path for path in self.files}
            times = [frame.time for frame in self._frames]
            return trajectory.from_files(
                self.system, by_name[settled(output.topology)], by_name[output.trajectory], times
            )
        return trajectory.in_memory(self.system, self._frames)

    @overload
    def atoms(self, frame: int | None = None) -> "ase.Atoms": ...
    @overload
    def atoms(self, frame: slice) -> "list[ase.Atoms]": ...
    @overload
    def atoms(self, frame: str) -> "ase.Atoms | list[ase.Atoms]": ...
    def atoms(self, frame: int | slice | str | None = None) -> "ase.Atoms | list[ase.Atoms]":
        """The final state of molecules as an `ase.Atoms`, or frames of the trajectory: an index, or a list for a slice
        or a text like ":" or "::10", as `ase.io.read` has them.

        Atoms are the sites with mass, with the masses of the models, cell, periodicity, `info["time_ps"]` and, where
        frames have velocities, momenta. The final state, and a last frame at its time, is exact, with energy, forces
        and stress; other frames have the digits of the trajectory (single precision but for .traj) and the energy
        where the log has a line at their time. Raises ValueError for a body or without frames, IndexError.
        """
        from rigidmd.run.atoms import atoms_of_results

        return atoms_of_results(self, frame)

    def analyse(self, name: str, /, start: float | None = None, **options: Any) -> "Finding":
        """The analysis of this name, one's own (`rigidmd.analysis`) or one that comes with rigidmd, as a `Finding`.

        start : ps, where frames begin to count; default: where the run is found to be equilibrated. Other options are
        those of the function. Raises OutputError.
        """
        from rigidmd.analyse.registry import chosen
        from rigidmd.analyse.source import of_results

        (entry,) = chosen([name])
        if start not in self._histories:
            self._histories[start] = of_results(self, start)
        return entry.function(self._histories[start], **options)

    def rdf(self, first: str = "", second: str = "", **options: Any) -> "Finding":
        """g(r) of two sites, elements or species; without names of all pairs of few sites. See `analyse.structure`."""
        return self.analyse("rdf", first=first, second=second, **options)

    def structure_factor(self, name: str = "", **options: Any) -> "Finding":
        """S(k) of sites, elements or species; without a name of the centres of mass."""
        return self.analyse("structure_factor", name=name, **options)

    def density_profile(self, axis: str = "z", **options: Any) -> "Finding":
        """Mass density (g/cm³) of each species along x, y or z."""
        return self.analyse("density_profile", axis=axis, **options)

    def hydrogen_bonds(self, **options: Any) -> "Finding":
        """Hydrogen bonds of a molecule, by distance (Å) and angle (degrees)."""
        return self.analyse("hydrogen_bonds", **options)

    def msd(self, **options: Any) -> "Finding":
        """Mean squared displacement (Å²) of the centres of mass."""
        return self.analyse("msd", **options)

    def diffusion(self, **options: Any) -> "Finding":
        """Diffusion coefficients (1e-9 m²/s); `viscosity_mPa_s` serves the correction for the size of the box."""
        return self.analyse("diffusion", **options)

    def orientation(self, **options: Any) -> "Finding":
        """C1 and C2 about each body axis, their times (ps), and rotational diffusion (1/ps)."""
        return self.analyse("orientation", **options)

    def spectrum(self, **options: Any) -> "Finding":
        """Densities of states (cm) of translation and rotation, and correlations of V, omega and L."""
        return self.analyse("spectrum", **options)

    def dielectric(self, **options: Any) -> "Finding":
        """The static dielectric constant, with the boundary condition of the scene."""
        return self.analyse("dielectric", **options)

    def viscosity(self, **options: Any) -> "Finding":
        """Shear viscosity (mPa s) from the pressure tensor (output.pressure_tensor_interval_ps)."""
        return self.analyse("viscosity", **options)

    @property
    def rotation(self) -> np.ndarray:
        """The rotation matrices Q, body to lab, at the frames of `universe()` (frames, n, 3, 3).

        Of molecules Q turns the principal axes of `rigidmd models NAME`; of a body its own axes, at all samples. A
        trajectory.gsd keeps Q; from other files it is rebuilt from the positions of sites, as exactly as these are
        written, with an arbitrary turn of linear molecules about their axes. Raises ValueError if nothing turns.
        """
        if "Q" in self.samples.described:
            return self["Q"][:, None]
        if len(self.state.rotation) == 0:
            raise ValueError("nothing turns in this run: it has points only")
        if not self._frames:
            raise ValueError("this run kept no frames (output.trajectory = false)")
        if self.files:
            path = next(path for path in self.files if path.name == self.system.scene.output.trajectory)
            if path.suffix != ".gsd":
                from rigidmd.analyse.history import Rebuilt

                fit = Rebuilt(cast("System", self.system))
                return np.array([fit.bodies(frame.positions, None).Q for frame in self.universe().trajectory])
            from rigidmd.output.trajectory import read_rotations

            return read_rotations(path)
        return np.array([frame.rotation for frame in self._frames])
