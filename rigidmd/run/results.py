"""Results of a run."""

from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.core.state import State
from rigidmd.validation import settled

if TYPE_CHECKING:
    import MDAnalysis
    import pandas

    from rigidmd.assemble.body import BodySystem
    from rigidmd.assemble.system import System
    from rigidmd.measure.motion import Motion
    from rigidmd.measure.samples import Samples
    from rigidmd.output.frame import Frame


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

    def __repr__(self) -> str:
        return f"<Results of {self.system.scene.name}: {self._told}; results[column], .units, .summary, .universe()>"

    def _repr_html_(self) -> str:
        families: dict[tuple[str, str], list[str]] = {}
        for name, column in self.samples.described.items():
            families.setdefault((column.unit, column.about), []).append(name)
        rows = "".join(
            f"<tr><td>{' '.join(f'<code>{name}</code>' for name in names)}</td><td>{unit}</td>"
            f'<td>{self._range(names)}</td><td style="text-align: left">{escape(about)}</td></tr>'
            for (unit, about), names in families.items()
        )
        return (
            f"<b>{escape(self.system.scene.name)}</b>: {escape(self._told)}<table><tr><th>column</th><th>unit</th>"
            f"<th>first ... last</th><th></th></tr>{rows}</table>"
        )

    @property
    def _told(self) -> str:
        files = f"{len(self.files)} files in {self.files[0].parent}" if self.files else "no files"
        return f"{'interrupted, ' if self.interrupted else ''}{len(self.samples)} samples, {files}"

    def _range(self, columns: list[str]) -> str:
        """First and last value of a scalar column."""
        values = self[columns[0]]
        if len(columns) > 1 or values.ndim > 1 or len(values) == 0:
            return ""
        return " ... ".join(escape(x) if isinstance(x, str) else f"{x:.6g}" for x in values[[0, -1]])

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

    @property
    def rotation(self) -> np.ndarray:
        """The rotation matrices Q, body to lab, at the frames of `universe()` (frames, n, 3, 3).

        Of molecules Q turns the principal axes of `rigidmd models NAME`; of a body its own axes, at all samples. Raises
        ValueError if nothing turns, and for molecules whose run wrote files other than .gsd, which hold positions only.
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
                raise ValueError(
                    f"{path.name} holds positions, not rotations: write a trajectory.gsd, or run without a folder"
                )
            from rigidmd.output.trajectory import read_rotations

            return read_rotations(path)
        return np.array([frame.rotation for frame in self._frames])
