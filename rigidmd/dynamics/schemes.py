"""Integrators as data: palindromes of kicks (forces and torques) and drifts (free flight and free rotation).

A row says by which fractions of the time step the two flows alternate, kick first. Both flows are symplectic and
time-reversible, so any palindrome of them is too; its coefficients decide its order.
"""

from typing import NamedTuple


class Scheme(NamedTuple):
    """kick(kicks[0] dt) drift(drifts[0] dt) kick(kicks[1] dt) ... kick(kicks[-1] dt)."""

    name: str
    kicks: tuple[float, ...]  # one more than drifts; sum 1
    drifts: tuple[float, ...]  # sum 1
    order: int
    source: str


SCHEMES = {
    scheme.name: scheme
    for scheme in (
        Scheme(
            "velocity_verlet",
            kicks=(0.5, 0.5),
            drifts=(1.0,),
            order=2,
            source="Swope et al. 1982, J. Chem. Phys. 76, 637; for rigid bodies Dullweber et al. 1997",
        ),
    )
}
