"""Slabs between two vapours: coexisting densities, width and orientation at the interface, surface tension."""

import warnings
from typing import NamedTuple

import numpy as np
from scipy import optimize

from rigidmd.analysis.registry import built_in
from rigidmd.analysis.result import AnalysisResult, Curve, Value, converged_value, with_block_error
from rigidmd.analysis.rigid_frames import RigidFrames
from rigidmd.core.statistics import correlation_time, mean_and_error
from rigidmd.errors import OutputError
from rigidmd.units import BAR, GRAM_PER_CM3

#: mN/m in u/ps².
MN_PER_M = 100 * BAR
BIN = 0.5  # Å
#: The density of the vapour is at most this fraction of the density of the liquid.
LARGEST_RATIO = 0.5
#: Least number of dipoles in a bin for a mean, as a fraction of the largest number in a bin.
FEWEST = 1e-3


class Slab(NamedTuple):
    """Distances from the middle of a slab along its normal, which is an edge at right angles to the others."""

    axis: int
    area: float  # Å²
    height: float  # of the box along the normal, Å
    distance: np.ndarray  # (f, s) of the sites with mass, Å
    centre: np.ndarray  # (f, n) of the centres of mass, Å
    mass: np.ndarray  # (s,)


def slab_of(frames: RigidFrames, axis: str) -> Slab:
    """A slab, centred in each frame. Raises OutputError."""
    if axis not in ("x", "y", "z"):
        raise OutputError(f"unknown axis {axis!r}; name x, y or z")
    if not frames.has_box:
        raise OutputError("a slab needs a box")
    k = "xyz".index(axis)
    across = [i for i in range(3) if i != k]
    if frames.cell[:, k, across].any() or frames.cell[:, across, k].any():
        raise OutputError(f"a slab needs an edge along {axis} at right angles to the others")
    height = frames.cell[:, k, k]
    arms, masses = [np.zeros((len(frames), 0))], []
    for kind in frames.kinds:
        for offset, mass in zip(kind.molecule.positions_body, kind.molecule.masses, strict=True):
            if mass > 0:
                arm = frames.Q[:, kind.index, k] @ offset if frames.Q.shape[1] else 0.0
                arms.append(frames.positions[:, kind.index, k] + arm)
                masses.append(np.full(len(kind.index), mass))
    at, mass = np.concatenate(arms, axis=1) / height[:, None], np.concatenate(masses)
    middle = np.angle(np.exp(2j * np.pi * at) @ mass)[:, None] / (2 * np.pi)

    def centred(fraction: np.ndarray) -> np.ndarray:
        return ((fraction - middle + 0.5) % 1.0 - 0.5) * height[:, None]

    area, centre = float(np.mean(frames.volume / height)), frames.positions[:, :, k] / height[:, None]
    return Slab(k, area, float(height.mean()), centred(at), centred(centre), mass)


def profile(z: np.ndarray, liquid: float, vapour: float, half: float, width: float) -> np.ndarray:
    """Density at a distance z from the middle of a slab of thickness 2 half: the tanh profile of its interfaces."""
    return 0.5 * (liquid + vapour) - 0.5 * (liquid - vapour) * np.tanh((z - half) / width)


