"""The symmetry of a crystal: operations from what a file states about them, and the atoms that they
make.

A symmetry operation maps fractional coordinates x to W x + w. Operations (g, 3, 4) are the integers
24 W and 24 w, as in gemmi, whose tables of space groups are used: all translations of space groups
are multiples of 1/24.
Source: International Tables for Crystallography A, chapters 1.3 to 1.5.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.formats.cells import pairs_within

if TYPE_CHECKING:
    import gemmi

#: Denominator of gemmi's operations.
WHOLE = 24
IDENTITY = WHOLE * np.eye(3, 4, dtype=int)[None]
#: An operation keeps the lengths and angles of the cell to this fraction of the square of its
#: longest edge: 1 % of an edge, 1 degree.
KEEPS_CELL = 0.02
#: Two images of an atom within this fraction of its covalent radius are one atom on a special
#: position.
SAME_ATOM = 0.5
MONOCLINIC = range(3, 16)  # numbers of space groups
#: Names of the two origins and of the two cells of a space group in files of ICSD and of others.
SUFFIXES = {"S": "1", "Z": "2", "H": "h", "R": "r"}


class NoSymmetry(Exception):
    """Symmetry and positions contradict each other."""


class Setting(NamedTuple):
    """Operations that a file may mean."""

    name: str
    operations: np.ndarray  # (g, 3, 4)


class Statement(NamedTuple):
    """What a file states about its symmetry, and the settings in which it holds."""

    what: str  # for messages
    settings: Sequence[Setting]

    def agrees(self, operations: np.ndarray) -> bool:
        return any(np.array_equal(operations, setting.operations) for setting in self.settings)


def canonical(operations: "Iterable[gemmi.Op]") -> np.ndarray:
    """Operations (g, 3, 4), sorted, each once, with translations from 0 to 1."""
    rows = [[[*w, t % WHOLE] for w, t in zip(op.rot, op.tran, strict=True)] for op in operations]
    return np.unique(np.array(rows, int), axis=0)


def parse_operation(text: str) -> "gemmi.Op":
    """The operation of a text such as 1/2+x,-y,z. Raises ValueError."""
    import gemmi

    try:
        operation = gemmi.Op(re.sub(r"\s", "", text))
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    if abs(round(np.linalg.det(np.array(operation.rot) / WHOLE), 6)) != 1:
        raise ValueError("it is neither a rotation nor a reflection")
    return operation


def is_group(operations: np.ndarray) -> bool:
    """Whether the products of any two operations are these operations."""
    w, t = operations[:, :, :3] // WHOLE, operations[:, :, 3]
    rotation = WHOLE * np.einsum("aij,bjk->abik", w, w)
    translation = (np.einsum("aij,bj->abi", w, t) + t[:, None]) % WHOLE
    products = np.concatenate([rotation, translation[..., None]], axis=3).reshape(-1, 3, 4)
    return np.array_equal(np.unique(products, axis=0), operations)


def keep_cell(operations: np.ndarray, cell: np.ndarray) -> bool:
    """Whether operations are rotations and reflections in this cell (3, 3): W^T G W = G for its
    metric tensor G."""
    metric = cell @ cell.T
    w = operations[:, :, :3] / WHOLE
    change = np.einsum("aji,jk,akl->ail", w, metric, w) - metric
    return bool(np.abs(change).max() <= KEEPS_CELL * metric.max())


class TableEntry(NamedTuple):
    """A setting of a space group in gemmi's table."""

    setting: Setting
    number: int
    symbol: str  # Hermann-Mauguin, without origin or cell
    keys: frozenset[str]  # its spellings without spaces; for monoclinic groups also without 1s
    codes: frozenset[str]  # coordinate system codes
    system: str


@cache
def _table() -> list[TableEntry]:
    """All settings of the space groups: standard ones, origin choice 1 and hexagonal cells come
    first."""
    import gemmi

    return [_entry(group) for group in gemmi.spacegroup_table()]


def _entry(group: "gemmi.SpaceGroup") -> TableEntry:
    keys = {_key(group.hm)}
    if group.number in MONOCLINIC:
        keys.add("".join(word for word in group.hm.split() if word != "1").lower())
    origin = group.ext.lower()
    return TableEntry(
        Setting(group.xhm(), canonical(group.operations())),
        group.number,
        group.hm,
        frozenset(keys),
        frozenset({origin, group.qualifier, origin + group.qualifier}),
        group.crystal_system_str(),
    )


def settings_where(wanted: Callable[[TableEntry], bool]) -> list[Setting]:
    return [entry.setting for entry in _table() if wanted(entry)]


def settings_of_number(number: int) -> list[Setting]:
    return settings_where(lambda entry: entry.number == number)


def settings_of_system(system: str) -> list[Setting]:
    """Settings of a crystal system. Hexagonal, trigonal and rhombohedral ones are not distinguished
    in files."""
    alike = ("hexagonal", "trigonal", "rhombohedral")
    systems = alike if system.lower() in alike else (system.lower(),)
    return settings_where(lambda entry: entry.system in systems)


def settings_of_code(code: str) -> list[Setting]:
    """Settings of a coordinate system code of International Tables, such as 2, b2, 1cab or -cba."""
    return settings_where(lambda entry: code.lower() in entry.codes)


