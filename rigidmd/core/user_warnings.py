"""Warnings to users, which name the line of their code, and names that have changed."""

import sys
import warnings
from pathlib import Path

from rigidmd.errors import RigidMDWarning

_PACKAGE = str(Path(__file__).parent.parent)


def warn_user(sentence: str, category: type[Warning] = RigidMDWarning) -> None:
    """Issue a Python warning that names the calling line outside this package."""
    level = 1
    frame = sys._getframe()
    while frame is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level = level + 1
        frame = frame.f_back
    warnings.warn(sentence, category, stacklevel=level)


def warn_renamed(old: str, new: str, category: type[Warning] = DeprecationWarning) -> None:
    """Issue a warning on a name of the version before, which works in this version."""
    warn_user(f"{old} is {new} now: the next version has only the new name", category)
