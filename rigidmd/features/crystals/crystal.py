"""The symmetry of a crystal: operations from what a file states about them, and the atoms that they
make.

A symmetry operation maps fractional coordinates x to W x + w. Operations (g, 3, 4) are the integers
24 W and 24 w, as in gemmi, whose tables of space groups are used: all translations of space groups
are multiples of 1/24.
Source: International Tables for Crystallography A, chapters 1.3 to 1.5.
"""

import re
from collections.abc import Callable, Sequence
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


class Statement(NamedTuple):
    """What a file states about its symmetry, and the settings in which it holds."""

    what: str  # for messages
    settings: "Sequence[gemmi.GroupOps]"


def parse_operation(text: str) -> "gemmi.Op":
    """The operation of a text such as 1/2+x,-y,z. Raises ValueError."""
    import gemmi

    try:
        operation = gemmi.Op(re.sub(r"\s", "", text))
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    if abs(operation.det_rot()) != WHOLE**3:
        raise ValueError("it is neither a rotation nor a reflection")
    return operation.wrap()


def group_of(operations: "Sequence[gemmi.Op]") -> "gemmi.GroupOps | None":
    """The group of operations. None if a product of two of them is none of them."""
    import gemmi

    group = gemmi.GroupOps(operations)
    try:
        group.add_missing_elements()
    except RuntimeError:  # infinitely many
        return None
    return group if len(group) == len({operation.triplet() for operation in operations}) else None


def keep_cell(operations: "gemmi.GroupOps", cell: np.ndarray) -> bool:
    """Whether operations are rotations and reflections in this cell (3, 3): W^T G W = G for its
    metric tensor G."""
    metric = cell @ cell.T
    w = np.array([operation.rot for operation in operations.sym_ops]) / WHOLE
    change = np.einsum("aji,jk,akl->ail", w, metric, w) - metric
    return bool(np.abs(change).max() <= KEEPS_CELL * metric.max())


def settings_where(wanted: "Callable[[gemmi.SpaceGroup], object]") -> "list[gemmi.GroupOps]":
    """Settings of space groups. Standard ones, origin choice 1 and hexagonal cells come first."""
    import gemmi

    return [group.operations() for group in gemmi.spacegroup_table() if wanted(group)]


def settings_of_number(number: int) -> "list[gemmi.GroupOps]":
    return settings_where(lambda group: group.number == number)


def settings_of_system(system: str) -> "list[gemmi.GroupOps]":
    """Settings of a crystal system. Hexagonal, trigonal and rhombohedral ones are not distinguished
    in files."""
    alike = ("hexagonal", "trigonal", "rhombohedral")
    systems = alike if system.lower() in alike else (system.lower(),)
    return settings_where(lambda group: group.crystal_system_str() in systems)


def settings_of_code(code: str) -> "list[gemmi.GroupOps]":
    """Settings of a coordinate system code of International Tables, such as 2, b2, 1cab or -cba."""
    return settings_where(lambda group: _has_code(group, code))


def _has_code(group: "gemmi.SpaceGroup", code: str) -> bool:
    origin = group.ext.lower()
    return code.lower() in (origin, group.qualifier, origin + group.qualifier)


def settings_of_hall(symbol: str) -> "list[gemmi.GroupOps]":
    """The setting of a Hall symbol. None if it is unreadable."""
    import gemmi

    try:
        return [gemmi.symops_from_hall(symbol)]
    except RuntimeError:
        return []


def settings_of_name(name: str) -> "list[gemmi.GroupOps]":
    """The settings that a Hermann-Mauguin symbol may mean. None if it is unknown.

    Spaces, underscores, 2(1) and 2~1~ are understood, also full symbols (P 2/m 2/m 2/m), and
    symbols of monoclinic groups without their 1s (P 21/n). A code after a colon, or ICSD's Z, S, H
    or R after a space, selects a setting.
    """
    import gemmi

    plain = re.sub(r"[()~_]", "", re.sub(r"\(?(No\.?|#) *\d+\)?$", "", name.strip()))
    symbol, _, code = (part.strip() for part in plain.partition(":"))
    attempts = [(symbol, code)]
    words = symbol.split()
    if not code and words[-1:] and words[-1].upper() in SUFFIXES:
        attempts.append((" ".join(words[:-1]), SUFFIXES[words[-1].upper()]))
    for symbol, code in attempts:
        key = _key(symbol)
        # short symbols of full ones: pnma of p21/n21/m21/a, fm-3m of f4/m-32/m
        for spelling in (key, re.sub(r"(?:21?|4[1-3]?(?=/[a-z]-3))/([a-z])", r"\1", key)):
            if settings := settings_where(
                lambda group, spelling=spelling, code=code: (
                    spelling in _spellings(group) and (not code or _has_code(group, code))
                )
            ):
                return settings
    symbol, code = attempts[0]
    # other symbols of the same setting: H 3, F d 3 m, C m c e
    named = gemmi.find_spacegroup_by_name(symbol)
    return settings_where(
        lambda group: named and group.hm == named.hm and (not code or _has_code(group, code))
    )


def _key(symbol: str) -> str:
    return re.sub(r"\s", "", symbol).lower()


def _spellings(group: "gemmi.SpaceGroup") -> tuple[str, ...]:
    """The symbol of a group without spaces, and for monoclinic groups also without 1s."""
    words = group.hm.split() if group.number in MONOCLINIC else ()
    return _key(group.hm), "".join(word for word in words if word != "1").lower()


def name_of(operations: "gemmi.GroupOps") -> str:
    """The space group of operations, or an empty text if it is in no table."""
    import gemmi

    group = gemmi.find_spacegroup_by_ops(operations)
    return group.xhm() if group else ""


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
    group: "gemmi.GroupOps | None",
    cell: np.ndarray,
) -> UnitCell:
    """All atoms of the cell (3, 3), each once. Atoms on special positions are put exactly there.

    fractional : (n, 3) coordinates of the atoms of the file. kinds : what atoms at one position
        must share.
    radii : (n,) covalent radii, Å. group : None for the identity alone. Raises NoSymmetry.
    """
    rows = [[[*w, t] for w, t in zip(op.rot, op.tran, strict=True)] for op in group or ()]
    operations = np.unique(np.array(rows, int), axis=0) if group else IDENTITY
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
