"""The dielectric constant, from the fluctuation of the total dipole."""

import numpy as np

from rigidmd.analysis.findings import Curve, Finding, settled
from rigidmd.analysis.history import History
from rigidmd.analysis.registry import built_in
from rigidmd.core.statistics import correlation_time, mean
from rigidmd.errors import OutputError
from rigidmd.units import COULOMB, DEBYE


def total_dipole(history: History) -> np.ndarray:
    """Total dipole of the molecules in each frame (f, 3), e Å. Raises OutputError if a molecule has a net charge."""
    total = np.zeros((len(history), 3))
    for kind in history.kinds:
        if kind.molecule.charge:
            raise OutputError(
                f"{kind.name} has a net charge: the dipole of ions depends on the origin, and they conduct, so "
                "that its fluctuation gives no dielectric constant"
            )
        own = kind.molecule.charges @ kind.molecule.positions_body
        if history.Q.shape[1]:
            total += np.einsum("fnij,j->fi", history.Q[:, kind.index], own)
    return total


@built_in("dielectric constant from the fluctuation of the total dipole")
def dielectric(history: History) -> Finding:
    """The static dielectric constant, with the boundary condition of the scene: tin foil or a permittivity around the
    sphere of Ewald sums, or that of a reaction field (Neumann 1983, Mol. Phys. 50, 841). Raises OutputError."""
    forces = history.system.scene.forces
    if not history.has_box:
        raise OutputError("a dielectric constant needs a box")
    if not any(m.charges.any() for m in history.system.species):
        raise OutputError("no molecule has charges: there is no dielectric constant")
    if history.system.scene.fields.electric_V_per_nm is not None:
        raise OutputError("an electric field acts: the fluctuation of the dipole gives no dielectric constant there")
    if forces.electrostatics in ("ewald", "pme"):
        around = forces.ewald_surface_permittivity
    elif forces.electrostatics == "reaction_field":
        around = forces.reaction_field_permittivity
    else:
        raise OutputError(
            f"electrostatics = {forces.electrostatics!r} has no known boundary for the fluctuation of the dipole; take "
            "pme, ewald or reaction_field"
        )
    dipole = total_dipole(history)
    if not any(kind.molecule.has_dipole for kind in history.kinds):
        raise OutputError("no molecule has a dipole: its fluctuation gives no dielectric constant")
    gap = history.span / (len(history) - 1)
    off = dipole - dipole.mean(axis=0)
    squares = np.einsum("fi,fi->f", off, off)
    size, error = mean(squares)
    correlation = float(np.mean([correlation_time(dipole[:, k], gap) for k in range(3)]))
    volume = float(history.volume.mean())
    y = 4 * np.pi * COULOMB * squares.mean() / (3 * volume * history.thermal_energy)  # <M²>/(3 eps0 V kT)
    found = Finding("dielectric", "dielectric constant")
    if y >= 2 * around + 1:
        raise OutputError(
            f"the dipole fluctuates more than it can with a permittivity of {around:g} around: the run is too short, "
            "or the liquid freezes or is polarised"
        )
    epsilon, slope = _of_fluctuation(y, around)
    # of the squares themselves, but not less than that of three Gaussian numbers with this correlation time
    share = max(float(error or 0.0) / float(size or np.inf), np.sqrt(2 * correlation / (3 * history.span)))
    spread = share * y * float(slope)
    surroundings = "tin foil" if np.isinf(around) else f"a permittivity of {around:g}"
    told = f"{surroundings} around, {forces.electrostatics}; correlation time of the dipole {correlation:.3g} ps"
    found.values.append(settled("dielectric constant", "1", float(epsilon), spread, history.span, correlation, told))
    count = np.arange(1, len(dipole) + 1)
    sums = np.cumsum(np.einsum("fi,fi->f", dipole, dipole)), np.cumsum(dipole, axis=0)
    running = sums[0] / count - np.sum((sums[1] / count[:, None]) ** 2, axis=1)
    so_far = _of_fluctuation(running * y / squares.mean(), around)[0]
    time = ("Time (ps)", history.time)
    found.curves += [
        Curve("dielectric", time, "dielectric constant so far", {"dielectric constant": so_far}),
        Curve("dipole", time, "total dipole (D)", {f"M{k} (D)": dipole[:, i] / DEBYE for i, k in enumerate("xyz")}),
    ]
    return found


def _of_fluctuation(y, around: float):
    """epsilon from y = (<M²> - <M>²)/(3 eps0 V kT), and its derivative with y; around: permittivity outside. NaN for y
    of 2 around + 1 and above, which no epsilon has.

    (eps - 1)(2 around + 1)/(2 around + eps) = y, and eps - 1 = y with tin foil.
    """
    if np.isinf(around):
        return 1 + y, 1.0
    whole = 2 * around + 1
    left = np.where(y < whole, whole - y, np.nan)
    return (whole + 2 * around * y) / left, (whole / left) ** 2
