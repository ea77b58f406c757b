"""What readers of formats share: atoms and frames, elements from names and masses, numbers in lines
of text."""

import re
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.core.toml import parse_whole_number
from rigidmd.errors import StructureError

MOST_EXAMINED = 3000  # numbers of a file, of which decimals are counted
SAME_MASS = 0.01  # relative difference of the masses of one element
# u, AME2020; ASE has no symbols for them
HEAVY_HYDROGEN = {
    "D": 2.014101777844,
    "T": 3.01604928132,
}
#: Names of ions in CHARMM's force fields that do not start with their elements.
CHARMM_IONS = {
    "SOD": "Na",
    "POT": "K",
    "CES": "Cs",
    "CLA": "Cl",
    "LIT": "Li",
    "RUB": "Rb",
    "CAL": "Ca",
    "BAR": "Ba",
}
#: CHARMM's names of the oxygen and the massless site of four-site waters, both of which start like
#: oxygen.
CHARMM_WATER = ("OH2", "OM")
#: Elements of two letters that are meant by their symbols in capitals, in names too.
HALOGENS = ("CL", "BR")
#: Names of massless sites: M of four-site waters, L of five-site ones, and the names that programs
#: give them.
MASSLESS_NAME = re.compile(r"(M|MW|MT|EPW?|LPW?[A-Z]?|LP?|LW|IW|DUM?|VS|XX?|Q)\d*", re.IGNORECASE)


class Atoms(NamedTuple):
    """The n atoms of a file, in Å, ps and u."""

    names: list[str]
    #: "" if the format has only names; X for massless sites, D and T for heavy hydrogen. Capitals
    #: such as CO may be an element or a name, see `with_elements`
    elements: list[str]
    #: (number or None, name, ...), differs between neighbours; () without residues
    residue: list[tuple]
    position: np.ndarray  # (n, 3) Å
    velocity: np.ndarray | None = None  # (n, 3) Å/ps; rows of NaN for atoms without one
    cell: np.ndarray | None = None  # (3, 3), rows a, b, c, Å
    masses: np.ndarray | None = None  # (n,) u, if the file has masses
    notes: Sequence[str] = ()
    charges: np.ndarray | None = None  # (n,) e, if the file has charges of all atoms
    rounding: float = 0.0  # Å, a unit of the last digit of the coordinates; 0 if it is not known


def structure_error(path: Path, message: str) -> StructureError:
    """The exception for one error in a structure file."""
    return StructureError(str(path), [message])


def element_of(name: str, vocabulary: frozenset[str] = frozenset()) -> str:
    """The element at the start of an atom's name, one of `vocabulary` if possible. X for massless
    sites, "" if none."""
    letters = re.split(r"[^A-Za-z]", name.lstrip("0123456789 "), maxsplit=1)[0]
    one, two = letters[:1].upper(), letters[:2].capitalize()
    if len(two) == 2 and (letters[:2] == two or letters.upper() in HALOGENS) and is_element(two):
        return two
    element = next((e for e in (two, one) if e in vocabulary), "")
    if not element and MASSLESS_NAME.fullmatch(name):
        return "X"
    return element or next((e for e in (one, two) if is_element(e) or e in HEAVY_HYDROGEN), "")


def element_of_symbol(symbol: str) -> str:
    """The element, or heavy hydrogen, of a symbol in a column of elements. "" if it is none. Two
    capitals that may also be a name, such as CO or HO, remain as they are."""
    element = symbol.capitalize()
    if not is_element(element) and element not in HEAVY_HYDROGEN:
        return ""
    return symbol if may_be_name(symbol) else element


def may_be_name(symbol: str) -> bool:
    """Whether a symbol of an element in capitals is also a name that starts with another
    element."""
    is_pair = len(symbol) == 2 and symbol.isupper() and symbol not in HALOGENS
    return is_pair and is_element(symbol[0])


def with_elements(atoms: Atoms, vocabulary: frozenset[str]) -> Atoms:
    """The atoms with an element, or "" for a name, in place of each symbol that may be either. CO
    is cobalt, unless the scene, with the elements `vocabulary`, has carbon and no cobalt."""
    element_of_capitals = {}
    read = []
    for symbol in sorted({e for e in atoms.elements if may_be_name(e)}):
        element = symbol.capitalize()
        is_name = element not in vocabulary and bool({symbol, symbol[0]} & vocabulary)
        element_of_capitals[symbol] = "" if is_name else element
        if is_name:
            read.append(f"{symbol} as a name of {symbol[0]}")
        elif element not in vocabulary:
            read.append(f"{symbol} as {element}")
    notes = [f"symbols in capitals in its column of elements were read: {', '.join(read)}"]
    return atoms._replace(
        elements=[element_of_capitals.get(e, e) for e in atoms.elements],
        notes=[*atoms.notes, *(notes if read else [])],
    )


