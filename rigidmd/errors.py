"""The error tree: everything rigidmd refuses, it refuses with one of these and in words.

The command line prints the message and exits with 2 for bad input and 1 for a run that failed; the Python side gets
the exception.
"""


class RigidMDWarning(UserWarning):
    """What whoever runs something should know before it is done; the summary of a run has it too."""


class RigidMDError(Exception):
    """Base of all errors of this package."""


class Faults(RigidMDError):
    """Bad input: every fault found, at once.

    Parameters
    ----------
    where : what was being read (a file, usually)
    faults : one sentence each: what is wrong, where, what was expected
    """

    def __init__(self, where: str, faults: list[str]):
        self.where = where
        self.faults = list(faults)
        if len(self.faults) == 1:
            super().__init__(f"{where}: {self.faults[0]}")
        else:
            super().__init__(f"{where}: {len(self.faults)} faults\n" + "\n".join(f"  {fault}" for fault in self.faults))


class SceneError(Faults):
    """A scene that cannot be what its author meant."""


class MoleculeError(Faults):
    """A molecular model that is not a rigid body that can move."""


class StructureError(Faults):
    """A structure file that cannot be read, or not as the molecules of the scene."""


class OutputError(RigidMDError):
    """A folder or file that cannot be written, or would be overwritten."""


class SimulationError(RigidMDError):
    """A run that stopped because its numbers stopped meaning anything."""
