"""The atoms of a structure file, and which elements their names and masses tell."""

import re
from typing import NamedTuple

import numpy as np

SAME_MASS = 0.01  # masses that differ by less than this fraction are those of one element
HEAVY_HYDROGEN = {"D": 2.014101777844, "T": 3.01604928132}  # u, AME2020; ASE has no symbols for them
#: Names of sites without mass: M of four-site waters, L of five-site ones, and what programs call them.
MASSLESS = re.compile(r"(M|MW|MT|EPW?|LPW?[A-Z]?|LP?|LW|IW|DUM|VS|XX?|Q)\d*", re.IGNORECASE)


class Atoms(NamedTuple):
    """What a file says of n atoms, in our units."""

    names: list[str]
    elements: list[str]  # "" where the format has names only; X without mass, D and T for heavy hydrogen
    residue: list[tuple]  # (number or None, name, ...), what tells it from its neighbours; () where the format has none
    position: np.ndarray  # (n, 3) Å
    velocity: np.ndarray | None  # (n, 3) Å/ps; rows of NaN for atoms without one
    cell: np.ndarray | None  # (3, 3), rows a, b, c, Å
    masses: np.ndarray | None  # (n,) u, where the file gives them
    notes: list[str]


def element_of(name: str, vocabulary: frozenset[str] = frozenset()) -> str:
    """The element that an atom's name begins with, one of `vocabulary` if possible; X if massless, "" if none."""
    letters = re.split(r"[^A-Za-z]", name.lstrip("0123456789 "), maxsplit=1)[0]
    one, two = letters[:1].upper(), letters[:2].capitalize()
    if len(two) == 2 and (letters[:2] == two or letters.upper() in ("CL", "BR")) and is_element(two):
        return two
    found = next((e for e in (two, one) if e in vocabulary), "")
    if not found and MASSLESS.fullmatch(name):
        return "X"
    return found or next((e for e in (one, two) if is_element(e)), "")


def is_element(symbol: str) -> bool:
    from ase.data import atomic_numbers

    return symbol != "X" and symbol in atomic_numbers


def element_of_mass(mass: float) -> str:
    """The element, or heavy hydrogen, that weighs so much (u); "" if none does: several atoms as one, say."""
    from ase.data import atomic_masses, chemical_symbols

    known = {e: float(m) for e, m in zip(chemical_symbols, atomic_masses, strict=True) if e != "X"} | HEAVY_HYDROGEN
    nearest = min(known, key=lambda element: abs(known[element] - mass))
    return nearest if abs(known[nearest] - mass) <= SAME_MASS * mass else ""
