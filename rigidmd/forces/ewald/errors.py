"""Estimated errors of Ewald sums, and the settings that keep them within an accuracy: theory
chapter `interactions`.

The unit of an error, the rms over sites, is COULOMB, the force between two charges e at a distance
of 1 Å. For dispersion it is u Å/ps².
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from math import ceil, exp, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import erfcx, gammaincc

from rigidmd.forces.ewald.direct_sum import KVectors
from rigidmd.forces.neighbors.space import Space, longest_gaps
from rigidmd.scene.models import Molecule

MAX_ALPHA_CUTOFF = 8.0  # of alpha times the cutoff: erfc is 1e-29 there
#: Along an edge in estimates: errors depend on the spacing, not on the number of points. With 16
#: they are good to 5 %.
MAX_PROXY_POINTS, SEARCH_PROXY_POINTS = 32, 16
#: Shortest real-space cutoff that is tried; time of a pair within a cutoff and a margin, on the
#: scale of the costs of grids. Measured in mixed precision with 12288 sites: 1.7 with AVX2 and
#: cutoffs of 5.5 to 7.5 Å, 1.0 on an earlier machine. The choice does not depend on the machine.
SHORTEST_CUTOFF, LIST_MARGIN, PAIR_NS = 5.0, 1.0, 1.3
ORDERS = (4, 5, 6, 7, 8)
COARSE_SPACING = 3.0  # Å, for a liquid
SPACINGS = COARSE_SPACING * 0.98 ** np.arange(-250, 150)  # Å, from which grids are chosen
MAX_GRID_POINTS = 2**16  # along an edge: enough for 0.1 mm
#: Distances inside molecules that agree to FINE digits (Å) count as equal, with MANY_CHARGES those
#: in bins of COARSE Å.
FINE, COARSE, MANY_CHARGES = 6, 0.1, 200


#: Sums over the k-vectors that are left out end where exp(-k²/2 alpha²) has fallen by this
#: exponent, and have about this number of vectors at most.
LOG_SMALLEST, MAX_LEFT_OUT = 14.0, 1e6


class Charges(NamedTuple):
    """The charges and their arrangement in rigid molecules, on which the errors depend."""

    count: int  # charged sites
    square: float  # sum of q², e²
    # q_i q_j (e²), in both orders, and distance (Å) of pairs of sites inside molecules
    pairs: tuple[tuple[float, float], ...]

    def form(self, k: np.ndarray) -> np.ndarray:
        """Sum over molecules of |sum q exp(i k r)|², averaged over orientations, e²; k (1/Å) of any
        shape."""
        square = np.full(np.shape(k), self.square)
        for product, distance in self.pairs:
            square += product * np.sinc(k * distance / pi)
        return square

    def transform(self, alpha: float, square: np.ndarray) -> np.ndarray:
        """Fourier transform of a unit charge's smooth potential at k² > 0."""
        return 4 * pi / square * np.exp(-square / (4 * alpha**2))

    def force_spectrum(self, alpha: float, k: np.ndarray) -> np.ndarray:
        """Mean square force of a unit charge in a shell dk, times the volume."""
        # k² (4 pi/k² e^(-k²/4 alpha²))² 4 pi k² / (8 pi³)
        return 8 * np.exp(-(k**2) / (2 * alpha**2))

    def beyond(self, alpha: float, cutoff: float, volume: float) -> float:
        """Error from the pairs beyond the cutoff (Kolafa & Perram 1992, Mol. Sim. 9, 351, eq.
        18)."""
        return 2 * self.square / sqrt(self.count * cutoff * volume) * exp(-((alpha * cutoff) ** 2))


class Dispersing(Charges):
    """Sites with strengths c in place of charges, with the energy -c_i c_j/r⁶; c² in u Å⁸/ps²."""

    def transform(self, alpha: float, square: np.ndarray) -> np.ndarray:
        b2 = square / (4 * alpha**2)
        shape = 1 - 2 * b2 + 2 * sqrt(pi) * b2**1.5 * erfcx(np.sqrt(b2))
        return -(pi**1.5) * alpha**3 / 3 * np.exp(-b2) * shape

    def force_spectrum(self, alpha: float, k: np.ndarray) -> np.ndarray:
        return (k**2 * self.transform(alpha, k**2)) ** 2 / (2 * pi**2)

    def beyond(self, alpha: float, cutoff: float, volume: float) -> float:
        """Error from the pairs beyond the cutoff, with random positions there."""
        r = cutoff * np.linspace(1, 6, 1001)
        force = 6 / r**7 * gammaincc(4, (alpha * r) ** 2)
        return self.square * sqrt(np.trapezoid(4 * pi * r**2 * force**2, r) / (self.count * volume))