def fitted(slab: Slab) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters of `profile` (densities in g/cm³, lengths in Å), distances and densities. Raises OutputError."""
    bins = max(8, int(slab.height / 2 / BIN))
    edges = np.linspace(0.0, slab.height / 2, bins + 1)
    z, weights = 0.5 * (edges[1:] + edges[:-1]), np.broadcast_to(slab.mass, slab.distance.shape)
    mass = np.histogram(np.abs(slab.distance), edges, weights=weights)[0] / len(slab.distance)
    density = mass / (2 * slab.area * np.diff(edges)) / GRAM_PER_CM3
    top, low = float(np.quantile(density, 0.95)), float(density[-bins // 5 :].mean())
    half = float(np.sum(density - low) * (edges[1] - edges[0]) / max(top - low, 1e-9 * top))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", optimize.OptimizeWarning)
            found, _ = optimize.curve_fit(profile, z, density, (top, low, half, 2.0), maxfev=4000)
    except (RuntimeError, optimize.OptimizeWarning):
        raise OutputError("the density has no profile of a slab between two vapours") from None
    liquid, vapour, half, width = found
    if not (vapour < LARGEST_RATIO * liquid and abs(width) < half < slab.height / 2 - abs(width)):
        raise OutputError("the box has no slab between two vapours along this axis")
    return np.array([liquid, vapour, half, abs(width)]), z, density


@built_in("interfaces of a slab: coexisting densities, width, orientation", position=32)
def interfaces(frames: RigidFrames, axis: str = "z") -> AnalysisResult:
    """Densities of liquid and vapour, thickness of the slab and width of its interfaces, from a fit of

    rho(z) = (rho_l + rho_v)/2 - (rho_l - rho_v)/2 tanh((z - z0)/d)

    to the profile about the middle of the slab, averaged over both sides (Rowlinson & Widom 1982). Errors are from
    blocks. The curve also has the mean cosine of dipoles with the outward normal. Raises OutputError.
    """
    slab = slab_of(frames, axis)
    _, z, density = fitted(slab)
    whole, errors = with_block_error(frames, lambda part: fitted(slab_of(part, axis))[0])
    names = (
        ("liquid", "g/cm³", 1.0),
        ("vapour", "g/cm³", 1.0),
        ("thickness of the slab", "Å", 2.0),
        ("width d", "Å", 1.0),
    )
    found = AnalysisResult("interfaces", f"interfaces of a slab across {axis}")
    for (name, unit, factor), value, error in zip(names, whole, errors, strict=True):
        note = "from 10 to 90 % of the density it is 2.197 d" if name == "width d" else ""
        found.values.append(Value(name, unit, factor * value, factor * error, None, note))
    curve = Curve("interfaces", ("distance from the middle (A)", z), "density (g/cm³)", {"density (g/cm3)": density})
    curve.columns["fit (g/cm3)"] = profile(z, *whole)
    found.curves.append(curve)
    edges = np.linspace(0.0, slab.height / 2, len(z) + 1)
    for kind in frames.kinds:
        if kind.molecule.has_dipole and frames.Q.shape[1]:
            dipole = kind.molecule.charges @ kind.molecule.positions_body
            cosine = frames.Q[:, kind.index, slab.axis] @ (dipole / np.linalg.norm(dipole))
            at = slab.centre[:, kind.index]
            count = np.histogram(np.abs(at), edges)[0]
            total = np.histogram(np.abs(at), edges, weights=cosine * np.sign(at))[0]
            known = count > FEWEST * count.max()
            mean = np.divide(total, count, out=np.full(len(z), np.nan), where=known)
            title = f"mean cosine of dipoles {kind.name}"
            found.curves.append(Curve(f"dipoles_{kind.name}", curve.axis, "mean cosine", {title: mean}, level=0.0))
    return found


@built_in("surface tension of a slab from the pressure tensor", position=105)
def surface_tension(frames: RigidFrames, axis: str = "z") -> AnalysisResult:
    """Surface tension (mN/m) of the two interfaces of a slab: L/2 <P_N - P_T> (Kirkwood & Buff 1949), with the edge L
    and the pressure P_N along the normal, and the mean pressure P_T across it. Raises OutputError."""
    slab = slab_of(frames, axis)
    fitted(slab)
    time, pressure = _pressures(frames)
    if len(time) < 2:
        raise OutputError("a surface tension needs samples of the pressure tensor: there are fewer than two")
    normal = pressure[slab.axis]
    series = 0.5 * slab.height * 1.5 * (normal - pressure.mean(axis=0)) * BAR / MN_PER_M
    value, error = mean_and_error(series)
    assert value is not None  # there are samples
    span = float(time[-1] - time[0])
    tau = correlation_time(series, span / (len(time) - 1))
    running = np.cumsum(series) / np.arange(1, len(series) + 1)
    some = np.unique(np.linspace(len(series) // 20, len(series) - 1, 500).astype(int))
    found = AnalysisResult("surface_tension", f"surface tension across {axis}")
    found.curves.append(
        Curve(
            "surface_tension", ("Time (ps)", time[some]), "running mean (mN/m)", {"running mean (mN/m)": running[some]}
        )
    )
    is_cut = frames.system.scene.forces.dispersion == "cutoff"
    note = "of the forces in the run: without dispersion beyond the cutoff" if is_cut else ""
    found.values.append(converged_value("surface tension", "mN/m", value, error, span, tau, note))
    return found


def _pressures(frames: RigidFrames) -> tuple[np.ndarray, np.ndarray]:
    """Times (l,), ps, and diagonal of the pressure tensor (3, l), bar, from its file or the log. Raises OutputError."""
    if frames.tensor is not None:
        return frames.tensor[:, 0], frames.tensor[:, 1:4].T
    names = [f"pressure_{x}{x}" for x in "xyz"]
    if not all(name in frames.columns for name in names):
        raise OutputError(
            "a surface tension needs the pressure tensor, which this run did not write: set "
            "output.pressure_tensor_interval_ps = 0.05, or output.pressure_tensor = true"
        )
    return frames.columns["time"], np.array([frames.columns[name] for name in names])
