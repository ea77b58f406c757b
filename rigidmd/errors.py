"""The exceptions of rigidmd. Invalid input and failed runs raise one of these, with an explanation.

The command line prints the message and exits with 2 for bad input and 1 for a failed run. Python
code gets the exception.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from pathlib import Path

#: Characters that a terminal interprets instead of showing: control characters except tab and line
#: ends, and changes of the direction of writing; and surrogates, which cannot be encoded.
UNPRINTABLE = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
MOST_SHOWN = 50  # errors in one message


def visible(text: str) -> str:
    """A text with escapes such as \\x1b for unprintable characters."""
    return UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)


class Wording:
    """How messages name what a user may do, for users of Python. The command line has a subclass
    with its options."""

    #: Keyword of an argument -> what to write for it.
    arguments = {"force": "force=True", "folder": "folder=...", "file": "another path"}  # noqa: RUF012

    def option(self, name: str) -> str:
        """An argument by its keyword, such as "force"."""
        return self.arguments.get(name, name)

    def resume(self, folder: Path) -> str:
        """What continues the run in a folder."""
        return "resume=True"


_WORDING = [Wording()]  # the last one is in use


@contextmanager
def worded_by(wording: Wording) -> Iterator[None]:
    """Let messages use another wording."""
    _WORDING.append(wording)
    try:
        yield
    finally:
        _WORDING.remove(wording)


def option(name: str) -> str:
    """An argument in a message, as its user writes it: force=True in Python, --force on the command
    line."""
    return _WORDING[-1].option(name)


def resume_command(folder: Path) -> str:
    """What continues the run in a folder, for messages."""
    return _WORDING[-1].resume(folder)


class RigidMDWarning(UserWarning):
    """Something that the user should know before a run ends. The summary of the run repeats it."""


class RigidMDError(Exception):
    """Base of all errors of this package. Messages may quote untrusted input. They are safe to
    print."""

    def __init__(self, message: str):
        super().__init__(visible(message))


def _line(message: str) -> float:
    """The line of a file that a message begins with. Infinite without one."""
    match = re.match(r"line (\d+): ", message)
    return int(match[1]) if match else inf


class Source(str):
    """The name of an input in messages."""

    __slots__ = ()

    def locate(self, error: str) -> str:
        """An error with its line, if the input has one for it."""
        return error


class InputError(RigidMDError):
    """Bad input, with all errors found.

    Parameters
    ----------
    where
        What was read, usually a file
    errors
        One sentence each: where, what is wrong, what was expected. Sorted by line
    """

    def __init__(self, where: str, errors: list[str]):
        self.where = where
        if isinstance(where, Source):
            errors = [where.locate(error) for error in errors]
        self.errors = sorted(errors, key=_line)
        if len(self.errors) == 1:
            super().__init__(f"{where}: {self.errors[0]}")
        else:
            more = (
                [f"and {len(self.errors) - MOST_SHOWN} more"]
                if len(self.errors) > MOST_SHOWN
                else []
            )
            shown = "\n".join(f"  {error}" for error in [*self.errors[:MOST_SHOWN], *more])
            super().__init__(f"{where}: {len(self.errors)} errors\n{shown}")


class SceneError(InputError):
    """An invalid scene."""


class MoleculeError(InputError):
    """An invalid molecular model."""


class StructureError(InputError):
    """A structure file that cannot be read, or does not fit the molecules of the scene."""


class OutputError(RigidMDError):
    """A folder or file that cannot be written, or would be overwritten."""


class CheckpointError(RigidMDError):
    """A checkpoint that cannot be read, or does not fit the scene."""


class SimulationError(RigidMDError):
    """A run that was stopped because its numbers became meaningless."""


class StoppedError(SimulationError, OutputError):
    """A run that stopped because a file could not be written."""


class EngineError(RigidMDError):
    """Another engine that is not installed, cannot run a scene, or failed."""


class SettingError(RigidMDError):
    """An unusable setting of the machine, such as an environment variable."""


def describe_error(error: BaseException) -> str:
    """An error of a user's code in one line: its type and message."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