def settings_of_hall(symbol: str) -> list[Setting]:
    """The setting of a Hall symbol. None if it is unreadable."""
    import gemmi

    try:
        return [Setting(symbol, canonical(gemmi.symops_from_hall(symbol)))]
    except RuntimeError:
        return []


def settings_of_name(name: str) -> list[Setting]:
    """The settings that a Hermann-Mauguin symbol may mean. None if it is unknown.

    Spaces, underscores, 2(1) and 2~1~ are understood, also full symbols (P 2/m 2/m 2/m), and
    symbols of monoclinic groups without their 1s (P 21/n). A code after a colon, or ICSD's Z, S, H
    or R after a space, selects a setting.
    """
    import gemmi

    plain = re.sub(r"[()~_]", "", re.sub(r"\(?(No\.?|#) *\d+\)?$", "", name.strip()))
    symbol, _, code = (part.strip() for part in plain.partition(":"))
    attempts = [(symbol, code.lower())]
    words = symbol.split()
    if not code and words[-1:] and words[-1].upper() in SUFFIXES:
        attempts.append((" ".join(words[:-1]), SUFFIXES[words[-1].upper()]))
    for symbol, code in attempts:
        for key in (_key(symbol), _short(_key(symbol))):
            if settings := [
                entry.setting
                for entry in _table()
                if key in entry.keys and (not code or code in entry.codes)
            ]:
                return settings
    symbol, code = attempts[0]
    # other symbols of the same setting: H 3, F d 3 m, C m c e
    group = gemmi.find_spacegroup_by_name(symbol)
    if group is None:
        return []
    return settings_where(
        lambda entry: entry.symbol == group.hm and (not code or code in entry.codes)
    )


def _key(symbol: str) -> str:
    return re.sub(r"\s", "", symbol).lower()


def _short(key: str) -> str:
    """The short symbol of a full one: pnma of p21/n21/m21/a, fm-3m of f4/m-32/m."""
    return re.sub(r"(?:21?|4[1-3]?(?=/[a-z]-3))/([a-z])", r"\1", key)


def name_of(operations: np.ndarray) -> str:
    """The space group of operations (g, 3, 4), or an empty text if it is in no table."""
    same = settings_where(lambda entry: np.array_equal(entry.setting.operations, operations))
    return same[0].name if same else ""


class UnitCell(NamedTuple):
    """The atoms in a unit cell that symmetry operations make of the atoms of a file."""

    source_atom: np.ndarray  # (m,) atom of the file
    fractional: np.ndarray  # (m, 3)
    special_count: int  # atoms of the file on special positions
    copy_count: int  # atoms of the file that are images of others, and so are omitted


def unit_cell(
    fractional: np.ndarray,
    kinds: Sequence[str],
    radii: np.ndarray,
    operations: np.ndarray,
    cell: np.ndarray,
) -> UnitCell:
    """All atoms of the cell (3, 3), each once. Atoms on special positions are put exactly there.

    fractional : (n, 3) coordinates of the atoms of the file. kinds : what atoms at one position
        must share.
    radii : (n,) covalent radii, Å. Raises NoSymmetry.
    """
    parts = [
        _images(x, SAME_ATOM * radius, operations, cell)
        for x, radius in zip(fractional, radii, strict=True)
    ]
    source_atom = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    images = np.concatenate(parts) if parts else np.zeros((0, 3))
    special_count = sum(len(part) < len(operations) for part in parts)
    reach = SAME_ATOM * float(radii.max(initial=0.0))
    i, j, step = pairs_within(images @ cell, cell, reach)
    distance = np.linalg.norm(step, axis=1)
    first, second = (
        np.minimum(source_atom[i], source_atom[j]),
        np.maximum(source_atom[i], source_atom[j]),
    )
    near = (distance <= SAME_ATOM * np.minimum(radii[first], radii[second])) & (first != second)
    copies = set()
    # Pairs are not transitive: an atom that is a copy itself makes no other atom a copy. Which
    # atoms remain depends on the order of the pairs.
    for one, other, length in zip(
        first[near].tolist(), second[near].tolist(), distance[near].tolist(), strict=True
    ):
        if kinds[one] != kinds[other]:
            raise NoSymmetry(f"atoms {one + 1} and {other + 1} are {length:.2g} Å apart")
        if one not in copies:
            copies.add(other)
    is_unique = ~np.isin(source_atom, list(copies))
    return UnitCell(
        source_atom=source_atom[is_unique],
        fractional=images[is_unique],
        special_count=special_count,
        copy_count=len(copies),
    )


def _images(
    x: np.ndarray, tolerance: float, operations: np.ndarray, cell: np.ndarray
) -> np.ndarray:
    """The images (k, 3) of an atom at fractional coordinates x, which is first moved onto its
    special position."""
    if len(operations) == 1:
        return x[None]
    w, t = operations[:, :, :3] / WHOLE, operations[:, :, 3] / WHOLE
    step = w @ x + t - x
    step -= np.round(step)
    fixed = np.linalg.norm(step @ cell, axis=1) <= tolerance
    images = w @ (x + step[fixed].mean(axis=0)) + t
    step = images[:, None] - images
    step -= np.round(step)
    same = np.linalg.norm(step @ cell, axis=2) <= tolerance
    images = images[same.argmax(axis=1) == np.arange(len(images))]
    if len(images) * fixed.sum() != len(operations):
        raise NoSymmetry("an atom is too near to its own images by symmetry")
    return images % 1.0
