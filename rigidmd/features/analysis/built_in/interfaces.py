"""Slabs between two vapours: coexisting densities, width and orientation at the interface, surface
tension."""

import warnings
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import optimize

from rigidmd.core.statistics import correlation_time, mean_and_error
from rigidmd.errors import OutputError
from rigidmd.features.analysis.conditions import box, trajectory
from rigidmd.features.analysis.options import Axis
from rigidmd.features.analysis.registry import built_in
from rigidmd.features.analysis.result import (
    AnalysisResult,
    Curve,
    Value,
    converged_value,
    correlation_time_of,
    mean_of_series,
)
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.features.analysis.runs import Runs
from rigidmd.run.rigid_fit import Kind
from rigidmd.units import BAR, GRAM_PER_CM3

#: mN/m in u/ps².
MN_PER_M = 100 * BAR
BIN = 0.5  # Å
#: The density of the vapour is at most this fraction of the density of the liquid.
LARGEST_RATIO = 0.5
#: Minimum number of dipoles in a bin for a mean, as a fraction of the largest number in a bin.
FEWEST = 1e-3


class Slab(NamedTuple):
    """Distances from the middle of a slab along its normal, which is an edge at right angles to the
    others."""

    axis: int
    area: float  # Å²
    height: float  # of the box along the normal, Å
    distance: np.ndarray  # (f, s) of the sites with mass, Å
    centre: np.ndarray  # (f, n) of the centres of mass, Å
    mass: np.ndarray  # (s,)
    species: np.ndarray  # (s,) its name


def slab_of(frames: RigidFrames, axis: str) -> Slab:
    """A slab, centred in each frame. Raises OutputError."""
    k = "xyz".index(axis)
    across = [i for i in range(3) if i != k]
    if frames.cell[:, k, across].any() or frames.cell[:, across, k].any():
        raise OutputError(f"a slab needs an edge along {axis} at right angles to the others")
    height = frames.cell[:, k, k]
    arms = [np.zeros((len(frames), 0))]
    masses, species = [], []
    for kind in frames.kinds:
        for offset, mass in zip(kind.molecule.positions_body, kind.molecule.masses, strict=True):
            if mass > 0:
                arm = frames.Q[:, kind.index, k] @ offset if frames.Q.shape[1] else 0.0
                arms.append(frames.positions[:, kind.index, k] + arm)
                masses.append(np.full(len(kind.index), mass))
                species.append(np.full(len(kind.index), kind.name))
    at = np.concatenate(arms, axis=1) / height[:, None]
    mass = np.concatenate(masses)
    middle = np.angle(np.exp(2j * np.pi * at) @ mass)[:, None] / (2 * np.pi)

    def centred(fraction: np.ndarray) -> np.ndarray:
        return ((fraction - middle + 0.5) % 1.0 - 0.5) * height[:, None]

    area = float(np.mean(frames.volume / height))
    centre = frames.positions[:, :, k] / height[:, None]
    names = np.concatenate(species)
    return Slab(k, area, float(height.mean()), centred(at), centred(centre), mass, names)


def profile(z: np.ndarray, liquid: float, vapour: float, half: float, width: float) -> np.ndarray:
    """Density at a distance z from the middle of a slab of thickness 2 half: the tanh profile of
    its interfaces."""
    return 0.5 * (liquid + vapour) - 0.5 * (liquid - vapour) * np.tanh((z - half) / width)


