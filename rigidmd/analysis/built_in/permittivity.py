"""The dielectric constant, from the fluctuation of the total dipole."""

import numpy as np

from rigidmd.analysis.registry import built_in
from rigidmd.analysis.result import AnalysisResult, Curve, converged_value
from rigidmd.analysis.rigid_frames import RigidFrames
from rigidmd.core.statistics import correlation_time, mean_and_error
from rigidmd.errors import OutputError
from rigidmd.units import COULOMB, DEBYE


def total_dipole(frames: RigidFrames) -> np.ndarray:
    """Total dipole of the molecules in each frame (f, 3), e Å. Raises OutputError if a molecule has a net charge."""
    total = np.zeros((len(frames), 3))
    for kind in frames.kinds:
        if kind.molecule.charge:
            raise OutputError(
                f"{kind.name} has a net charge: the dipole of ions depends on the origin, and ions conduct, so "
                "the fluctuation gives no dielectric constant"
            )
        dipole_body = kind.molecule.charges @ kind.molecule.positions_body
        if frames.Q.shape[1]:
            total += np.einsum("fnij,j->fi", frames.Q[:, kind.index], dipole_body)
    return total


@built_in("dielectric constant from the fluctuation of the total dipole", position=90)
def dielectric(frames: RigidFrames) -> AnalysisResult:
    """The static dielectric constant, with the boundary condition of the scene: tin foil or a permittivity around the
    sphere of Ewald sums or the cavity of a reaction field (Neumann 1983, Mol. Phys. 50, 841). Raises OutputError."""
    forces = frames.system.scene.forces
    if not frames.has_box:
        raise OutputError("a dielectric constant needs a box")
    if not any(m.charges.any() for m in frames.system.species):
        raise OutputError("a dielectric constant needs molecules with charges")
    if frames.system.scene.fields.electric_V_per_nm is not None:
        raise OutputError("an electric field acts: the fluctuation of the dipole gives no dielectric constant there")
    if forces.electrostatics in ("ewald", "pme"):
        around = forces.ewald_surface_permittivity
    elif forces.electrostatics == "reaction_field":
        around = forces.reaction_field_permittivity
    else:
        raise OutputError(
            f"electrostatics = {forces.electrostatics!r} has no known boundary for the fluctuation of the dipole; use "
            "pme, ewald or reaction_field"
        )
    dipole = total_dipole(frames)
    if not any(kind.molecule.has_dipole for kind in frames.kinds):
        raise OutputError("no molecule has a dipole: its fluctuation gives no dielectric constant")
    gap = frames.span / (len(frames) - 1)
    off = dipole - dipole.mean(axis=0)
    squares = np.einsum("fi,fi->f", off, off)
    size, error = mean_and_error(squares)
    correlation = float(np.mean([correlation_time(dipole[:, k], gap) for k in range(3)]))
    volume = float(frames.volume.mean())
    y = 4 * np.pi * COULOMB * squares.mean() / (3 * volume * frames.thermal_energy)  # <M²>/(3 eps0 V kT)
    found = AnalysisResult("dielectric", "dielectric constant")
    if y >= 2 * around + 1:
        raise OutputError(
            f"the dipole fluctuates more than it can with a permittivity of {around:g} around: the run is too short, "
            "or the liquid freezes or is polarised"
        )
    epsilon, slope = _of_fluctuation(y, around)
    # error of the squares, but not less than of three Gaussian numbers with this correlation time
    relative_error = max(float(error or 0.0) / float(size or np.inf), np.sqrt(2 * correlation / (3 * frames.span)))
    spread = relative_error * y * float(slope)
    surroundings = "tin foil" if np.isinf(around) else f"a permittivity of {around:g}"
    note = f"{surroundings} around, {forces.electrostatics}; correlation time of the dipole {correlation:.3g} ps"
    name, value = "dielectric constant", float(epsilon)
    found.values.append(converged_value(name, "1", value, spread, frames.span, correlation, note))
    count = np.arange(1, len(dipole) + 1)
    sums = np.cumsum(np.einsum("fi,fi->f", dipole, dipole)), np.cumsum(dipole, axis=0)
    running = sums[0] / count - np.sum((sums[1] / count[:, None]) ** 2, axis=1)
    so_far = _of_fluctuation(running * y / squares.mean(), around)[0]
    time = ("Time (ps)", frames.time)
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
