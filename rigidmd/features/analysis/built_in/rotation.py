"""Rotation, spectra and dipoles: orientational correlation, rotational diffusion, densities of
states. The dielectric constant from the fluctuation of the total dipole."""

from collections.abc import Callable

import numpy as np
from scipy import signal
from scipy.spatial.transform import Rotation

from rigidmd.errors import OutputError
from rigidmd.features.analysis.built_in.transport import (
    correlation,
    interval_and_lags,
    squared_displacement,
)
from rigidmd.features.analysis.conditions import box, equilibrium, motion, trajectory, velocities
from rigidmd.features.analysis.registry import built_in
from rigidmd.features.analysis.result import (
    BLOCKS,
    AnalysisResult,
    Curve,
    Value,
    converged_value,
    correlation_time_of,
    mean_of_series,
    too_short,
    with_group_error,
)
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.features.analysis.runs import Runs
from rigidmd.mechanics.inertia import rotational_freedom
from rigidmd.run.rigid_fit import Kind
from rigidmd.scene.validation import not_none
from rigidmd.units import COULOMB, DEBYE

#: correlation at which the integral of a correlation function is continued by an exponential
TAIL = 0.05
#: Correlation at the longest lag above which the integral has no value: too much of it would be
#: that exponential.
HIGH = 0.2
SLOWEST = 0.98  # largest correlation at the longest lag from which the decay time is estimated
#: Largest root mean square rotation between two frames, rad, at which rotations about the body's
#: axes can be summed.
LARGEST_ROTATION = 0.7
CLOSE = 0.5  # least correlation of a velocity over one interval of frames for a spectrum
PER_CM = 0.0299792458  # 1/cm in 1/ps


def _axes(kind: Kind) -> list[int]:
    """Body axes that are defined: all three, or the axis of a linear molecule."""
    return [0] if rotational_freedom(kind.molecule.kind) == 2 else [0, 1, 2]


@built_in(
    "orientational correlation C1 and C2 about each body axis, and rotational diffusion",
    position=70,
    needs=(trajectory, motion),
)
def orientation(runs: Runs) -> AnalysisResult:
    """C_l(t) = <P_l(u(0)·u(t))>, l = 1, 2, of principal axes u, correlation times (ps), rotational
    diffusion (1/ps).

    Axes are those of `rigidmd models NAME`, ascending in inertia. A linear molecule has one.
    Rotational diffusion is the slope of the mean squared rotation about an axis of the body, summed
    over frames."""
    if not (kinds := [kind for kind in runs.moving if kind.molecule.degrees_of_freedom > 3]):
        raise OutputError("no molecule of this run rotates")
    interval, lags = interval_and_lags(runs, "an orientational correlation")
    time = interval * np.arange(lags)
    result = AnalysisResult("orientation", "orientational correlation")
    curve = Curve("orientation", ("Time (ps)", time), "C(t)", {}, level=0.0, per_color=2)
    result.curves.append(curve)
    for kind in kinds:
        if (along := _axis_along_dipole(kind)) is not None:
            result.notes.append(f"axis {along + 1} of {kind.name} is along its dipole")
        for axis in _axes(kind):

            def compute(part: RigidFrames, group: Kind, axis=axis) -> np.ndarray:
                """C1 and C2 of this axis (2, lags)."""
                u = part.Q[..., axis][:, group.index]
                first = 3 * correlation(u, lags)
                squares = np.stack([u[..., i] * u[..., i] for i in range(3)], axis=-1)
                mixed = np.stack([u[..., i] * u[..., (i + 1) % 3] for i in range(3)], axis=-1)
                second = 1.5 * 3 * (correlation(squares, lags) + 2 * correlation(mixed, lags)) - 0.5
                return np.stack([first, second])

            values, errors = with_group_error(
                runs,
                kind,
                compute,
                lambda both: np.stack([np.append(c, _integral(c, interval)) for c in both]),
            )
            for l in (0, 1):  # noqa: E741
                C, doubt = values[l, :-1], errors[l, :-1]
                curve.add(f"C{l + 1} {kind.name} axis {axis + 1}", C, doubt)
                tau, error = float(values[l, -1]), float(errors[l, -1])
                name = f"tau{l + 1} of {kind.name}, axis {axis + 1}"
                if C[-1] > HIGH:
                    # an exponential falls to HIGH at a lag, and a run is 2 BLOCKS times as long as
                    # its longest lag
                    need = 2 * BLOCKS * time[-1] * np.log(HIGH) / np.log(min(float(C[-1]), SLOWEST))
                    about = "about" if C[-1] < SLOWEST else "more than"
                    why = (
                        f"C{l + 1} is still {C[-1]:.2f} after {time[-1]:.3g} ps, too short for a"
                        f" value. It needs {about} {need:.2g} ps"
                    )
                    result.values.append(too_short(name, "ps", tau, None, why))
                    continue
                low = int(C.argmin())
                note = ""
                if C[low] < -max(TAIL, 3 * float(np.nan_to_num(doubt[low]))):
                    note = (
                        f"to where C{l + 1} first falls below {TAIL:g}. At {time[low]:.3g} ps it is"
                        f" {C[low]:.2f}"
                    )
                result.values.append(
                    converged_value(name, "ps", tau, error, runs.span, tau, note, BLOCKS)
                )
        result.values += _rotational_diffusion(runs, kind, interval, lags)
    return result