def fitted(z: np.ndarray, density: np.ndarray, height: float) -> np.ndarray:
    """Parameters of `profile` (densities in g/cm³, lengths in Å) for densities (bins,) at distances
    z in a box of this height. Raises OutputError."""
    top = float(np.quantile(density, 0.95))
    low = float(density[-len(z) // 5 :].mean())
    half = float(np.sum(density - low) * (z[1] - z[0]) / max(top - low, 1e-9 * top))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", optimize.OptimizeWarning)
            parameters, _ = optimize.curve_fit(
                profile, z, density, (top, low, half, 2.0), maxfev=4000
            )
    except (RuntimeError, optimize.OptimizeWarning):
        raise OutputError("the density has no profile of a slab between two vapours") from None
    liquid, vapour, half, width = parameters
    if not (vapour < LARGEST_RATIO * liquid and abs(width) < half < height / 2 - abs(width)):
        raise OutputError("the box has no slab between two vapours along this axis")
    return np.array([liquid, vapour, half, abs(width)])


class Profiles(NamedTuple):
    """Densities of slabs at distances from their middles, mean of both sides."""

    slabs: list[Slab]  # of each run
    height: float  # of the box along the normal, Å
    z: np.ndarray  # (bins,) Å
    of_species: dict[str, list[np.ndarray]]  # (f, bins) in each frame of each run, g/cm³

    @property
    def densities(self) -> list[np.ndarray]:
        """Of all species (f, bins), in each frame of each run, g/cm³."""
        return [np.sum(of_run, axis=0) for of_run in zip(*self.of_species.values(), strict=True)]

    @property
    def edges(self) -> np.ndarray:
        """Edges of the bins (bins + 1,), Å."""
        return np.linspace(0.0, self.height / 2, len(self.z) + 1)


def profiles_of(runs: Runs, axis: str) -> Profiles:
    """The profiles of a slab in all frames. Raises OutputError."""
    slabs = [slab_of(run, axis) for run in runs.members]
    height = float(runs.mean([slab.height for slab in slabs]))
    bins = max(8, int(height / 2 / BIN))
    edges = np.linspace(0.0, height / 2, bins + 1)
    of_species: dict[str, list[np.ndarray]] = {kind.name: [] for kind in runs.kinds}
    for slab in slabs:
        volume = 2 * slab.area * np.diff(edges)
        for name, densities in of_species.items():
            sites = np.flatnonzero(slab.species == name)
            masses = [
                np.histogram(np.abs(frame[sites]), edges, weights=slab.mass[sites])[0]
                for frame in slab.distance
            ]
            densities.append(np.array(masses) / volume / GRAM_PER_CM3)
    return Profiles(slabs, height, 0.5 * (edges[1:] + edges[:-1]), of_species)


def _changes_of_fit(z: np.ndarray, densities: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Parameters (f, 4) that follow to first order from the densities (f, bins) of each frame."""
    steps = 1e-6 * np.maximum(np.abs(parameters), 1e-3)
    shifted = [
        (profile(z, *(parameters + step)), profile(z, *(parameters - step)))
        for step in np.diag(steps)
    ]
    slopes = np.array(
        [
            (after - before) / (2 * step)
            for (after, before), step in zip(shifted, steps, strict=True)
        ]
    ).T
    return parameters + (densities - profile(z, *parameters)) @ np.linalg.pinv(slopes).T


@built_in(
    "interfaces of a slab: coexisting densities, width, orientation",
    position=32,
    needs=(trajectory, box),
)
def interfaces(runs: Runs, axis: Axis = "z") -> AnalysisResult:
    """Liquid and vapour densities, slab thickness and interface width, from a fit of

    rho(z) = (rho_l + rho_v)/2 - (rho_l - rho_v)/2 tanh((z - z0)/d)

    to the profile about the middle of the slab, averaged over both sides (Rowlinson & Widom 1982).
    In a mixture also densities and mole fractions of each species in both phases. Errors of one run
    are from the correlated series of what each frame changes in the fit. The curve also has the
    mean cosine of dipoles with the outward normal.

    Parameters
    ----------
    axis : {"z", "x", "y"}, optional
        Normal of the slab
    """
    profiles = profiles_of(runs, axis)
    densities = profiles.densities
    means = [of_run.mean(axis=0) for of_run in densities]
    density = runs.mean(means)
    fit = fitted(profiles.z, density, profiles.height)
    series = [_changes_of_fit(profiles.z, of_run, fit) for of_run in densities]
    errors: list[float | None]
    if runs.are_several:

        def fit_of(mean: np.ndarray) -> np.ndarray:
            return fitted(profiles.z, mean, profiles.height)

        errors = runs.estimate(means, fit_of)[1].tolist()
    else:
        errors = [mean_and_error(values)[1] for values in series[0].T]
    names = (
        ("liquid", "g/cm³", 1.0),
        ("vapour", "g/cm³", 1.0),
        ("thickness of the slab", "Å", 2.0),
        ("width d", "Å", 1.0),
    )
    result = AnalysisResult("interfaces", f"interfaces of a slab across {axis}")
    for k, (name, unit, factor) in enumerate(names):
        note = "from 10 to 90 % of the density it is 2.197 d" if name == "width d" else ""
        error = None if errors[k] is None else factor * float(errors[k] or 0.0)
        tau = correlation_time_of(runs, [of_run[:, k] for of_run in series])
        result.values.append(Value(name, unit, factor * float(fit[k]), error, tau, note))
    axis_of_curve = ("distance from the middle (A)", profiles.z)
    curve = Curve("interfaces", axis_of_curve, "density (g/cm³)", {"density (g/cm3)": density})
    curve.columns["fit (g/cm3)"] = profile(profiles.z, *fit)
    result.curves.append(curve)
    if len(profiles.of_species) > 1:
        result.values += _values_of_species(runs, profiles, fit)
        for name, of_runs in profiles.of_species.items():
            curve.columns[f"{name} (g/cm3)"] = runs.mean(
                [frames.mean(axis=0) for frames in of_runs]
            )
    for kind in runs.kinds:
        if kind.molecule.has_dipole and runs.has_rotations:
            mean = _mean_cosine(runs, profiles, kind)
            title = f"mean cosine of dipoles {kind.name}"
            result.curves.append(
                Curve(f"dipoles_{kind.name}", curve.axis, "mean cosine", {title: mean}, level=0.0)
            )
    return result


def _values_of_species(runs: Runs, profiles: Profiles, fit: np.ndarray) -> list[Value]:
    """Densities and mole fractions of the species in the liquid and in the vapour, with the middle
    and the width of the interface of all of them.

    A species may be enriched at the interface, so its density there has little weight.
    """
    _, _, half, width = fit
    level = np.tanh((profiles.z - half) / width)
    weight = level**4  # the root of that of a square
    phases = np.stack([1 - level, 1 + level], axis=1) / 2
    solution = np.linalg.pinv(weight[:, None] * phases) * weight
    masses = {kind.name: kind.molecule.mass for kind in runs.kinds}
    # (f, species, phases) of each run
    series = [
        np.stack([frames @ solution.T for frames in of_run], axis=1)
        for of_run in zip(*profiles.of_species.values(), strict=True)
    ]
    amounts = [of_run / np.array(list(masses.values()))[:, None] for of_run in series]
    mean = runs.mean([of_run.mean(axis=0) for of_run in amounts])
    total = mean.sum(axis=0)
    # what each frame changes in the fractions, to first order
    fractions = [
        (mean + of_run - mean / total * of_run.sum(axis=1, keepdims=True)) / total
        for of_run in amounts
    ]
    values = []
    for title, unit, quantities in (("", "g/cm³", series), ("mole fraction of ", "1", fractions)):
        for (k, name), (j, phase) in product(enumerate(masses), enumerate(("liquid", "vapour"))):
            of_runs = [of_run[:, k, j] for of_run in quantities]
            value, error = mean_of_series(runs, of_runs)
            tau = correlation_time_of(runs, of_runs)
            values.append(Value(f"{title}{name} in the {phase}", unit, value, error, tau))
    return values


def _mean_cosine(runs: Runs, profiles: Profiles, kind: Kind) -> np.ndarray:
    """Mean cosine (bins,) of the dipoles of a species with the outward normal. NaN where there are
    few."""
    dipole = kind.molecule.charges @ kind.molecule.positions_body
    count, total = np.zeros(len(profiles.z)), np.zeros(len(profiles.z))
    for run, slab in zip(runs.members, profiles.slabs, strict=True):
        cosine = run.Q[:, kind.index, slab.axis] @ (dipole / np.linalg.norm(dipole))
        at = slab.centre[:, kind.index]
        count += np.histogram(np.abs(at), profiles.edges)[0]
        total += np.histogram(np.abs(at), profiles.edges, weights=cosine * np.sign(at))[0]
    return np.divide(
        total, count, out=np.full(len(profiles.z), np.nan), where=count > FEWEST * count.max()
    )


@built_in(
    "surface tension of a slab from the pressure tensor", position=105, needs=(trajectory, box)
)
def surface_tension(runs: Runs, axis: Axis = "z") -> AnalysisResult:
    """Surface tension (mN/m) of the two interfaces of a slab: L/2 <P_N - P_T> (Kirkwood & Buff
    1949), with the edge L and the pressure P_N along the normal, and the mean pressure P_T across
    it.

    Parameters
    ----------
    axis : {"z", "x", "y"}, optional
        Normal of the slab
    """
    profiles = profiles_of(runs, axis)
    density = runs.mean([densities.mean(axis=0) for densities in profiles.densities])
    fitted(profiles.z, density, profiles.height)  # raises without a slab
    samples = [
        _tension_of(run, slab) for run, slab in zip(runs.members, profiles.slabs, strict=True)
    ]
    series = [values for _, values in samples]
    value, error = mean_of_series(runs, series)
    spans = [float(time[-1] - time[0]) for time, _ in samples]
    of_runs = [
        correlation_time(values, span / (len(values) - 1))
        for values, span in zip(series, spans, strict=True)
    ]
    fewest = min(map(len, series))
    running = np.mean([np.cumsum(values[:fewest]) for values in series], axis=0) / np.arange(
        1, fewest + 1
    )
    some = np.unique(np.linspace(fewest // 20, fewest - 1, 500).astype(int))
    result = AnalysisResult("surface_tension", f"surface tension across {axis}")
    time = ("Time (ps)", samples[0][0][some])
    title = "running mean (mN/m)"
    result.curves.append(Curve("surface_tension", time, title, {title: running[some]}))
    is_cut = runs.system.scene.forces.dispersion == "cutoff"
    note = "of the forces in the run: without dispersion beyond the cutoff" if is_cut else ""
    tau = float(np.mean(of_runs))
    result.values.append(
        converged_value("surface tension", "mN/m", value, error, sum(spans), tau, note)
    )
    return result


def _tension_of(frames: RigidFrames, slab: Slab) -> tuple[np.ndarray, np.ndarray]:
    """Times (l,), ps, and surface tensions (l,), mN/m. Raises OutputError."""
    time, pressure = _pressures(frames)
    if len(time) < 2:
        raise OutputError(
            "a surface tension needs samples of the pressure tensor: there are fewer than two"
        )
    normal = pressure[slab.axis]
    return time, 0.5 * slab.height * 1.5 * (normal - pressure.mean(axis=0)) * BAR / MN_PER_M


def _pressures(frames: RigidFrames) -> tuple[np.ndarray, np.ndarray]:
    """Times (l,), ps, and diagonal of the pressure tensor (3, l), bar, from its file or the log.
    Raises OutputError."""
    if frames.tensor is not None:
        return frames.tensor[:, 0], frames.tensor[:, 1:4].T
    diagonal = [frames.columns.get(f"pressure_{x}{x}") for x in "xyz"]
    if any(column is None or not np.isfinite(column).all() for column in diagonal):
        raise OutputError(
            "a surface tension needs the pressure tensor, which this run did not write: set "
            "output.pressure_tensor_interval_ps = 0.05, or output.pressure_tensor = true"
        )
    return frames.columns["time"], np.array(diagonal)