def charges_in(
    species: Sequence[Molecule],
    counts: np.ndarray,
    of: Callable[[Molecule], np.ndarray] = lambda m: m.charges,
    kind: type[Charges] = Charges,
) -> Charges:
    """The charges, or other strengths `of` a molecule (s,), in `counts` molecules of each
    species."""
    square = 0.0
    count = 0
    products = [np.zeros(0)]
    distances = [np.zeros(0)]
    for m, n in zip(species, map(int, counts), strict=True):
        charge = of(m)[of(m) != 0]
        position = m.positions_body[of(m) != 0]
        count += n * len(charge)
        square += n * float(charge @ charge)
        i, j = np.tril_indices(len(charge), -1)
        product = 2 * n * (charge[i] * charge[j])
        distance = np.linalg.norm(position[i] - position[j], axis=1)
        if len(charge) > MANY_CHARGES:
            bins = np.rint(distance / COARSE).astype(int)
            product = np.bincount(bins, product)
            distance = COARSE * np.arange(bins.max() + 1)
        products.append(product)
        distances.append(np.round(distance, FINE))
    # sums of the products over pairs of one distance, in order of appearance
    distance, first, which = np.unique(
        np.concatenate(distances), return_index=True, return_inverse=True
    )
    sums = np.zeros(len(first))
    order = np.argsort(first)
    np.add.at(sums, which, np.concatenate(products))
    rounded = [round(d, FINE) for d in distance[order].tolist()]
    return kind(count, square, tuple(zip(sums[order].tolist(), rounded, strict=True)))


def alpha_for(charges: Charges, cutoff: float, volume: float, error: float) -> float:
    """The alpha (1/Å) at which the pairs beyond the cutoff cause this error."""
    if isinstance(charges, Dispersing):
        low, high = 0.5, MAX_ALPHA_CUTOFF + 1e-3
        while high - low > 1e-6:
            middle = 0.5 * (low + high)
            is_less = charges.beyond(middle / cutoff, cutoff, volume) <= error
            low, high = (low, middle) if is_less else (middle, high)
        return high / cutoff
    unscreened_error = charges.beyond(0.0, cutoff, volume)
    # a large error allows almost no screening; the formula holds for alpha cutoff down to 1/2
    return max(0.5, sqrt(max(0.0, np.log(unscreened_error / error)))) / cutoff


def filled_fraction(
    species: Sequence[Molecule], counts: np.ndarray, space: Space, position: np.ndarray
) -> float:
    """The part of a periodic box that contains the molecules, at most 1, 1 for charges without
    size. The density of this part decides on the errors.

    It is not larger than the molecules are where they touch each other: a dilute box may contain
    such a cluster. Nor than the part of each edge with molecules at the start, from their centres
    of mass `position` (n, 3): a slab.
    """
    diameters = np.array(
        [2 * np.linalg.norm(m.positions_body, axis=1).max() + max(m.sigma) for m in species]
    )
    touching = float(counts @ diameters**3) / space.volume
    empty = (
        np.maximum(longest_gaps(space, position) - diameters[counts > 0].max(), 0.0) / space.edges
    )
    return min(1.0, touching, float(np.prod(1 - empty))) or 1.0


def k_space_error(charges: Charges, alpha: float, radius: float, volume: float) -> float:
    """Error from the k-vectors beyond k = radius (1/Å), see the theory chapter `interactions`."""
    k = np.linspace(radius, radius + 12 * alpha, 600)
    density = charges.force_spectrum(alpha, k) * charges.form(k)
    return sqrt(charges.square / charges.count * np.trapezoid(density, k) / volume)


def k_cutoff_for(charges: Charges, alpha: float, reciprocal: np.ndarray, error: float) -> float:
    """The cutoff radius in k (1/Å) at which the k-vectors beyond it cause this error."""
    from scipy.optimize import brentq  # slow to import, and for direct sums only

    volume = 8 * pi**3 / abs(np.linalg.det(reciprocal))
    least = np.linalg.norm(reciprocal, axis=1).min()
    longest = 12 * alpha + least

    def left(radius: float) -> float:
        return np.log(max(k_space_error(charges, alpha, radius, volume), 1e-300) / error)

    radius = least if left(0.0) <= 0 else brentq(left, 0.0, longest)
    return max(radius, least) * (1 + 1e-9)


