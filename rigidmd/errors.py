"""The error tree. Whatever rigidmd refuses, it refuses with one of these errors and an explanation.

The command line prints the message and exits with 2 for bad input and 1 for a failed run. Python code gets the
exception.
"""


class RigidMDWarning(UserWarning):
    """Something that the user should know before a run ends; the summary of the run repeats it."""


class RigidMDError(Exception):
    """Base of all errors of this package."""


class Faults(RigidMDError):
    """Bad input, with all faults found.

    Parameters
    ----------
    where : what was being read (a file, usually)
    faults : one sentence each: where, what is wrong, what was expected
    """

    def __init__(self, where: str, faults: list[str]):
        self.where = where
        self.faults = list(faults)
        if len(self.faults) == 1:
            super().__init__(f"{where}: {self.faults[0]}")
        else:
            super().__init__(f"{where}: {len(self.faults)} faults\n" + "\n".join(f"  {fault}" for fault in self.faults))


class SceneError(Faults):
    """An invalid scene."""


class MoleculeError(Faults):
    """An invalid molecular model."""


class StructureError(Faults):
    """A structure file that cannot be read, or does not fit the molecules of the scene."""


class OutputError(RigidMDError):
    """A folder or file that cannot be written, or would be overwritten."""


class CheckpointError(RigidMDError):
    """A checkpoint that cannot be read, or does not fit the scene."""


class SimulationError(RigidMDError):
    """A run that was stopped because its numbers became meaningless."""
