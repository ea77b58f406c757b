"""Tabulated pair potentials of users, and their files."""

from collections.abc import Sequence
from math import inf, isfinite
from pathlib import Path
from typing import NamedTuple

from rigidmd.core.files import unreadable_reason
from rigidmd.features.potentials.sites.formulas import LEAST_ROWS
from rigidmd.features.potentials.tables import LARGEST_VALUE
from rigidmd.features.potentials.user_code.cutoffs import PairPotentialError

#: Columns of the file of a tabulated potential, of which the last may be missing; the names have
#: the units.
COLUMNS = ("r_A", "energy_kJ_mol", "force_kJ_mol_A")
LARGEST_TABLE = 20_000_000  # bytes


class Columns(NamedTuple):
    """A tabulated potential."""

    r: Sequence[float]  # Å
    energy: Sequence[float]  # kJ/mol
    force: Sequence[float] | None = None  # -dE/dr, kJ/mol/Å
    name: str = "a table"  # for messages


def read_columns(path: Path) -> Columns:
    """The table of a file: numbers separated by commas or white space, comments after #, and
    perhaps a line with the names of `COLUMNS` first. Raises PairPotentialError with all errors."""
    try:
        reason = unreadable_reason(path, LARGEST_TABLE)
        text = "" if reason else path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = f"cannot be read as text: {error}"
    if reason:
        raise PairPotentialError(f"{path}: {reason}")
    names = COLUMNS
    rows = []
    faults = []
    lines = [
        (k, line.partition("#")[0].replace(",", " ").split())
        for k, line in enumerate(text.splitlines(), 1)
    ]
    lines = [(k, words) for k, words in lines if words]
    if lines and not _is_number(lines[0][1][0]):
        (number, names), lines = lines[0], lines[1:]
        if not {*COLUMNS[:2]} <= {*names} <= {*COLUMNS} or len({*names}) < len(names):
            raise PairPotentialError(
                f"{path}: line {number}: the columns are {', '.join(names)}. They must be r_A (Å),"
                " energy_kJ_mol (kJ/mol) and, if you like, force_kJ_mol_A (-dE/dr, kJ/mol/Å)"
            )
    for number, words in lines:
        values = [float(word) if _is_number(word) else inf for word in words]
        row = dict(zip(names, values, strict=False))
        expected = (len(names),) if names is not COLUMNS else (2, 3)
        if len(words) not in ((len(rows[0]),) if rows else expected):
            must = f"must have the same columns in all lines: {', '.join(names)}"
            faults.append(f"line {number}: has {len(words)} numbers, {must}")
        elif not all(map(isfinite, values)):
            faults.append(
                f"line {number}: {' '.join(words):.60} has something else than finite numbers"
            )
        elif max(map(abs, values)) > LARGEST_VALUE:
            largest = f"a number above {LARGEST_VALUE:g}, the largest of a table"
            faults.append(
                f"line {number}: {' '.join(words):.60} has {largest}: begin it at larger distances"
            )
        elif not row["r_A"] > (rows[-1]["r_A"] if rows else 0.0):
            if rows:
                least = f"{rows[-1]['r_A']:g} Å of the row before. Sort the rows by distance"
            else:
                least = "0"
            faults.append(f"line {number}: r_A = {row['r_A']:g} must be above {least}")
        else:
            rows.append(row)
    if not faults and len(rows) < LEAST_ROWS:
        faults.append(
            f"has {len(rows)} rows, needs {LEAST_ROWS} or more: one line for each distance"
        )
    if faults:
        raise PairPotentialError(*(f"{path}: {fault}" for fault in faults))
    r, energy, *force = ([row[name] for row in rows] for name in COLUMNS if name in rows[0])
    return Columns(r, energy, force[0] if force else None, path.name)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
