"""Second virial coefficients of rigid molecules, by quadrature over distance and orientation.

B2(T) = -(1/2) ∫ <exp(-u/kT) - 1> dr, averaged over the orientations of both molecules (McQuarrie,
Statistical Mechanics, chapter 12). The guide `chemical_potential` has the method.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, pi

import numpy as np
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from rigidmd.assemble.build import build
from rigidmd.assemble.guest import Guest, model_named
from rigidmd.core.state import State, state_of
from rigidmd.core.statistics import error_of_mean
from rigidmd.errors import RigidMDWarning, SceneError, SimulationError
from rigidmd.io.write import Column, Table
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule
from rigidmd.units import AVOGADRO, BOLTZMANN

#: From r (Å) where molecules overlap to r where the integrand has vanished. Beyond the last number
#: ln r grows exponentially with the variable of integration.
NEAREST, FARTHEST, FAR = 0.1, 1e5, 10.0
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
#: Largest part of the integrand, relative to the integral, that may be left at FARTHEST.
LEFT = 1e-4
#: Å³ per molecule in cm³/mol.
CM3_PER_MOL = AVOGADRO * 1e-24
#: Largest net charge of a neutral molecule, e.
NEUTRAL = 1e-6
SOURCE = "virial"  # in messages
TETRAHEDRON = Rotation.create_group("T").as_matrix()

#: Energies (m,) of the second molecule, u Å²/ps², at positions (m, 3) with rotations (m, 3, 3).
Energy = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class SecondVirial:
    """Second virial coefficients of two species at temperatures (t,).

    temperature : K; B2, error : cm³/mol; dB2_dT, dB2_dT_error : cm³/(mol K)
    samples : number of configurations
    """

    species: tuple[str, str]
    temperature: np.ndarray
    B2: np.ndarray
    error: np.ndarray
    dB2_dT: np.ndarray
    dB2_dT_error: np.ndarray
    samples: int

    def table(self) -> Table:
        return table_of([self])


def table_of(results: Sequence[SecondVirial]) -> Table:
    """Rows of all pairs at all temperatures."""
    rows = [(result, k) for result in results for k in range(len(result.temperature))]

    def column(header: str, name: str) -> Column:
        return Column(header, lambda row: float(getattr(row[0], name)[row[1]]))

    return Table(
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
    first, second
        A shipped model or the path of a .toml file; default of the second: the first
    temperatures
        K
    error
        Requested standard error of each coefficient, cm³/mol; default: 0.1 % of the larger of |B2|
        and |T dB2/dT|
    forces
        Potentials made by `rigidmd.pair_potential` and `rigidmd.body_pair_potential`
    settings
        Keys of a scene with their values, such as {"forces.mixing": "geometric"}
    seed
        Of the random orientations
    progress
        Called with the fraction done, of those directions that may be needed

    Raises
    ------
    MoleculeError, SceneError
        For unknown models and forces; where charges have no core; with a net charge on both
    SimulationError
        Where the integral diverges
    RigidMDWarning
        If the error is larger than requested after the largest number of samples
    """
    models = [model_named(name) for name in (first, second or first)]
    if abs(models[1].charges.sum()) > abs(models[0].charges.sum()):
        models.reverse()  # the tetrahedron averages the second one
    faults = []
    if abs(models[1].charges.sum()) > NEUTRAL:
        faults.append("both molecules have a net charge: their second virial coefficient diverges")
    if models[0].name == models[1].name and first != (second or first):
        faults.append(f"both models are named {models[0].name}; rename one")
    if not (len(temperatures) and 0 < min(temperatures) <= max(temperatures) < inf):
        faults.append("temperatures must be above 0 K")
    if faults:
        raise SceneError(SOURCE, faults)
    guest, state = _guest_of(models, settings or {}, forces, max(temperatures))
    points = all(not m.positions_body.any() for m in models)

    def energy(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        return guest.energies(state, position, rotation)

    return integrate(energy, temperatures, (first, second or first), points, error, seed, progress)


def integrate(
    energy: Energy,
    temperatures: Sequence[float],
    species: tuple[str, str] = ("", ""),
    points: bool = False,
    error: float | None = None,
    seed: int = 1,
    progress: Callable[[float], object] = lambda fraction: None,
) -> SecondVirial:
    """The coefficient of an energy, see `second_virial`. points : without orientations"""
    thermal = BOLTZMANN * np.asarray(temperatures, float)
    if points:
        values = _integral_of_points(energy, thermal)
        samples = 1
        return _result(species, thermal, values, POINT_ERROR * np.abs(values), samples)
    edges = _adapted_edges(energy, thermal, seed + SETS)
    samples = FEWEST
    while True:
        sets = [_integral(energy, thermal, edges, samples, seed + k) for k in range(SETS)]
        values = np.mean(sets, axis=0)
        errors = error_of_mean(sets)
        scale = np.abs(values).max(axis=0)
        requested = RELATIVE_ERROR * scale if error is None else np.full(len(scale), error)
        excess = float((errors[0] / requested).max())
        total = SETS * samples * len(TETRAHEDRON)
        if excess <= 1:
            return _result(species, thermal, values, errors, total)
        progress(samples / MOST)
        if samples >= MOST:
            late = f"the error of B2 is {excess:.2g} times the requested one after {total} samples"
            warnings.warn(RigidMDWarning(late), stacklevel=3)
            return _result(species, thermal, values, errors, total)
        samples *= 4 if excess > 3 else 2


def _result(
    species: tuple[str, str],
    thermal: np.ndarray,
    values: np.ndarray,
    errors: np.ndarray,
    samples: int,
) -> SecondVirial:
    temperature = thermal / BOLTZMANN
    return SecondVirial(
        species,
        temperature,
        values[0],
        errors[0],
        values[1] / temperature,
        errors[1] / temperature,
        samples,
    )


def _integrand(
    energy: Energy, thermal: np.ndarray, position: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """What B2 and T dB2/dT are integrals of over r (2, t, m), cm³/mol/Å³."""
    with np.errstate(invalid="ignore", over="ignore"):
        x = energy(position, rotation) / thermal[:, None]
        weighted = np.where(np.isinf(x), 0.0, x * np.exp(-x))
        return -0.5 * CM3_PER_MOL * np.stack([np.expm1(-x), weighted])


def _integral_of_points(energy: Energy, thermal: np.ndarray) -> np.ndarray:
    """The integrals (2, t) of points, by adaptive quadrature over ln r."""

    def shell(log_r: float) -> np.ndarray:
        r = np.exp(log_r)
        at = np.array([[0.0, 0.0, r]])
        return 4 * pi * r**3 * _integrand(energy, thermal, at, np.eye(3)[None])[..., 0]

    ends = np.log([1e-3 * NEAREST, FARTHEST])
    limits = np.linspace(ends[0], ends[1], SEGMENTS + 1)[1:-1]
    integral, _, details = quad_vec(
        shell, *ends, epsabs=1e-200, epsrel=POINT_ERROR, norm="max", points=limits, full_output=True
    )
    _check_end(shell(ends[1]), integral, success=details.success)
    return integral


def _samples(energy: Energy, thermal: np.ndarray, edges: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The integrals (2, t, m) by each of some random numbers (m, 6): of r, and of orientations.

    Each is followed by all rotations of a tetrahedron of the second molecule: its dipole and
    quadrupole are then 0 on average, so that the tail has no noise.
    """
    even = np.linspace(0, 1, edges.shape[1])
    bins = np.minimum((u * BINS).astype(int), BINS - 1)
    x = np.stack([np.interp(u[:, d], even, of) for d, of in enumerate(edges)], axis=1)
    widths = np.stack([BINS * np.diff(of)[bins[:, d]] for d, of in enumerate(edges)])
    r, slope = _distances(x[:, 0])
    found = _integrand(energy, thermal, *_orientations(r, x[:, 1:]))
    means = found.reshape(*found.shape[:2], len(r), -1).mean(axis=3)
    return means * 4 * pi * r**2 * slope * widths.prod(axis=0)


def _distances(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """r (Å) from NEAREST to FARTHEST at x from 0 to 1, and dr/dx."""
    last = np.log(FAR) + np.log(np.log(FARTHEST / FAR))
    t = np.log(NEAREST) + (last - np.log(NEAREST)) * x
    growth = np.exp(t - np.log(FAR))
    r = np.exp(t + growth)
    return r, r * (1 + growth) * (last - np.log(NEAREST))


def _points(seed: int) -> qmc.Sobol:
    """Randomised points of the unit cube of six dimensions."""
    return qmc.Sobol(6, seed=seed)  # pyright: ignore[reportCallIssue]  # SciPy 1.15 renames it rng


def _adapted_edges(energy: Energy, thermal: np.ndarray, seed: int) -> np.ndarray:
    """Edges (6, bins + 1) of variable intervals with equal numbers of samples, narrow where the
    integrand is large (Lepage 1978, J. Comput. Phys. 27, 192)."""
    even = np.linspace(0, 1, BINS + 1)
    edges = np.tile(even, (6, 1))
    points = _points(seed)
    for _ in range(ADAPTATIONS):
        u = points.random(AT_ONCE)
        size = np.abs(_samples(energy, thermal, edges, u))
        size = (size / size.sum(axis=2, keepdims=True)).sum(axis=(0, 1))
        for d in range(6):
            square = np.bincount((u[:, d] * BINS).astype(int), size**2, BINS)
            density = np.sqrt(np.convolve(np.pad(square, 1, "edge"), np.ones(3), "valid"))
            density = density / density.sum() + EVEN / BINS
            total = np.append(0, np.cumsum(density)) / density.sum()
            edges[d] = np.interp(even, total, edges[d])
    return edges


def _integral(
    energy: Energy, thermal: np.ndarray, edges: np.ndarray, samples: int, seed: int
) -> np.ndarray:
    """The integrals (2, t) by randomised Sobol points."""
    points = _points(seed)
    total = 0.0
    for begin in range(0, samples, AT_ONCE):
        u = points.random(min(AT_ONCE, samples - begin))
        total = total + _samples(energy, thermal, edges, u).sum(axis=2)
    integral = np.asarray(total) / samples
    shells = []
    for x in (0.0, 1.0):
        r = _distances(np.full(len(u), x))[0]
        values = _integrand(energy, thermal, *_orientations(r, u[:, 1:])).mean(axis=2)
        shells.append(4 * pi * r[0] ** 3 * values)
    _check_end(shells[1], integral)
    return integral + shells[0] / 3


def _check_end(left: np.ndarray, integral: np.ndarray, *, success: bool = True) -> None:
    """Raise SimulationError where the integrand has not vanished at FARTHEST."""
    if not success or np.abs(left).max() > LEFT * np.abs(integral).max():
        raise SimulationError(
            "the integral over r does not converge: the energy falls too slowly with the distance"
        )


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
    return Guest(system, models[1], temperature, np.arange(count) == 0), state
