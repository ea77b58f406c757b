"""Columns of results: one table for molecules and one for a body, for files, displays and documentation.

For molecules the table is the record itself (`samples.Sample`): each field carries a `Column`.
"""

from typing import NamedTuple


class Column(NamedTuple):
    """Header, unit and meaning of a column."""

    header: str  # in log.csv or motion.csv; empty if it is not written
    unit: str  # "1" of plain numbers, empty of words
    about: str


class Family(NamedTuple):
    """Columns of a body that belong together."""

    names: tuple[str, ...]
    unit: str
    about: str


BODY = {
    "time": Family(("time",), "s", "time"),
    "position": Family(("x", "y", "z"), "m", "centre of mass"),
    "velocity": Family(("vx", "vy", "vz"), "m/s", "its velocity"),
    "rotation": Family(
        tuple(f"q{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "1", "rotation matrix Q by rows: lab = Q body"
    ),
    "quaternion": Family(("qw", "qx", "qy", "qz"), "1", "Q as a quaternion whose sign does not jump"),
    "euler_angles": Family(("phi", "theta", "psi"), "rad", "Q as Euler angles, 3-1-3"),
    "h_body": Family(tuple(f"h_body_{k}" for k in (1, 2, 3)), "kg m²/s", "angular momentum of wheels, body axes"),
    "omega_body": Family(tuple(f"omega_body_{k}" for k in (1, 2, 3)), "rad/s", "angular velocity, body axes"),
    "omega_lab": Family(tuple(f"omega_lab_{k}" for k in "xyz"), "rad/s", "angular velocity, lab axes"),
    "L_body": Family(tuple(f"L_body_{k}" for k in (1, 2, 3)), "kg m²/s", "angular momentum with wheels, body axes"),
    "L_lab": Family(tuple(f"L_lab_{k}" for k in "xyz"), "kg m²/s", "angular momentum with wheels, lab axes"),
    "kinetic": Family(("kinetic",), "J", "kinetic energy of I omega; less Omega · J in a turning frame"),
    "potential": Family(("potential",), "J", "potential energy"),
    "energy": Family(("energy",), "J", "kinetic and potential energy"),
    "work": Family(("work",), "J", "work of drives and resistance: energy - work is conserved"),
    "energy_error": Family(
        ("energy_error",), "1", "change of energy - work, as a fraction of the largest kinetic energy"
    ),
    "L_error": Family(
        tuple(f"L_{k}_error" for k in ("lab", "size", "x", "y", "z", 1, 2, 3)),
        "1",
        "change of what is conserved of L, as a fraction of the largest abs(L)",
    ),
    "orthogonality_error": Family(("orthogonality_error",), "1", "largest entry of abs(QᵀQ - 1)"),
}

#: Additional key of `results[...]` for a body: several columns as one array.
MATRIX = "Q"

BODY_COLUMNS = {
    name: Column("t" if name == "time" else name, family.unit, family.about)
    for family in BODY.values()
    for name in family.names
}
