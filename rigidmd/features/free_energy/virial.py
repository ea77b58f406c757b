"""Second virial coefficients of rigid molecules, by quadrature over distance and orientation.

B2(T) = -(1/2) ∫ <exp(-u/kT) - 1> dr, averaged over the orientations of both molecules (McQuarrie,
Statistical Mechanics, chapter 12). The guide `chemical_potential` has the method.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, pi

import numpy as np
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from rigidmd.assemble.build import build
from rigidmd.core.state import State, state_of
from rigidmd.core.statistics import error_of_mean
from rigidmd.errors import RigidMDWarning, SceneError, SimulationError
from rigidmd.features.free_energy.guest import Guest, model_named
from rigidmd.io.write import Column, ReportTable
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule
from rigidmd.units import AVOGADRO, BOLTZMANN

#: From r (Å) where molecules overlap to r where the integrand has vanished. Beyond the last number
#: ln r grows exponentially with the variable of integration.
NEAREST, FARTHEST, FAR = 0.1, 1e5, 10.0
#: The end for two neutral molecules. Their integrand falls as r^-4, while the rounding error of a
#: sum over charges, times r³, grows as r²: it is 1e-5 cm³/mol for methanol here, 1e-3 at FARTHEST.
END_OF_NEUTRAL = 1e4
#: Randomised sets of samples, whose scatter gives the error; samples in each, at first, at once
#: and at most. Each has the rotations of a tetrahedron.
SETS = 16
FEWEST = 2**9
AT_ONCE = 2**12
MOST = 2**18
#: Intervals of each variable, their adaptations to the integrand, and the fraction of even samples.
BINS, ADAPTATIONS, EVEN = 64, 4, 0.2
#: Default error, relative to the larger of |B2| and |T dB2/dT|.
RELATIVE_ERROR = 1e-3
#: Relative error of the quadrature of points, which have no orientations, and segments of ln r.
POINT_ERROR, SEGMENTS = 1e-9, 24
#: Largest part of the integrand, relative to the integral, that may be left at the end.
LEFT = 1e-4
#: Standard errors by which it must exceed that: the rest may be chance or rounding.
SIGNIFICANT = 5.0
#: Å³ per molecule in cm³/mol.
CM3_PER_MOL = AVOGADRO * 1e-24
#: Largest net charge of a neutral molecule, e, and highest temperature, K.
NEUTRAL = 1e-6
HOTTEST = 1e9
SOURCE = "virial"  # in messages
TETRAHEDRON = Rotation.create_group("T").as_matrix()

#: Energies (m,) of the second molecule, u Å²/ps², at positions (m, 3) with rotations (m, 3, 3).
Energy = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class SecondVirial:
    """Second virial coefficients of two species at temperatures (t,).

    Attributes
    ----------
    species : tuple of str
        Names of the species
    temperature : ndarray
        Temperatures (t,), K
    B2, error : ndarray
        Coefficients (t,) and their standard errors, cm³/mol
    dB2_dT, dB2_dT_error : ndarray
        Their derivatives (t,) and standard errors, cm³/(mol K)
    samples : int
        Number of configurations
    """

    species: tuple[str, str]
    temperature: np.ndarray
    B2: np.ndarray
    error: np.ndarray
    dB2_dT: np.ndarray
    dB2_dT_error: np.ndarray
    samples: int

    def table(self) -> ReportTable:
        """A line for each temperature.

        Returns
        -------
        ReportTable
            Its `text()` is for a terminal
        """
        return table_of([self])


def table_of(results: Sequence[SecondVirial]) -> ReportTable:
    """Rows of all pairs at all temperatures."""
    rows = [(result, k) for result in results for k in range(len(result.temperature))]

    def column(header: str, name: str) -> Column:
        return Column(header, lambda row: float(getattr(row[0], name)[row[1]]))

    return ReportTable(
        [
            Column("species", lambda row: "-".join(row[0].species)),
            column("T (K)", "temperature"),
            column("B2 (cm³/mol)", "B2"),
            column("B2 error", "error"),
            column("dB2/dT (cm³/(mol K))", "dB2_dT"),
            column("dB2/dT error", "dB2_dT_error"),
        ],
        rows,
    )


def second_virial(
    first: str,
    second: str | None = None,
    *,
    temperatures: Sequence[float],
    error: float | None = None,
    forces: Sequence[object] = (),
    settings: dict | None = None,
    seed: int = 1,
    progress: Callable[[float], object] = lambda fraction: None,
) -> SecondVirial:
    """The second virial coefficient of a model, or the cross coefficient of two, without a
    simulation.

    All pairs of sites interact without a cutoff. Two molecules overlap where the energy of two of
    their sites, without charges, is above 1000 kJ/mol and 100 kT: charges within such cores do not
    count.

    Parameters
    ----------
    first, second : str
        A shipped model or the path of a .toml file. Default of the second: the first
    temperatures : sequence of float
        Temperatures (t,), K
    error : float, optional
        Requested standard error of each coefficient, cm³/mol. Default: 0.1 % of the larger of |B2|
        and |T dB2/dT|
    forces : sequence of objects, optional
        Potentials made by `rigidmd.pair_potential` and `rigidmd.body_pair_potential`
    settings : dict, optional
        Keys of a scene with their values, such as {"forces.mixing": "geometric"}
    seed : int, optional
        Seed of the random orientations
    progress : callable, optional
        Called with an estimate of the fraction done

    Returns
    -------
    SecondVirial
        `B2`, `error` (cm³/mol), `dB2_dT` and `dB2_dT_error` (cm³/(mol K)), each (t,)

    Raises
    ------
    MoleculeError, SceneError
        For unknown models and forces; for forces other than potentials of pairs; where charges have
        no core; with a net charge on both
    SimulationError
        Where the integral diverges, or exp(-u/kT) exceeds the range of numbers
    RigidMDWarning
        If the error is larger than requested after the largest number of samples
    """
    models = [model_named(name) for name in (first, second or first)]
    names = models[0].name, models[1].name
    if abs(models[1].charges.sum()) > abs(models[0].charges.sum()):
        models.reverse()  # the tetrahedron averages the second one
    net = [abs(m.charges.sum()) > NEUTRAL for m in models]
    settings = settings or {}
    errors = [
        f"{key}: two molecules in open space take keys of [forces] only, such as forces.mixing"
        for key in settings
        if key.partition(".")[0] != "forces"
    ]
    if all(net):
        errors.append("both molecules have a net charge: their second virial coefficient diverges")
    if models[0].name == models[1].name and first != (second or first):
        errors.append(f"both models are named {models[0].name}; rename one")
    if not (len(temperatures) and all(0 < t <= HOTTEST for t in temperatures)):
        errors.append(f"temperatures must be above 0 K and at most {HOTTEST:g} K")
    if error is not None and not error > 0:
        errors.append(f"the requested error must be above 0, not {error!r}")
    if errors:
        raise SceneError(SOURCE, errors)
    guest, state = _guest_of(models, settings, forces, max(temperatures))
    alone = guest.constant(inf)  # its energy without the other one
    points = all(not m.positions_body.any() for m in models)

    def energy(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        return guest.energies(state, position, rotation) - alone

    pair = Pair(
        names,
        np.asarray(temperatures, float),
        energy,
        points,
        FARTHEST if any(net) or points else END_OF_NEUTRAL,
    )
    return integrate(pair, error, seed, progress)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two molecules, whose coefficient is computed.

    temperature : (t,) K; points : without orientations; farthest : end of the integral, Å
    """

    species: tuple[str, str]
    temperature: np.ndarray
    energy: Energy
    points: bool = False
    farthest: float = FARTHEST

    def integrand(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """What B2 and T dB2/dT are integrals of over r (2, t, m), cm³/mol/Å³. Raises
        SimulationError where it exceeds the range of numbers."""
        thermal = BOLTZMANN * self.temperature[:, None]
        with np.errstate(invalid="ignore", over="ignore"):
            x = self.energy(position, rotation) / thermal
            weighted = np.where(np.isinf(x), 0.0, x * np.exp(-x))
            values = -0.5 * CM3_PER_MOL * np.stack([np.expm1(-x), weighted])
        if not (finite := np.isfinite(values).all(axis=(0, 2))).all():
            coldest = self.temperature[~finite].max()
            raise SimulationError(
                f"{self.name} at {coldest:g} K: exp(-u/kT) exceeds the range of numbers. Raise the"
                " temperature"
            )
        return values

    @property
    def name(self) -> str:
        return "-".join(self.species)

    def at(self, temperature: float) -> "Pair":
        """The pair at one temperature, K."""
        return replace(self, temperature=np.array([temperature]))

    def check_end(self, left: np.ndarray, error: np.ndarray | float, integral: np.ndarray) -> None:
        """Raise SimulationError where the integrand r³ (2, t) has not vanished at the end."""
        allowed = LEFT * np.abs(integral).max(axis=0) + SIGNIFICANT * error
        if (np.abs(left) > allowed).any():
            raise SimulationError(
                f"the second virial coefficient of {self.name} does not converge: at"
                f" {self.farthest:g} Å the energy still counts. It must fall faster than r^-3:"
                " check the potentials, or give forces.cutoff_A"
            )


def integrate(
    pair: Pair,
    error: float | None = None,
    seed: int = 1,
    progress: Callable[[float], object] = lambda fraction: None,
) -> SecondVirial:
    """The coefficient of a pair, see `second_virial`."""
    if pair.points:
        parts = [_integral_of_points(pair.at(t)) for t in pair.temperature]
        return _result(pair, *np.concatenate(parts, axis=2), samples=1)
    edges = _adapted_edges(pair, seed + SETS)
    samples, before, expected, fraction = FEWEST, 0, MOST, 0.0
    while True:
        sets = []
        for k in range(SETS):
            sets.append(_integral(pair, edges, samples, seed + k))
            done = before + (k + 1) / SETS * samples
            fraction = max(fraction, done / (before + expected))
            progress(fraction)
        integrals, ends = np.swapaxes(sets, 0, 1)
        values, errors = integrals.mean(axis=0), error_of_mean(integrals)
        pair.check_end(ends.mean(axis=0), error_of_mean(ends), values)
        requested = error or RELATIVE_ERROR * np.abs(values).max(axis=0)
        # both are 0 without forces
        none = np.zeros_like(errors[0])
        excess = float(np.divide(errors[0], requested, none, where=errors[0] > 0).max())
        total = SETS * samples * len(TETRAHEDRON)
        if excess <= 1 or samples >= MOST:
            progress(1.0)
        if excess <= 1:
            return _result(pair, values, errors, total)
        if samples >= MOST:
            late = (
                f"{pair.name}: the error of B2 is {excess:.2g} times the requested one after"
                f" {total} samples"
            )
            warnings.warn(RigidMDWarning(late), stacklevel=3)
            return _result(pair, values, errors, total)
        before += samples
        expected = min(MOST, samples * excess**2)
        samples *= 4 if excess > 3 else 2
        expected = max(expected, samples)


def _result(pair: Pair, values: np.ndarray, errors: np.ndarray, samples: int) -> SecondVirial:
    t = pair.temperature
    return SecondVirial(
        pair.species, t, values[0], errors[0], values[1] / t, errors[1] / t, samples
    )


def _integral_of_points(pair: Pair) -> np.ndarray:
    """The integrals (2, t) of points and their errors, by adaptive quadrature over ln r."""

    def shell(log_r: float) -> np.ndarray:
        r = np.exp(log_r)
        at = np.array([[0.0, 0.0, r]])
        return 4 * pi * r**3 * pair.integrand(at, np.eye(3)[None])[..., 0]

    ends = np.log([1e-3 * NEAREST, pair.farthest])
    limits = np.linspace(ends[0], ends[1], SEGMENTS + 1)[1:-1]
    integral, error = quad_vec(
        shell, *ends, epsabs=1e-200, epsrel=POINT_ERROR, norm="max", points=limits
    )
    pair.check_end(shell(ends[1]), 0.0, integral)
    return np.stack([integral, np.maximum(POINT_ERROR * np.abs(integral), error)])


def _samples(pair: Pair, edges: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The integrals (2, t, m) by each of some random numbers (m, 6): of r, and of orientations.

    Each is followed by all rotations of a tetrahedron of the second molecule: its dipole and
    quadrupole are then 0 on average, so that the tail has no noise.
    """
    even = np.linspace(0, 1, edges.shape[1])
    bins = np.minimum((u * BINS).astype(int), BINS - 1)
    x = np.stack([np.interp(u[:, d], even, of) for d, of in enumerate(edges)], axis=1)
    widths = np.stack([BINS * np.diff(of)[bins[:, d]] for d, of in enumerate(edges)])
    r, slope = _distances(x[:, 0], pair.farthest)
    found = pair.integrand(*_orientations(r, x[:, 1:]))
    means = found.reshape(*found.shape[:2], len(r), -1).mean(axis=3)
    return means * 4 * pi * r**2 * slope * widths.prod(axis=0)


def _distances(x: np.ndarray, farthest: float) -> tuple[np.ndarray, np.ndarray]:
    """r (Å) from NEAREST to the farthest at x from 0 to 1, and dr/dx."""
    last = np.log(FAR) + np.log(np.log(farthest / FAR))
    t = np.log(NEAREST) + (last - np.log(NEAREST)) * x
    growth = np.exp(t - np.log(FAR))
    r = np.exp(t + growth)
    return r, r * (1 + growth) * (last - np.log(NEAREST))


def _points(seed: int) -> qmc.Sobol:
    """Randomised points of the unit cube of six dimensions."""
    return qmc.Sobol(6, seed=seed)  # pyright: ignore[reportCallIssue]  # SciPy 1.15 renames it rng


def _adapted_edges(pair: Pair, seed: int) -> np.ndarray:
    """Edges (6, bins + 1) of variable intervals with equal numbers of samples, narrow where the
    integrand is large (Lepage 1978, J. Comput. Phys. 27, 192)."""
    even = np.linspace(0, 1, BINS + 1)
    edges = np.tile(even, (6, 1))
    points = _points(seed)
    for _ in range(ADAPTATIONS):
        u = points.random(AT_ONCE)
        size = np.abs(_samples(pair, edges, u))
        if not size.any():
            break  # the molecules do not interact
        size = (size / size.sum(axis=2, keepdims=True)).sum(axis=(0, 1))
        for d in range(6):
            square = np.bincount((u[:, d] * BINS).astype(int), size**2, BINS)
            density = np.sqrt(np.convolve(np.pad(square, 1, "edge"), np.ones(3), "valid"))
            density = density / density.sum() + EVEN / BINS
            total = np.append(0, np.cumsum(density)) / density.sum()
            edges[d] = np.interp(even, total, edges[d])
    return edges


def _integral(
    pair: Pair, edges: np.ndarray, samples: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """The integrals (2, t) by randomised Sobol points, and the integrand r³ at their end."""
    points = _points(seed)
    total = 0.0
    for begin in range(0, samples, AT_ONCE):
        u = points.random(min(AT_ONCE, samples - begin))
        total = total + _samples(pair, edges, u).sum(axis=2)
    shells = []
    for x in (0.0, 1.0):
        r = _distances(np.full(len(u), x), pair.farthest)[0]
        values = pair.integrand(*_orientations(r, u[:, 1:])).mean(axis=2)
        shells.append(4 * pi * r[0] ** 3 * values)
    return total / samples + shells[0] / 3, shells[1]


def _orientations(r: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (12 m, 3) of the second molecule at distances (m,), and its rotations (12 m, 3, 3),
    from random numbers (m, 5)."""
    z, angle, one, other = 2 * u[:, 0] - 1, *(2 * pi * u[:, 1:4].T)
    across = np.sqrt(1 - z**2)
    a = np.sqrt(1 - u[:, 4])
    b = np.sqrt(u[:, 4])
    direction = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    quaternion = np.stack([a * np.sin(one), a * np.cos(one), b * np.sin(other), b * np.cos(other)])
    rotation = from_quaternion(quaternion.T)
    all_rotations = (rotation.reshape(-1, 3) @ np.hstack(TETRAHEDRON)).reshape(-1, 3, 12, 3)
    repeated = np.repeat(r[:, None] * direction, len(TETRAHEDRON), axis=0)
    return repeated, all_rotations.transpose(0, 2, 1, 3).reshape(-1, 3, 3)


def _guest_of(
    models: list[Molecule], settings: dict, forces: Sequence[object], temperature: float
) -> tuple[Guest, State]:
    """The second molecule as a guest of the first one, which is in an open box."""
    species = {m.name: {"name": m.name, "count": 1, "sites": m.sites()} for m in models}
    scene = MolecularScene.from_dict(
        {
            "name": SOURCE,
            "box": {"lengths_A": 100.0, "periodic": False},
            "molecules": list(species.values()),
            "stages": [{"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.0}],
        },
        overrides=settings,
        source=SOURCE,
    )
    system = build(scene.with_user_code(forces), user_code=False)
    rotates = len(system.state.rotation) > 0
    count = len(species)
    rotation = np.tile(np.eye(3), (count, 1, 1)) if rotates else None
    state = state_of(position=np.zeros((count, 3)), rotation=rotation)
    guest = Guest(system, models[1], temperature, np.arange(count) == 0)
    if guest.engine_terms:
        raise SceneError(
            SOURCE,
            [
                f"{name} is not a potential of pairs. Give rigidmd.pair_potential or"
                " rigidmd.body_pair_potential, or keys of [forces] such as forces.custom with an"
                " energy"
                for name in guest.engine_terms
            ],
        )
    return guest, state