def is_element(symbol: str) -> bool:
    from ase.data import atomic_numbers

    return symbol != "X" and symbol in atomic_numbers


def element_of_mass(mass: float) -> str:
    """The element, or heavy hydrogen, of this mass (u). "" if there is none, as for united
    atoms."""
    from ase.data import atomic_masses, chemical_symbols

    known = {
        e: float(m) for e, m in zip(chemical_symbols, atomic_masses, strict=True) if e != "X"
    } | HEAVY_HYDROGEN
    nearest = min(known, key=lambda element: abs(known[element] - mass))
    return nearest if abs(known[nearest] - mass) <= SAME_MASS * mass else ""


def names_of_types(
    path: Path,
    types: list[str],
    listed: list[str],
    names: dict[str, str],
    atom_types: dict[str, str] | None,
) -> list[str]:
    """The name of each atom of these types: by structure.atom_types, else by the file, else the
    type itself.

    listed : all types of the file. names : of types, in the file. Raises StructureError.
    """
    if atom_types is None:
        return [names.get(kind, kind) for kind in types]
    present = sorted({*types, *listed}, key=lambda kind: (parse_whole_number(kind) or 0, kind))
    key_of_type = {
        kind: next((key for key in (kind, names.get(kind)) if key in atom_types), None)
        for kind in present
    }
    errors = []
    if unknown := [key for key in atom_types if key not in key_of_type.values()]:
        errors.append(
            f"structure.atom_types: unknown type {', '.join(unknown)}; there are"
            f" {', '.join(present)}"
        )
    if unnamed := [kind for kind, key in key_of_type.items() if key is None]:
        errors.append(f"structure.atom_types has no name for type {', '.join(unnamed)}")
    if errors:
        raise StructureError(str(path), errors)
    return [atom_types[key_of_type[kind] or kind] for kind in types]


class Frame(NamedTuple):
    """A frame of a trajectory. If a run writes a file, it keeps only the times of frames in
    memory."""

    time: float  # ps
    positions: np.ndarray = np.empty((0, 3))  # (s, 3) sites, Å
    cell: np.ndarray | None = None  # (3, 3) Å; None without a box
    velocities: np.ndarray | None = None  # (s, 3) sites, Å/ps
    rotation: np.ndarray | None = None  # (n, 3, 3) molecules
    step: int = 0

    @property
    def sites(self) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        return self.positions, self.velocities, self.cell


def unexpected(path: Path, line: int, what: str, found: str) -> StructureError:
    """The error of a line that is not as expected."""
    return structure_error(path, f"line {line}: expected {what}, found {found[:60]!r}")


def atom_count(path: Path, line: int, text: str, available: int) -> int:
    """The number of atoms that a line gives, at most `available`. Raises StructureError."""
    count = parse_whole_number(text)
    if count is None:
        raise unexpected(path, line, "the number of atoms", text)
    if count > available:
        raise structure_error(
            path, f"line {line} promises {count} atoms, {max(0, available)} are there: truncated?"
        )
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


def last_digit(words: Iterable[str]) -> float:
    """A unit of the last digit of the most precise of the first numbers. 0 if one has an
    exponent."""
    decimals = 0
    for word in islice(words, MOST_EXAMINED):
        if not re.fullmatch(r"[-+]?\d*\.?\d*", word):
            return 0.0
        decimals = max(decimals, len(word.partition(".")[2]))
    return 10.0**-decimals


def joined_numbers(text: str) -> list[str]:
    """Numbers of a line, separated by spaces, or without spaces if all have as many decimals and
    fill their columns: 1200.00000-1200.00000."""
    words = text.split()
    decimals = len(text.rstrip()) - text.rfind(".") - 1
    in_columns = re.findall(rf"-?\d+\.\d{{{decimals}}}", text) if "." in text else []
    return in_columns if "".join(in_columns) == "".join(words) else words


def table(path: Path, rows: list[tuple[int, list[str]]], what: str) -> np.ndarray:
    """Words of lines, each with its number, as numbers (n, k). Raises StructureError as `numbers`
    does."""
    try:
        return np.array([words for _, words in rows], float) if rows else np.zeros((0, 3))
    except ValueError:
        rows_of_numbers = [numbers(path, line, words, what) for line, words in rows]
        for (line, words), values in zip(rows, rows_of_numbers, strict=True):
            if len(values) != len(rows_of_numbers[0]) or not values:
                raise unexpected(path, line, what, " ".join(words)) from None
        return np.array(rows_of_numbers)