def left_out_error(charges: Charges, alpha: float, k_vectors: KVectors, cell: np.ndarray) -> float:
    """Error from the k-vectors that a sum leaves out in a cell (3, 3): the sum over them, in place
    of the integral of `k_space_error`, so that the set may have any shape."""
    volume = abs(float(np.linalg.det(cell)))
    reciprocal = 2 * pi * np.linalg.inv(cell).T
    nearest = ((k_vectors.most + 1) * np.linalg.norm(reciprocal, axis=1)).min()  # along an axis
    radius = sqrt(nearest**2 + 2 * LOG_SMALLEST * alpha**2)
    # in a large box every stride-th vector along each axis stands for stride³ of them
    stride = ceil((radius**3 * volume / (6 * pi**2 * MAX_LEFT_OUT)) ** (1 / 3))
    largest = np.floor(radius * np.linalg.norm(cell, axis=1) / (2 * pi * stride)).astype(int)
    x, y, z = (stride * np.arange(-n, n + 1) for n in largest.tolist())
    k = np.linspace(0.0, radius, 2000)[1:]
    spectrum = charges.force_spectrum(alpha, k) * charges.form(k) / k**2
    square = 0.0
    for n_x in x.tolist():
        n = np.stack(np.broadcast_arrays(n_x, y[:, None], z), axis=-1)
        length = np.linalg.norm(n @ reciprocal, axis=-1)
        left_out = (length > 0) & (length <= radius) & ~k_vectors.contains(n_x, y, z)
        square += float(np.interp(length[left_out], k, spectrum).sum())
    square *= stride**3 * 2 * pi**2 / volume  # dk has V k² dk/2 pi² vectors
    return sqrt(charges.square / charges.count * square / volume)


def k_cutoff_of_count(count: int, volume: float) -> float:
    """Radius (1/Å) of a sphere in k that contains `count` k-vectors."""
    return (6 * pi**2 * count / volume) ** (1 / 3)


