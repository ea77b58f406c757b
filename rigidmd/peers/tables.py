"""Tables of pair laws, from formulas of r: energy and force, the force by differentiation."""

from typing import Any

import numpy as np
import sympy


def table(formula: str, first: float, last: float, entries: int) -> str:
    """A table of LAMMPS' pair style table, even in r² from `first` to `last` Å: number, r, energy, force."""
    r = np.sqrt(np.linspace(first**2, last**2, entries))
    energy, force = _functions(formula)
    with np.errstate(all="ignore"):
        u, f = energy(r), force(r)
    head = f"N {entries} RSQ {first:.17g} {last:.17g}\n\n"
    rows = zip(r, np.broadcast_to(u, r.shape), np.broadcast_to(f, r.shape), strict=True)
    return head + "".join(f"{k} {x:.15g} {a:.15g} {b:.15g}\n" for k, (x, a, b) in enumerate(rows, 1))


def _functions(formula: str):
    """Functions of arrays of r: energy, and force -dU/dr."""
    r = sympy.Symbol("r", positive=True)
    text, *definitions = (part.strip() for part in formula.replace("^", "**").split(";"))
    names: dict[str, Any] = {"r": r, "max": sympy.Max}
    for definition in reversed(definitions):
        name, _, value = definition.partition("=")
        names[name] = sympy.parse_expr(value, names)
    energy = sympy.parse_expr(text, names)
    return (sympy.lambdify(r, part, ["numpy", "scipy"]) for part in (energy, -sympy.diff(energy, r)))
