"""The error tree. Whatever rigidmd refuses, it refuses with one of these errors and an explanation.

The command line prints the message and exits with 2 for bad input and 1 for a failed run. Python code gets the
exception.
"""

import re

#: What a terminal obeys instead of showing it: control characters but for tab and line ends, and what turns the
#: direction of writing; and halves of characters, which cannot be written.
UNSEEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
MOST_SHOWN = 50  # faults of one message


def visible(text: str) -> str:
    """A text with escapes such as \\x1b in place of what a terminal would obey."""
    return UNSEEN.sub(lambda found: ascii(found[0])[1:-1], text)


class RigidMDWarning(UserWarning):
    """Something that the user should know before a run ends; the summary of the run repeats it."""


class RigidMDError(Exception):
    """Base of all errors of this package. Messages may quote the input of a stranger; they are safe to print."""

    def __init__(self, message: str):
        super().__init__(visible(message))


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
            more = [f"and {len(self.faults) - MOST_SHOWN} more"] if len(self.faults) > MOST_SHOWN else []
            shown = "\n".join(f"  {fault}" for fault in [*self.faults[:MOST_SHOWN], *more])
            super().__init__(f"{where}: {len(self.faults)} errors\n{shown}")


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


class EngineError(RigidMDError):
    """Another engine that is not here, cannot do what a scene asks for, or failed."""


class SettingError(RigidMDError):
    """A setting of the machine that cannot be used, such as an environment variable."""


def told(error: BaseException) -> str:
    """An error of a user's code in one line: its type and what it says."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
