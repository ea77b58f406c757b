"""The shipped pair potentials of bodies, and pair potentials from an expression, for scenes."""

from collections.abc import Callable, Mapping
from math import pi
from typing import NamedTuple

import numpy as np

from rigidmd.core.plain_text import did_you_mean
from rigidmd.features.potentials.expressions.text import names_in, parse_energy, value_of
from rigidmd.features.potentials.expressions.trace import Graph, Number
from rigidmd.features.potentials.poses import gay_berne, multipoles, patch
from rigidmd.features.potentials.poses.gay_berne import GayBerne


class Shipped(NamedTuple):
    """A potential that a scene can name."""

    make: Callable[..., Callable]  # the function of two poses, from its options
    parameters: tuple[str, ...]  # of a species
    options: tuple[str, ...] = ()
    signed: tuple[str, ...] = ()  # which of both may be negative or 0


SHIPPED = {
    "gay_berne": Shipped(GayBerne, gay_berne.PARAMETERS, GayBerne._fields, ("upsilon",)),
    "dipole": Shipped(
        multipoles.dipole, multipoles.DIPOLE, ("reaction_field_A",), multipoles.DIPOLE
    ),
    "quadrupole": Shipped(
        multipoles.quadrupole, multipoles.QUADRUPOLE, signed=multipoles.QUADRUPOLE
    ),
    "patch": Shipped(patch.Patch, patch.PARAMETERS),
}


def shipped_function(
    name: str,
    options: Mapping[str, float],
    parameters: Mapping[str, Mapping[str, float]],
    pairs: Mapping[tuple[str, str], Mapping[str, float]],
) -> Callable:
    """The function of a shipped potential. Raises ValueError for wrong options and parameters.

    pairs : parameters of pairs of species
    """
    kind = SHIPPED[name]
    for key in options:
        if key not in kind.options:
            known = ", ".join(kind.options) or "none"
            hint = did_you_mean(key, kind.options) or ""
            raise ValueError(f"options: {name} has no {key}{hint}; there are {known}")
    if not parameters:
        raise ValueError(
            f"parameters is missing: {name} needs {', '.join(kind.parameters)} of each species"
        )
    of_pairs = {", ".join(pair): values for pair, values in pairs.items()}
    for species, values in (*parameters.items(), *of_pairs.items()):
        if wrong := [key for key in values if key not in kind.parameters]:
            hint = did_you_mean(wrong[0], kind.parameters) or ""
            raise ValueError(f"parameters of {species}: {name} has no {wrong[0]}{hint}")
    for what, values in {"options": options, **parameters, **of_pairs}.items():
        for key, value in values.items():
            if key not in kind.signed and not value > 0 and (key != "epsilon_kJ_mol" or value):
                raise ValueError(f"{key} of {what} is {value:g}, must be above 0")
    for species, values in parameters.items():
        if missing := [key for key in kind.parameters if key not in values]:
            raise ValueError(f"parameters of {species}: {', '.join(missing)} is missing")
    return kind.make(**options)


#: In a text: the distance; cosines of the angles of the axes of the first and the second body with
#: the vector from the first to the second, and with each other.
DISTANCE = "r"
ANGLES = ("a_r", "b_r", "a_b")


def function_of_text(energy: str, mixing: Mapping[str, str]) -> Callable:
    """The function of a text such as "4*eps*((sig/r)**12 - (sig/r)**6)*(1 + k*a_r*b_r)". Raises
    FormulaError."""
    tree = parse_energy(energy)
    names = names_in(tree)
    graph = Graph()
    value_of(tree, {"pi": pi, **{name: graph.leaf(name) for name in names}})  # for its errors

    def function(r: np.ndarray, u: np.ndarray, v: np.ndarray, p: object, q: object) -> Number:
        distance = np.sqrt(r @ r)
        angles = ((u @ r) / distance, (v @ r) / distance, u @ v)
        values = {"pi": pi, DISTANCE: distance, **dict(zip(ANGLES, angles, strict=True))}
        for name in names:
            if name not in values:
                usual = "arithmetic" if name[:3] == "sig" else "geometric"
                mean = MEANS[mixing.get(name, usual)]
                values[name] = mean(getattr(p, name), getattr(q, name))
        return value_of(tree, values)

    return function


MEANS: dict[str, Callable] = {
    "arithmetic": lambda x, y: (x + y) / 2,
    "geometric": lambda x, y: np.sqrt(x * y),
    "harmonic": lambda x, y: 2 * x * y / (x + y),
}
