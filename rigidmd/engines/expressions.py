"""Pair potentials as formulas and tables of r, for external engines that lack the potential with its truncation.

Formulas are in the syntax of Lepton, OpenMM's parser: x^2, max, erfc, and definitions after semicolons.
"""

from typing import Any

import numpy as np

from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.lennard_jones import LennardJones
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce
from rigidmd.forces.potentials.truncation import ForceShifted, SmoothlySwitched, Switched, Truncation

#: The switching function S of t = (r - start)/(cutoff - start), see `forces.potentials.truncation`.
SWITCHES: dict[type, str] = {
    Switched: "1-10*t^3+15*t^4-6*t^5",
    SmoothlySwitched: "1-126*t^5+420*t^6-540*t^7+315*t^8-70*t^9",
}


def lennard_jones_formula(potential: LennardJones, c12: float, c6: float, unit: float) -> str:
    """Energy of two sites with c12/r¹² - c6/r⁶, r in Å, in units of `unit` u Å²/ps²."""
    twelve, six = float(c12 / unit), float(c6 / unit)
    end = tuple(twelve * of12 - six * of6 for of12, of6 in zip(potential.terms12, potential.terms6, strict=True))
    return _truncated(f"{twelve!r}/r^12-{six!r}/r^6", potential.truncation, end)


def coulomb_formula(potential: ReactionField | DampedShiftedForce, strength: float) -> str:
    """Energy of two charges that is strength/r without truncation, r in Å."""
    strength = float(strength)
    if isinstance(potential, DampedShiftedForce):
        return f"{strength!r}*(erfc({potential.alpha!r}*r)/r+{float(potential.slope)!r}*r+({float(potential.shift)!r}))"
    end = tuple(strength * part for part in potential.terms)
    return _truncated(f"{strength!r}/r+({strength * potential.field!r})*r^2", potential.truncation, end)


def _truncated(formula: str, truncation: Truncation, end: tuple[float, ...]) -> str:
    """A formula with a truncation and its terms, see `forces.potentials.truncation`."""
    constant, linear, quadratic, cubic = (float(part) for part in end)
    whole = f"{formula}+({constant!r})" if constant else formula
    if isinstance(truncation, ForceShifted):
        added = f"x*({linear!r})+x^3*({quadratic / 3!r})+x^4*({cubic / 4!r})"
        return f"{whole}-({added}); x=max(0,r-{float(truncation.start)!r})"
    if isinstance(truncation, Switched | SmoothlySwitched):
        width = float(truncation.cutoff - truncation.start)
        return f"({whole})*({SWITCHES[type(truncation)]}); t=max(0,(r-{float(truncation.start)!r})/{width!r})"
    return whole


def table(formula: str, first: float, last: float, entries: int) -> str:
    """A table for LAMMPS' pair style `table`, even in r² from `first` to `last` Å: number, r, energy, force."""
    r = np.sqrt(np.linspace(first**2, last**2, entries))
    energy, force = _functions(formula)
    with np.errstate(all="ignore"):
        u, f = energy(r), force(r)
    head = f"N {entries} RSQ {first:.17g} {last:.17g}\n\n"
    rows = zip(r, np.broadcast_to(u, r.shape), np.broadcast_to(f, r.shape), strict=True)
    return head + "".join(f"{k} {x:.15g} {a:.15g} {b:.15g}\n" for k, (x, a, b) in enumerate(rows, 1))


def _functions(formula: str):
    """The energy and the force -dU/dr of a formula as functions of arrays of r."""
    import sympy  # slow to import

    r = sympy.Symbol("r", positive=True)
    text, *definitions = (part.strip() for part in formula.replace("^", "**").split(";"))
    names: dict[str, Any] = {"r": r, "max": sympy.Max}
    for definition in reversed(definitions):
        name, _, value = definition.partition("=")
        names[name] = sympy.parse_expr(value, names)
    energy = sympy.parse_expr(text, names)
    return (sympy.lambdify(r, part, ["numpy", "scipy"]) for part in (energy, -sympy.diff(energy, r)))