def pme_error(
    charges: Charges,
    alpha: float,
    cell: np.ndarray,
    grid: tuple[int, int, int],
    order: int,
    proxy_points: int = MAX_PROXY_POINTS,
) -> float:
    """Error of smooth PME with the influence function G of `pme`, on a grid in a cell (3, 3), rows
    the edges. See the theory chapter `interactions` (Hockney & Eastwood 1988, 8-22; Stern & Calkins
    2008, J. Chem. Phys. 128, 214106)."""
    grid = np.array(grid)
    volume = abs(np.linalg.det(cell))
    points = np.minimum(grid, proxy_points)
    proxy = cell * (points / grid)[:, None]
    b = 2 * pi * np.linalg.inv(proxy).T
    metric = b @ b.T
    of = [aliases(int(n), order) for n in points]
    of[2] = type(of[2])(*(part[: points[2] // 2 + 1] for part in of[2]))
    n2, odd, unaliased, every, first, second = (
        [np.expand_dims(getattr(of[d], name), [e for e in range(3) if e != d]) for d in range(3)]
        for name in ("n", "odd", "unaliased", "all", "first", "second")
    )
    square = weakened = 0.0
    for d in range(3):
        o, e = (d + 1) % 3, (d + 2) % 3
        square = square + metric[d, d] * n2[d] ** 2 + 2 * metric[d, o] * odd[d] * odd[o]
        weakened = weakened + metric[d, d] * second[d] * every[o] * every[e]
        weakened = weakened + 2 * metric[d, o] * first[d] * first[o] * every[e]
    square = square * np.ones_like(weakened)
    square[0, 0, 0] = weakened[0, 0, 0] = 1.0  # k = 0 is excluded
    unaliased_product = unaliased[0] * unaliased[1] * unaliased[2]
    product = every[0] * every[1] * every[2]
    g = charges.transform(alpha, square)
    influence = square * g * unaliased_product / (product * weakened)
    form = charges.form(np.sqrt(square))
    wrong = square * (g - influence * unaliased_product) ** 2 * form
    aliased = (product - unaliased_product) * weakened * charges.square
    wrong += influence**2 * (
        unaliased_product * form * (weakened - unaliased_product * square) + aliased
    )
    wrong[0, 0, 0] = 0.0
    twice = np.full(wrong.shape[2], 2.0)
    twice[0] = 1.0
    if points[2] % 2 == 0:
        twice[-1] = 1.0
    left = float((wrong * twice).sum()) / (volume * abs(np.linalg.det(proxy)))
    beyond = k_space_error(charges, alpha, k_cutoff_of_count(int(np.prod(grid)), volume), volume)
    # rounding can be negative
    return float(np.hypot(sqrt(charges.square / charges.count * max(left, 0.0)), beyond))


def fft_size(least: float) -> int:
    """The smallest number of points, at least `least`, without prime factors above 7: fast for
    FFTs."""
    n = max(8, int(np.ceil(least - 1e-9)))
    while True:
        left = n
        for factor in (2, 3, 5, 7):
            while left % factor == 0:
                left //= factor
        if left == 1:
            return n
        n += 1


def pme_grid_for(
    charges: Charges,
    alpha: float,
    cell: np.ndarray,
    error: float,
    order: int | None = None,
    grid: tuple[int, int, int] | None = None,
) -> tuple[tuple[int, int, int], int] | None:
    """The fastest grid and spline order with at most this error. None if none has. order, grid :
    fixed, if given"""
    rows = tuple(map(tuple, cell.tolist()))
    return _fastest_grid(charges, alpha, rows, error, order, grid, MAX_PROXY_POINTS)[1]


@lru_cache(maxsize=1024)  # trials and studies build a scene many times
def _fastest_grid(
    charges: Charges,
    alpha: float,
    rows: tuple[tuple[float, ...], ...],
    error: float,
    order: int | None = None,
    grid: tuple[int, int, int] | None = None,
    proxy_points: int = SEARCH_PROXY_POINTS,
) -> tuple[float, tuple[tuple[int, int, int], int] | None]:
    """Approximate time (ns) of the reciprocal part on one core with the fastest grid and order, and
    these. Infinite and None without any."""
    cell = np.array(rows)
    edges = np.linalg.norm(cell, axis=1)
    sensible = SPACINGS[edges.max() / SPACINGS <= MAX_GRID_POINTS]
    grids = [grid]
    if grid is None:
        sizes = (tuple(fft_size(edge / h) for edge in edges) for h in sensible)
        grids = list(dict.fromkeys(sizes))  # neighbouring spacings often have the same grid
    best = None
    cheapest = inf
    for p in ORDERS if order is None else (order,):
        k = bisect_left(
            grids, -error, key=lambda of, p=p: -pme_error(charges, alpha, cell, of, p, proxy_points)
        )
        if k < len(grids):
            # measured with 12288 sites, orders 5, 6 and 8, grids of 40³ to 63³
            cost = charges.count * (45 + 1.85 * p**2) + 9.5 * float(np.prod(grids[k]))
            if cost < cheapest:
                best = (grids[k], p)
                cheapest = cost
    return cheapest, best


def fastest_cutoff(
    charges: Charges, cell: np.ndarray, longest: float, error: float, filled: float
) -> float | None:
    """The real-space cutoff (Å), at most `longest`, with which PME is fastest if real and
    reciprocal space each have this error. None if no cutoff reaches it.

    filled : see `filled_fraction`
    """
    volume = abs(float(np.linalg.det(cell)))
    cutoffs = np.arange(SHORTEST_CUTOFF, longest, 0.5)
    rows = tuple(map(tuple, cell.tolist()))

    @cache
    def cost(k: int) -> float:
        pairs = (
            charges.count**2
            / 2
            * min(1.0, 4 / 3 * pi * (cutoffs[k] + LIST_MARGIN) ** 3 / (filled * volume))
        )
        alpha = alpha_for(charges, cutoffs[k], volume, error)
        return PAIR_NS * pairs + _fastest_grid(charges, alpha, rows, error)[0]

    low, high = 0, len(cutoffs) - 1
    while high - low > 2:  # the cost has one minimum, except for the steps between sizes of grids
        third = max(1, (high - low) // 3)
        if cost(low + third) <= cost(high - third):
            high -= third
        else:
            low += third
    best = min(range(low, high + 1), key=cost, default=None)
    return None if best is None or cost(best) == inf else float(cutoffs[best])


ALIASES = (
    30  # largest |m| in sums; its term is 1e-7 of the first for order 3, less for higher orders
)


class Aliases(NamedTuple):
    """Sums over the aliases of each Fourier component along one axis (points,), in the order of an
    FFT. Spreading charges by B-splines (see `pme.weights`) multiplies component n of K points by
    sinc(n/K)^p."""

    n: np.ndarray  # -K/2 < n <= K/2
    odd: np.ndarray  # n, but 0 where n and -n are the same component
    unaliased: np.ndarray  # U(n)²
    all: np.ndarray  # sum over m of U(n + m K)²
    first: np.ndarray  # sum of (n + m K) U²
    second: np.ndarray  # sum of (n + m K)² U²


@cache
def aliases(points: int, order: int) -> Aliases:
    """The sums for a number of points and a spline order. Callers share the arrays."""
    n = np.arange(points)
    n = np.where(2 * n > points, n - points, n)
    every = n[:, None] + points * np.arange(-ALIASES, ALIASES + 1)
    squared = np.sinc(every / points) ** (2 * order)
    nyquist = 2 * n == points
    first = np.where(nyquist, 0.0, (every * squared).sum(axis=1))
    return Aliases(
        n,
        np.where(nyquist, 0, n),
        np.sinc(n / points) ** (2 * order),
        squared.sum(axis=1),
        first,
        (every**2 * squared).sum(axis=1),
    )
