"""The potential of mean force along a distance, from runs with harmonic restraints (umbrella
windows), by MBAR.

The weights of all samples follow from the free energies f_k of the windows, which minimise a convex
function (Shirts & Chodera 2008, J. Chem. Phys. 129, 124105, eq. C1). Errors are by bootstrap over
decorrelated samples.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp

from rigidmd.core.statistics import inefficiency
from rigidmd.errors import OutputError
from rigidmd.features.analysis.result import AnalysisResult, Curve, Value

NAME = "pmf"
ABOUT, OVER = "potential of mean force along a restrained distance", "the distance of a restraint"
#: Width of bins, Å; least decorrelated samples of a window and in a bin; samples of the bootstrap.
WIDTH = 0.1
LEAST_SAMPLES = 10
LEAST_IN_BIN = 6
RESAMPLED = 50
#: Fraction of the bins, at the largest distances, whose mean is the zero of the energy.
OUTER = 0.1
#: Overlap of neighbouring windows below which a window is missing between them (Klimovich, Shirts &
#: Mobley 2015, J. Comput.-Aided Mol. Des. 29, 397), and the one below which nothing connects them.
LITTLE_OVERLAP, NO_OVERLAP = 0.03, 1e-3


class Window(NamedTuple):
    """The distances of a run with a restraint."""

    distance: float  # at which the restraint has no energy, Å
    stiffness: float  # kJ/(mol Å²)
    samples: np.ndarray  # (n,) distances in equilibrium, in order, Å

    @property
    def decorrelated(self) -> np.ndarray:
        """Samples at intervals of the statistical inefficiency."""
        off = self.samples - self.samples.mean()
        return self.samples[:: max(1, round(inefficiency(off)))] if off.any() else self.samples[:1]


def potential_of_mean_force(
    windows: Sequence[Window], thermal_energy: float, width: float = WIDTH
) -> AnalysisResult:
    """W(r) = -kT ln(P(r)/r²) and the free energy -kT ln P(r) of the distance r itself, each 0 at
    the largest distances.

    Two molecules without interaction have W = 0: the factor r² is the volume of a shell (Jacobian),
    2 kT ln r.

    windows : at one temperature; thermal_energy : kT, kJ/mol; width : of bins, Å. Raises
        OutputError.
    """
    windows = sorted(windows, key=lambda window: window.distance)
    samples = [window.decorrelated for window in windows]
    for window, some in zip(windows, samples, strict=True):
        if len(some) < LEAST_SAMPLES:
            raise OutputError(
                f"the window at {window.distance:g} Å has {len(some)} decorrelated samples of "
                f"{len(window.samples)}, and needs {LEAST_SAMPLES}: run longer"
            )
    lowest, highest = (function(list(map(function, samples))) for function in (min, max))
    edges = width * np.arange(np.floor(lowest / width), np.ceil(highest / width) + 1)
    centre = (edges[1:] + edges[:-1]) / 2
    start = np.zeros(len(windows))
    free, overlap, total = _free_energies(windows, samples, thermal_energy, start)
    notes = _overlap_notes(windows, overlap)
    x = np.concatenate(samples)
    counts = np.bincount(_bins_of(x, edges), minlength=len(centre))
    filled = counts >= LEAST_IN_BIN
    profile_of_all = _profile(x, total, thermal_energy, edges, filled)
    rng = np.random.default_rng(0)
    profiles = []
    for _ in range(RESAMPLED):
        drawn = [rng.choice(some, len(some)) for some in samples]
        _, _, total = _free_energies(windows, drawn, thermal_energy, free)
        profiles.append(_profile(np.concatenate(drawn), total, thermal_energy, edges, filled))
    # in some a bin is empty
    profiles = [profile for profile in profiles if np.isfinite(profile).all()]
    if len(profiles) < RESAMPLED // 2 or filled.sum() < 2:
        raise OutputError(
            "the windows have too few samples for a potential of mean force: run longer"
        )
    error = np.std(profiles, axis=0)
    r = centre[filled]
    outer = _outer(len(r))
    jacobian = 2 * thermal_energy * np.log(r)
    jacobian -= jacobian[outer].mean()
    titles = "W (kJ/mol)", "free energy of r (kJ/mol)"
    curve = Curve(NAME, ("r (A)", r), "potential of mean force (kJ/mol)", {}, level=0.0)
    curve.add(titles[0], profile_of_all, error)
    curve.add(titles[1], profile_of_all - jacobian, error)
    k = int(profile_of_all.argmin())
    value = Value(
        "W lowest",
        "kJ/mol",
        float(profile_of_all[k]),
        float(error[k]),
        None,
        f"at r = {r[k]:.4g} Å",
    )
    total = sum(len(window.samples) for window in windows)
    notes.append(
        f"{len(windows)} windows, {sum(map(len, samples))} decorrelated of {total} samples. The"
        f" zero is the mean from {r[outer][0]:.4g} to {r[-1]:.4g} Å. W = -kT ln(P(r)/r²), without"
        " r² it is the free energy of r"
    )
    return AnalysisResult(NAME, ABOUT, [value], [curve], notes)


def _free_energies(
    windows: Sequence[Window],
    samples: Sequence[np.ndarray],
    thermal_energy: float,
    start: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Free energies (k,) of the windows in kT, 0 for the first, their overlap matrix (k, k), and
    the logarithm (n,) of the inverse weight of each sample."""
    x = np.concatenate(samples)
    bias = np.array([0.5 * w.stiffness * (x - w.distance) ** 2 for w in windows]) / thermal_energy
    count = np.array([len(some) for some in samples], float)

    def fractions(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Logarithm (n,) of the sum over windows, and the fraction (k, n) of each window in it."""
        terms = np.log(count)[:, None] + f[:, None] - bias
        total = np.asarray(logsumexp(terms, axis=0))
        return total, np.exp(terms - total)

    def function(free: np.ndarray) -> tuple[float, np.ndarray]:
        f = np.append(0.0, free)
        total, part = fractions(f)
        return float(total.sum() - count @ f), (part.sum(axis=1) - count)[1:]

    def curvature(free: np.ndarray) -> np.ndarray:
        part = fractions(np.append(0.0, free))[1]
        return (np.diag(part.sum(axis=1)) - part @ part.T)[1:, 1:]

    free = np.zeros(1)
    if len(windows) > 1:
        solution = minimize(
            function, start[1:] - start[0], jac=True, hess=curvature, method="trust-exact"
        )
        free = np.append(0.0, solution.x)
    total, part = fractions(free)
    return free, part @ part.T / count, total


def _profile(
    x: np.ndarray,
    total: np.ndarray,
    thermal_energy: float,
    edges: np.ndarray,
    filled: np.ndarray,
) -> np.ndarray:
    """W (b,) in the kept bins, kJ/mol. Not finite where samples are missing."""
    log_density = np.full(len(filled), -np.inf)  # densities differ by many orders of magnitude
    np.logaddexp.at(log_density, _bins_of(x, edges), -total - 2 * np.log(x))
    profile = -thermal_energy * log_density[filled]
    with np.errstate(invalid="ignore"):
        return profile - profile[_outer(len(profile))].mean()


def _bins_of(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Numbers (n,) of the bins of distances."""
    return np.clip(np.searchsorted(edges, x, "right") - 1, 0, len(edges) - 2)


def _outer(bins: int) -> slice:
    """The bins whose mean energy is zero."""
    return slice(-max(1, round(OUTER * bins)), None)


def _overlap_notes(windows: Sequence[Window], overlap: np.ndarray) -> list[str]:
    """Notes on neighbouring windows that share few samples. Raises OutputError if nothing connects
    two groups."""
    pairs = [(k, float(overlap[k, k + 1])) for k in range(len(windows) - 1)]
    if not pairs:
        return []
    gap = 1 - np.sort(np.linalg.eigvals(overlap).real)[-2]
    k, least = min(pairs, key=lambda pair: pair[1])
    where = f"the windows at {windows[k].distance:g} and {windows[k + 1].distance:g} Å"
    if gap < NO_OVERLAP:
        raise OutputError(
            f"{where} have no common distances: add a window between them, or use softer restraints"
        )
    if least < LITTLE_OVERLAP:
        return [
            f"{where} barely overlap ({least:.2g}, {LITTLE_OVERLAP:g} is enough): add a window"
            " between them"
        ]
    return []
