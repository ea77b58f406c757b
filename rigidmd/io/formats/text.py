"""Helpers for readers of text formats: numbers and tables, with the line of each error."""

import re
from pathlib import Path

import numpy as np

from rigidmd.core.toml import parse_whole_number
from rigidmd.errors import StructureError
from rigidmd.io.formats.atoms import structure_error


def unexpected(path: Path, line: int, what: str, found: str) -> StructureError:
    """The error of a line that is not as expected."""
    return structure_error(path, f"line {line}: expected {what}, found {found[:60]!r}")


def atom_count(path: Path, line: int, text: str, available: int) -> int:
    """The number of atoms that a line gives, at most `available`. Raises StructureError."""
    count = parse_whole_number(text)
    if count is None:
        raise unexpected(path, line, "the number of atoms", text)
    if count > available:
        raise structure_error(path, f"line {line} promises {count} atoms, {max(0, available)} are there: truncated?")
    return count


def without_fortran(word: str) -> str:
    """A number whose exponent may be in Fortran's double precision, 1.5D+00, in the usual form."""
    return re.sub(r"(?<=[\d.])[dD](?=[-+]?\d+$)", "e", word)


def numbers(path: Path, line: int, words: list[str], what: str) -> list[float]:
    """Words of a line as numbers. Raises StructureError with the line and what was expected."""
    try:
        return [float(without_fortran(word)) for word in words]
    except ValueError:
        raise unexpected(path, line, what, " ".join(words)) from None


def table(path: Path, rows: list[tuple[int, list[str]]], what: str) -> np.ndarray:
    """Words of lines, each with its number, as numbers (n, k). Raises StructureError as `numbers` does."""
    try:
        return np.array([words for _, words in rows], float) if rows else np.zeros((0, 3))
    except ValueError:
        found = [numbers(path, line, words, what) for line, words in rows]
        for (line, words), values in zip(rows, found, strict=True):
            if len(values) != len(found[0]) or not values:
                raise unexpected(path, line, what, " ".join(words)) from None
        return np.array(found)