def _axis_along_dipole(kind: Kind) -> int | None:
    """The principal axis along the dipole of a neutral molecule, or None."""
    dipole = kind.molecule.charges @ kind.molecule.positions_body
    along = int(np.abs(dipole).argmax())
    is_along = abs(dipole[along]) >= (1 - 1e-6) * float(np.linalg.norm(dipole))
    return along if is_along and kind.molecule.has_dipole and not kind.molecule.charge else None


def _integral(values: np.ndarray, interval: float) -> float:
    """Integral of a correlation function that starts at 1: to where it has decayed, then an
    exponential."""
    below = np.flatnonzero(values < TAIL)
    end = int(below[0]) if len(below) else len(values) - 1
    body = float(np.trapezoid(values[: end + 1], dx=interval))
    half = np.flatnonzero(values < np.sqrt(max(values[end], 1e-3)))
    start = int(half[0]) if len(half) else 0
    if end <= start or values[end] <= 0 or values[start] <= values[end]:
        return body
    decay = interval * (end - start) / np.log(values[start] / values[end])
    return body + float(values[end] * decay)


def _rotations(frames: RigidFrames, kind: Kind) -> np.ndarray:
    """Rotation vectors between frames along the body's axes (f - 1, k, 3), rad."""
    Q = frames.Q[:, kind.index]
    between = np.einsum("fnji,fnjk->fnik", Q[:-1], Q[1:])
    return (
        Rotation.from_matrix(between.reshape(-1, 3, 3)).as_rotvec().reshape(*between.shape[:2], 3)
    )


