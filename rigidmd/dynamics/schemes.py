"""Integrators as data: palindromes of kicks (forces and torques) and drifts (free flight and free rotation).

A row says by which fractions of the time step the two flows alternate, kick first. Both flows are symplectic and
time-reversible, so any palindrome of them is too; its coefficients decide its order.
"""

from itertools import pairwise
from typing import NamedTuple


class Scheme(NamedTuple):
    """kick(kicks[0] dt) drift(drifts[0] dt) kick(kicks[1] dt) ... kick(kicks[-1] dt)."""

    name: str
    kicks: tuple[float, ...]  # one more than drifts; sum 1
    drifts: tuple[float, ...]  # sum 1
    order: int
    source: str


def composed(name: str, steps: tuple[float, ...], order: int, source: str) -> Scheme:
    """Velocity Verlet steps of these lengths one after the other; neighbouring kicks are one."""
    kicks = (steps[0] / 2, *((a + b) / 2 for a, b in pairwise(steps)), steps[-1] / 2)
    return Scheme(name, kicks, steps, order, source)


def palindrome(*half: float) -> tuple[float, ...]:
    """Step lengths that are mirrored about the middle one, which makes their sum 1."""
    return (*half, 1 - 2 * sum(half), *reversed(half))


# Compositions of a step that is itself symmetric keep their order with any rotor and any force.
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
        composed(
            "suzuki_4",
            palindrome(0.4144907717943757, 0.4144907717943757),
            order=4,
            source="Suzuki 1990, Phys. Lett. A 146, 319",
        ),
        composed(
            "kahan_li_6",
            palindrome(
                0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.082213596293550800230
            ),
            order=6,
            source="Kahan & Li 1997, Math. Comp. 66, 1089, s9odr6a; Hairer, Lubich & Wanner, eq. V.3.11",
        ),
        composed(
            "kahan_li_8",
            palindrome(
                0.13020248308889008088,
                0.56116298177510838456,
                -0.38947496264484728641,
                0.15884190655515560090,
                -0.39590389413323757734,
                0.18453964097831570709,
                0.25837438768632204729,
                0.29501172360931029887,
            ),
            order=8,
            source="Kahan & Li 1997, Math. Comp. 66, 1089, s17odr8a; Hairer, Lubich & Wanner, eq. V.3.13",
        ),
    )
}
