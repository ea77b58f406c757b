"""The format that rigidmd adds to `ase.io`: a run, by its folder or a trajectory that ASE cannot
read by itself."""

from ase.utils.plugins import ExternalIOFormat

FORMAT = ExternalIOFormat(
    "rigidmd run", "+S", "rigidmd.ase", ["trajectory.xtc", "trajectory.trr", "trajectory.gsd"]
)