def _rotational_diffusion(runs: Runs, kind: Kind, interval: float, lags: int) -> list[Value]:
    if len(_axes(kind)) == 1:
        return []
    squares = [np.mean(np.sum(_rotations(run, kind) ** 2, axis=-1)) for run in runs.members]
    rms = float(np.sqrt(runs.mean(squares)))
    names = [f"D_rot of {kind.name}, axis {k + 1}" for k in range(3)]
    if rms > LARGEST_ROTATION:
        note = (
            f"molecules rotate by {np.degrees(rms):.0f}° between frames, every {interval:g} ps:"
            " write more of them"
        )
        return [Value(name, "1/ps", None, None, None, note) for name in names]
    first = max(1, lags // 5)
    time = interval * np.arange(first, lags)

    def slopes(part: RigidFrames, group: Kind) -> np.ndarray:
        rotations = _rotations(part, group)
        path = np.concatenate([np.zeros_like(rotations[:1]), np.cumsum(rotations, axis=0)])
        displacements = np.stack(
            [squared_displacement(path[..., k : k + 1], lags)[first:] for k in range(3)], axis=1
        )
        return (time - time.mean()) @ displacements / np.sum((time - time.mean()) ** 2) / 2

    values, errors = with_group_error(runs, kind, slopes)
    decay = 1 / (2 * max(float(values.mean()), 1e-300))
    return [
        converged_value(name, "1/ps", float(D), float(error), runs.span, decay, least=BLOCKS)
        for name, D, error in zip(names, values, errors, strict=True)
    ]


@built_in(
    "spectra and correlations of velocities, angular velocities and angular momenta",
    position=80,
    needs=(trajectory, motion, velocities),
)
def spectrum(runs: Runs) -> AnalysisResult:
    """Densities of states (cm) for translation and for rotation about each body axis, from the
    power of velocities and angular velocities, and their correlation functions.

    The integral over wave numbers is a molecule's number of degrees of freedom. Needs frames with
    velocities, every few fs."""
    interval, lags = interval_and_lags(runs, "a spectrum")
    size = min(runs.frame_count // BLOCKS, runs.shortest)
    result = AnalysisResult("spectrum", "densities of states")
    wavenumbers = np.fft.rfftfreq(size, interval) / PER_CM
    power = Curve("spectrum", ("wave number (1/cm)", wavenumbers), "density of states (cm)", {})
    memory = Curve(
        "velocity_correlation",
        ("Time (ps)", interval * np.arange(lags)),
        "correlation",
        {},
        level=0.0,
    )
    result.curves += [power, memory]
    for kind in runs.moving:
        if kind.molecule.degrees_of_freedom > 3:

            def momenta(part, group):
                return _normalised(_lab_momenta(part, group), lags)

            memory.add(f"correlation L {kind.name}", *with_group_error(runs, kind, momenta))
        for title, (weight, of) in _rates(kind).items():
            correlations, errors = with_group_error(
                runs, kind, lambda part, group, of=of: _normalised(of(part, group), lags)
            )
            if not correlations[1] > CLOSE:
                raise OutputError(
                    f"frames every {interval:g} ps are not enough for a spectrum: {title} decays"
                    " between them. output.trajectory_interval_ps = 0.004 suits water"
                )
            memory.add(f"correlation {title}", correlations, errors)

            def states(
                part: RigidFrames, group: Kind, of=of, weight=weight / runs.thermal_energy
            ) -> np.ndarray:
                """2 weight times the power of series (f, n, d) a wave number, sum over d and mean
                over n. Cm."""
                values = of(part, group)
                total = 0.0
                for first in range(0, values.shape[1], 256):
                    some = values[:, first : first + 256].reshape(len(values), -1)
                    density = signal.welch(
                        some,
                        1 / interval,
                        "hann",
                        size,
                        detrend=False,  # type: ignore[arg-type]  # SciPy's types lack it
                        axis=0,
                    )[1]
                    total = total + density.sum(axis=1)
                return weight * np.asarray(total) * PER_CM / values.shape[1]

            power.add(title, *with_group_error(runs, kind, states))
            top = int(np.argmax(power.columns[title][1:])) + 1
            at = float(wavenumbers[top])
            half = float(wavenumbers[1] / 2)
            result.values.append(
                Value(f"highest peak of {title}", "1/cm", at, half, None, "half the resolution")
            )
    highest = 1 / (2 * interval * PER_CM)
    fine = wavenumbers[1]
    resolved = f"wave numbers up to {highest:.4g}/cm, in steps of {fine:.2g}/cm"
    result.notes.append(f"frames every {interval:g} ps resolve {resolved}")
    return result


def _rates(kind: Kind) -> dict[str, tuple[float, Callable[[RigidFrames, Kind], np.ndarray]]]:
    """The velocities of a species by name: mass or moment of inertia, and a function that returns
    their series."""
    name = kind.name
    moments = kind.molecule.inertia.tolist()
    rates: dict[str, tuple[float, Callable[[RigidFrames, Kind], np.ndarray]]] = {
        f"V {name}": (
            kind.molecule.mass,
            lambda part, group: not_none(part.velocities)[:, group.index],
        )
    }
    if kind.molecule.degrees_of_freedom <= 3:
        return rates
    if len(_axes(kind)) == 1:  # its two other axes are equivalent
        rates[f"omega {name}"] = (
            moments[2],
            lambda part, group: _lab_momenta(part, group) / moments[2],
        )
    else:
        for k, moment in enumerate(moments):

            def of(part, group, k=k, moment=moment):
                return part.L[:, group.index, k : k + 1] / moment

            rates[f"omega {name} axis {k + 1}"] = moment, of
    return rates


def _lab_momenta(frames: RigidFrames, kind: Kind) -> np.ndarray:
    """Angular momenta (f, k, 3) along the axes of the lab."""
    assert frames.L is not None
    return np.einsum("fnij,fnj->fni", frames.Q[:, kind.index], frames.L[:, kind.index])


def _normalised(values: np.ndarray, lags: int) -> np.ndarray:
    unnormalised = correlation(values, lags)
    return unnormalised / unnormalised[0]


def total_dipole(frames: RigidFrames) -> np.ndarray:
    """Total dipole of the molecules in each frame (f, 3), e Å. Raises OutputError if a molecule has
    a net charge."""
    total = np.zeros((len(frames), 3))
    for kind in frames.kinds:
        if kind.molecule.charge:
            raise OutputError(
                f"{kind.name} has a net charge: the dipole of ions depends on the origin, and ions"
                " conduct, so the fluctuation gives no dielectric constant"
            )
        dipole_body = kind.molecule.charges @ kind.molecule.positions_body
        if frames.Q.shape[1]:
            total += np.einsum("fnij,j->fi", frames.Q[:, kind.index], dipole_body)
    return total


@built_in(
    "dielectric constant from the fluctuation of the total dipole",
    position=90,
    needs=(trajectory, box, equilibrium),
)
def dielectric(runs: Runs) -> AnalysisResult:
    """The static dielectric constant, with the boundary condition of the scene: tin foil or a
    permittivity around the sphere of Ewald sums or the cavity of a reaction field (Neumann 1983,
    Mol. Phys. 50, 841).

    The mean dipole is 0 by symmetry, and is not subtracted: its square in a run of length T would
    take the fraction 2 tau/T of the fluctuation. Where something breaks the symmetry, it is
    subtracted and that fraction is added."""
    around = _permittivity_around(runs)
    dipoles = [total_dipole(run) for run in runs.members]
    if not any(kind.molecule.has_dipole for kind in runs.kinds):
        raise OutputError("no molecule has a dipole: its fluctuation gives no dielectric constant")
    correlation = float(
        np.mean([correlation_time_of(runs, [M[:, k] for M in dipoles]) for k in range(3)])
    )
    cause = _broken_symmetry(runs)
    centre = np.zeros(3)
    lost = 0.0
    if cause:
        centre = runs.mean([M.mean(axis=0) for M in dipoles])
        lost = min(0.5, 2 * correlation / runs.span)
    squares = [np.sum((M - centre) ** 2, axis=1) / (1 - lost) for M in dipoles]
    # y = <M²>/(3 eps0 V kT)
    per_square = 4 * np.pi * COULOMB / (3 * runs.volume * runs.thermal_energy)
    size, error = mean_of_series(runs, squares)
    y = per_square * size
    result = AnalysisResult("dielectric", "dielectric constant")
    if y >= 2 * around + 1:
        raise OutputError(
            f"the dipole fluctuates more than it can with a permittivity of {around:g} around: the"
            " run is too short, or the liquid freezes or is polarised"
        )
    epsilon, slope = _of_fluctuation(y, around)
    # error of the squares, but not less than of three Gaussian numbers with this correlation time
    relative_error = max(
        float(error or 0.0) / (size or np.inf), np.sqrt(2 * correlation / (3 * runs.span))
    )
    spread = relative_error * y * float(slope)
    surroundings = "tin foil" if np.isinf(around) else f"a permittivity of {around:g}"
    electrostatics = runs.system.scene.forces.electrostatics
    note = (
        f"{surroundings} around, {electrostatics}. Correlation time of the dipole"
        f" {correlation:.3g} ps"
    )
    name = "dielectric constant"
    value = float(epsilon)
    result.values.append(converged_value(name, "1", value, spread, runs.span, correlation, note))
    for k, axis in enumerate("xyz"):
        mean, doubt = mean_of_series(runs, [M[:, k] / DEBYE for M in dipoles])
        name = f"mean total dipole along {axis}"
        if doubt is None:
            result.values.append(
                too_short(name, "D", mean, None, "too short for an error", correlation)
            )
        else:
            result.values.append(Value(name, "D", mean, doubt, correlation))
    if cause:
        result.notes.append(f"{cause}: the mean dipole was subtracted")
    shown = dipoles[0][: runs.shortest], runs.first.time[: runs.shortest]
    count = np.arange(1, runs.shortest + 1)
    running = np.mean([np.cumsum(of_run[: runs.shortest]) / count for of_run in squares], axis=0)
    time = ("Time (ps)", shown[1])
    so_far, slopes = _of_fluctuation(per_square * running, around)
    errors = relative_error * np.sqrt(runs.shortest / count) * per_square * running * slopes
    curve = Curve("dielectric", time, "dielectric constant so far", {}, from_zero=True)
    curve.add("dielectric constant", so_far, np.abs(errors))
    result.curves.append(curve)
    if not runs.are_several:
        columns = {f"M{axis} (D)": shown[0][:, k] / DEBYE for k, axis in enumerate("xyz")}
        result.curves.append(Curve("dipole", time, "total dipole (D)", columns))
    return result


def _permittivity_around(runs: Runs) -> float:
    """Permittivity around the sphere of Ewald sums or the cavity of a reaction field. Infinity for
    tin foil. Raises OutputError where the fluctuation of the dipole gives no dielectric
    constant."""
    forces = runs.system.scene.forces
    if not any(m.charges.any() for m in runs.system.species):
        raise OutputError("a dielectric constant needs molecules with charges")
    if runs.system.scene.fields.electric_V_per_nm is not None:
        raise OutputError(
            "an electric field acts: the fluctuation of the dipole gives no dielectric constant"
            " there"
        )
    if forces.ewald_slab:
        raise OutputError(
            "a slab has no dielectric constant: leave forces.ewald_slab out, in a box without"
            " vacuum"
        )
    if forces.electrostatics in ("ewald", "pme"):
        return forces.ewald_surface_permittivity
    if forces.electrostatics == "reaction_field":
        return forces.reaction_field_permittivity
    raise OutputError(
        f"electrostatics = {forces.electrostatics!r} has no known boundary for the fluctuation of"
        " the dipole. Use pme, ewald or reaction_field"
    )


def _broken_symmetry(runs: Runs) -> str:
    """What distinguishes a dipole of the system from the opposite dipole, or an empty text if
    nothing does."""
    if any(not kind.moves and kind.molecule.has_dipole for kind in runs.kinds):
        return "frozen molecules have dipoles"
    if runs.system.scene.fields.entries:
        return "a field acts"
    return "a force of Python acts" if runs.system.scene.from_python else ""


def _of_fluctuation(y, around: float):
    """epsilon from y = (<M²> - <M>²)/(3 eps0 V kT), and its derivative with y; around: permittivity
    outside. NaN for y of 2 around + 1 and above, which no epsilon has.

    (eps - 1)(2 around + 1)/(2 around + eps) = y, and eps - 1 = y with tin foil.
    """
    if np.isinf(around):
        return 1 + y, 1.0
    largest = 2 * around + 1
    left = np.where(y < largest, largest - y, np.nan)
    return (largest + 2 * around * y) / left, (largest / left) ** 2
