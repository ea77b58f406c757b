"""Analyses of mixtures whose molecules are rotated and whose triclinic cell breathes, compared with
plain NumPy.

Everything on the other side is written out here: sums over all pairs and images, constants from SI.
"""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.common import small_scene
from support.reference import inverse_power

from rigidmd.assemble.build import build
from rigidmd.features.analysis.built_in.rotation import dielectric, orientation, spectrum
from rigidmd.features.analysis.built_in.structure import (
    density_profile,
    hydrogen_bonds,
    rdf,
    structure_factor,
)
from rigidmd.features.analysis.built_in.transport import msd
from rigidmd.features.analysis.rigid_frames import RigidFrames

GRAM_PER_CM3 = 1 / 1.66053906660  # u/Å³
KELVIN = 1.380649e-23 / 1.66053906660e-27 * 1e20 / 1e24  # u Å²/ps²
COULOMB = (
    (1.602176634e-19) ** 2 / (4 * np.pi * 8.8541878128e-12) / 1.66053906660e-27 * 1e30 / 1e24
)  # e²/Å, u Å²/ps²
SPEED_OF_LIGHT = 29.9792458e-3  # cm/ps
COUNTS = {"spce": 9, "nitrogen": 7, "argon": 4}
CELL = np.array([[15.0, 0.0, 0.0], [4.0, 14.0, 0.0], [-5.0, 3.0, 16.0]])
IMAGES = np.array(list(product((-1, 0, 1), repeat=3)), float)


def history(system, time, positions, cell, Q, velocities=None, L=None):
    """Frames as they are given, at 300 K."""
    return RigidFrames(
        system,
        system.scene.stages[-1],
        time,
        np.broadcast_to(cell, (len(time), 3, 3)),
        positions,
        Q,
        velocities,
        L,
        {"temperature": np.full(len(time), 300.0)},
    )


def rotations(rng, *shape):
    return Rotation.random(int(np.prod(shape)), random_state=rng).as_matrix().reshape(*shape, 3, 3)


def mixed(frames=12, breath=0.0, seed=7, counts=COUNTS):
    """Molecules at random positions with random orientations, new ones in each frame; some far outside
    the cell."""
    system = build(small_scene(counts, 20.0, forces={"cutoff_A": 5.0}))
    rng, n = np.random.default_rng(seed), sum(counts.values())
    cell = CELL * (1 + breath * rng.standard_normal((frames, 1, 1)))
    places = rng.random((frames, n, 3)) + rng.integers(-2, 3, (frames, n, 3))
    return history(system, np.arange(float(frames)), places @ cell, cell, rotations(rng, frames, n))


def species(found):
    """Name -> molecule, and the indices of its molecules."""
    return {
        m.name: (m, np.flatnonzero(found.system.model.species == k))
        for k, m in enumerate(found.system.species)
    }


def sites(found, frame, wanted):
    """Positions (s, 3) of the sites that `wanted(molecule, site)` accepts, and their molecules
    (s,)."""
    at, owner = [], []
    for molecule, index in species(found).values():
        for k in index:
            for site, arm in enumerate(molecule.positions_body):
                if wanted(molecule, site):
                    at.append(found.positions[frame, k] + found.Q[frame, k] @ arm)
                    owner.append(k)
    return np.array(at), np.array(owner)


def gaps(found, frame, first, second):
    """All vectors from sites to sites of other molecules, of 27 images: (pairs, 27, 3), and the
    pairs (p, 2)."""
    (a, own_a), (b, own_b) = first, second
    i, j = np.nonzero(own_a[:, None] != own_b[None, :])
    inside = (b[j] - a[i]) @ np.linalg.inv(found.cell[frame])
    near = (inside - np.round(inside)) @ found.cell[frame]
    return near[:, None] + IMAGES @ found.cell[frame], np.stack([i, j], axis=1)


def of_centres(name):
    """Sites that stand for the centres of mass of a species: none; see `centres`."""
    return lambda found, frame: (
        found.positions[frame, species(found)[name][1]],
        species(found)[name][1],
    )


def of_sites(wanted):
    return lambda found, frame: sites(found, frame, wanted)


NAMES = {
    "argon": of_centres("argon"),
    "nitrogen": of_centres("nitrogen"),
    "spce": of_centres("spce"),
    "OW": of_sites(lambda m, s: m.site_names[s] == "OW"),
    "H": of_sites(lambda m, s: m.elements[s] == "H"),
    "N": of_sites(lambda m, s: m.elements[s] == "N"),
}


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("argon", "spce"),
        ("spce", "argon"),
        ("nitrogen", "nitrogen"),
        ("H", "N"),
        ("OW", "H"),
        ("N", "argon"),
    ],
)
def test_pairs_of_a_mixture_are_counted_against_the_pairs_that_there_are(a, b):
    """g(r) in each bin with each frame's volume; n(r), of a cell that stays, the mean number of b
    within r of an a."""
    width, largest = 0.5, 6.0
    edges = np.arange(0.0, largest + width / 2, width)
    still, breathing = mixed(), mixed(breath=0.03)
    for found in (still, breathing):
        frames, counted = [], []
        for frame in range(len(found)):
            first, second = NAMES[a](found, frame), NAMES[b](found, frame)
            far, pairs = gaps(found, frame, first, second)
            counts, _ = np.histogram(np.linalg.norm(far, axis=2).ravel(), edges)
            shells = 4 / 3 * np.pi * np.diff(edges**3)
            frames.append(counts / shells / len(pairs) * np.linalg.det(found.cell[frame]))
            counted.append(counts / len(first[0]))
        seen = rdf(found, a, b, largest, width)
        assert seen[f"g {a}-{b}"] == pytest.approx(np.mean(frames, axis=0), rel=1e-9)
        if found is still:
            each = np.mean(counted, axis=0)
            assert seen[f"n {a}-{b}"] == pytest.approx(np.cumsum(each) - each / 2, rel=1e-9)
    assert each.sum() > 0.5


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_the_profile_of_a_mixture_is_that_of_its_rotated_sites(axis):
    """Masses of sites by their fraction of an edge of the cell of their frame."""
    found, bins, k = mixed(breath=0.03), 7, "xyz".index(axis)
    seen = density_profile(found, axis, bins)
    for name, (molecule, index) in species(found).items():
        total = np.zeros(bins)
        for frame in range(len(found)):
            for m in index:
                for mass, arm in zip(molecule.masses, molecule.positions_body, strict=True):
                    at = found.positions[frame, m] + found.Q[frame, m] @ arm
                    fraction = np.linalg.solve(found.cell[frame].T, at)[k] % 1.0
                    total[int(fraction * bins)] += mass
        slice_volume = np.mean(np.linalg.det(found.cell)) / bins
        expected = total / len(found) / slice_volume / GRAM_PER_CM3
        assert seen[f"density {name} (g/cm3)"] == pytest.approx(expected, rel=1e-9)
    across = np.cross(found.cell[:, k - 2], found.cell[:, k - 1])  # of the two other edges
    height = np.mean(np.linalg.det(found.cell) / np.linalg.norm(across, axis=1))
    assert seen[f"{axis} (A)"] == pytest.approx((np.arange(bins) + 0.5) * height / bins, rel=1e-9)


@pytest.mark.parametrize(("distance", "angle"), [(3.5, 30.0), (5.0, 60.0)])
def test_hydrogen_bonds_of_a_mixture_are_those_of_its_geometry(distance, angle):
    """Every O-H against every O and N of other molecules and their images. Each bond counts for
    both molecules."""
    found = mixed(frames=30, breath=0.02)
    bonds = np.zeros((len(found), sum(COUNTS.values())))
    water, index = species(found)["spce"]
    oxygen = water.elements.index("O")
    hydrogens = [s for s, element in enumerate(water.elements) if element == "H"]
    for frame in range(len(found)):
        givers, takers = (
            NAMES["OW"](found, frame),
            sites(found, frame, lambda m, s: m.elements[s] in "ON"),
        )
        far, pairs = gaps(found, frame, givers, takers)
        for (i, j), ways in zip(pairs, far, strict=True):
            for hydrogen in hydrogens:
                arm = found.Q[frame, givers[1][i]] @ (
                    water.positions_body[hydrogen] - water.positions_body[oxygen]
                )
                cosine = ways @ arm / np.linalg.norm(arm) / np.linalg.norm(ways, axis=1)
                there = (np.linalg.norm(ways, axis=1) < distance) & (
                    cosine > np.cos(np.radians(angle))
                )
                bonds[frame, [givers[1][i], takers[1][j]]] += there.sum()
    seen = hydrogen_bonds(found, distance, angle)
    assert bonds.sum() > 20 and bonds[:, len(index) :].any()  # nitrogen takes some
    assert seen.value().value == pytest.approx(bonds.mean(), rel=1e-12)
    counts = np.bincount(bonds.astype(int).ravel()) / bonds.size
    assert seen["share"] == pytest.approx(counts)


@pytest.mark.parametrize("name", ["", "nitrogen", "H", "N"])
def test_a_structure_factor_is_the_sum_over_its_sites(name):
    """|sum exp(i k r)|²/N at all wave vectors of each frame's cell, in bins of the lengths of the mean cell's."""
    found, largest = mixed(breath=0.02), 1.05
    seen = structure_factor(found, name, largest)
    reciprocal = 2 * np.pi * np.linalg.inv(found.cell.mean(axis=0)).T
    waves = np.array(
        [h for h in product(range(-4, 5), repeat=3) if 0 < np.linalg.norm(h @ reciprocal) < largest]
    )
    lengths = np.linalg.norm(waves @ reciprocal, axis=1)
    values = np.zeros(len(waves))
    for frame in range(len(found)):
        at = found.positions[frame] if not name else NAMES[name](found, frame)[0]
        own = 2 * np.pi * np.linalg.inv(found.cell[frame]).T
        values += np.abs(np.exp(1j * at @ (waves @ own).T).sum(axis=0)) ** 2 / len(at) / len(found)
    bins = (lengths / 0.1).astype(int)
    used = np.unique(bins)
    assert max(np.bincount(bins)) <= 2 * 24  # so few that none is omitted
    assert seen["k (1/A)"] == pytest.approx([lengths[bins == b].mean() for b in used])
    assert seen[f"S {name or 'centres'}"] == pytest.approx(
        [values[bins == b].mean() for b in used], rel=1e-9
    )


def test_the_dipole_of_a_mixture_is_that_of_its_rotated_charges():
    """epsilon = 1 + <M²>/(3 eps0 V kT) with a conducting surrounding; nitrogen and argon have
    none."""
    found = mixed(frames=400)
    system = build(small_scene(COUNTS, 20.0, forces={"cutoff_A": 5.0, "electrostatics": "pme"}))
    found = history(system, found.time, found.positions, found.cell, found.Q)
    water, index = species(found)["spce"]
    M = np.zeros((len(found), 3))
    for m in index:
        for charge, arm in zip(water.charges, water.positions_body, strict=True):
            M += charge * (found.positions[:, m] + found.Q[:, m] @ arm)
    squares = np.mean(np.sum(M**2, axis=1))
    expected = 1 + 4 * np.pi * COULOMB * squares / (3 * np.linalg.det(CELL) * 300 * KELVIN)
    result = dielectric(found)
    assert result.value("dielectric constant").value == pytest.approx(expected, rel=1e-7)
    for k, axis in enumerate("xyz"):
        mean = result.value(f"mean total dipole along {axis}")
        assert mean.value == pytest.approx(M[:, k].mean() / 0.20819434, rel=1e-6)  # D
        scatter = M[:, k].std() / 0.20819434 / np.sqrt(len(M))
        assert 0.9 * scatter < mean.error < 2.5 * scatter


def test_displacements_of_a_mixture_are_those_of_each_species():
    rng, counts = np.random.default_rng(4), {"spce": 3, "nitrogen": 2, "argon": 2}
    system = build(small_scene(counts, 20.0, forces={"cutoff_A": 5.0}))
    speed = np.repeat([0.1, 0.5, 2.0], list(counts.values()))
    paths = np.cumsum(rng.standard_normal((60, 7, 3)) * speed[:, None], axis=0)
    found = history(system, np.arange(60.0), paths, CELL, rotations(rng, 60, 7))
    seen = msd(found)
    for name, (_, index) in species(found).items():
        for lag in range(len(seen["Time (ps)"])):
            moved = paths[lag:, index] - paths[: 60 - lag, index]
            expected = np.mean(np.sum(moved**2, axis=2))
            assert seen[f"MSD {name} (A^2)"][lag] == pytest.approx(expected, rel=1e-9, abs=1e-9)


# rotation


def walked(rng, frames, rates, interval):
    """Q (frames, n, 3, 3) of bodies that rotate about their own axes with diffusion coefficients
    (n, 3), 1/ps."""
    n = len(rates)
    moves = np.sqrt(2 * rates * interval) * rng.standard_normal((frames, n, 3))
    Q = rotations(rng, 1, n).repeat(frames, axis=0)
    for k in range(1, frames):
        Q[k] = Q[k - 1] @ Rotation.from_rotvec(moves[k]).as_matrix()
    return Q


def test_an_anisotropic_body_diffuses_about_its_own_axes():
    """Benzene that tumbles slowly and spins fast: three coefficients, not their mean, and none of
    nitrogen."""
    rates = np.array([0.02, 0.05, 0.2])
    counts, interval, frames = {"benzene_opls": 40, "nitrogen": 5}, 0.1, 1500
    system = build(small_scene(counts, 40.0, forces={"cutoff_A": 9.0}))
    rng = np.random.default_rng(2)
    Q = walked(rng, frames, np.tile(rates, (45, 1)), interval)
    positions = np.zeros((frames, 45, 3))
    seen = orientation(history(system, interval * np.arange(frames), positions, np.eye(3) * 40, Q))
    for axis, rate in enumerate(rates):
        found = seen.value(f"D_rot of benzene_opls, axis {axis + 1}")
        assert found.error < 0.15 * rate
        assert abs(found.value - rate) < 4 * found.error
    assert not [value.name for value in seen.values if "D_rot of nitrogen" in value.name]


def test_orientations_of_a_mixture_are_those_of_each_species():
    """C1 = <u(0) u(t)> and C2 = <(3 (u(0) u(t))² - 1)/2> over all origins, u columns of Q."""
    counts, frames, interval = {"spce": 3, "nitrogen": 4, "argon": 2}, 60, 0.1
    system = build(small_scene(counts, 20.0, forces={"cutoff_A": 5.0}))
    rng = np.random.default_rng(5)
    rates = np.repeat(
        [[0.1, 0.2, 0.6], [0.3, 0.3, 0.3], [1.0, 1.0, 1.0]], list(counts.values()), axis=0
    )
    Q = walked(rng, frames, rates, interval)
    found = history(system, interval * np.arange(frames), np.zeros((frames, 9, 3)), CELL, Q)
    seen = orientation(found)
    for name, axes in (("spce", (0, 1, 2)), ("nitrogen", (0,))):
        index = species(found)[name][1]
        for axis in axes:
            u = Q[:, index][..., axis]
            for lag in range(len(seen["Time (ps)"])):
                cosine = np.sum(u[lag:] * u[: frames - lag], axis=2)
                title = f"{name} axis {axis + 1}"
                assert seen[f"C1 {title}"][lag] == pytest.approx(cosine.mean(), abs=1e-9)
                assert seen[f"C2 {title}"][lag] == pytest.approx(
                    np.mean(1.5 * cosine**2 - 0.5), abs=1e-9
                )


def test_wave_numbers_and_freedoms_of_a_mixture():
    """Vibrations of known wave numbers, in 1/cm by the speed of light, with kT for each degree of
    freedom.

    The rotation of nitrogen has two degrees of freedom, that of water one about each axis; argon
    has translation alone.
    """
    counts, frames, interval = {"spce": 12, "nitrogen": 12, "argon": 12}, 2000, 0.004
    system = build(small_scene(counts, 30.0, forces={"cutoff_A": 5.0}))
    rng, time, thermal = np.random.default_rng(0), interval * np.arange(frames), 300 * KELVIN

    def swing(wave_number, weight, count):
        """Rates (frames, count) of mean square kT/weight over the members and times."""
        phase = 2 * np.pi * rng.random(count)
        return np.sqrt(2 * thermal / weight) * np.cos(
            2 * np.pi * SPEED_OF_LIGHT * wave_number * time[:, None] + phase
        )

    velocities, L = np.zeros((frames, 36, 3)), np.zeros((frames, 36, 3))
    expected = {}
    found = history(
        system,
        time,
        np.zeros((frames, 36, 3)),
        np.eye(3) * 30,
        rotations(rng, 1, 36).repeat(frames, axis=0),
    )
    for k, (name, (molecule, index)) in enumerate(species(found).items()):
        at = 60.0 + 40 * k
        expected[f"V {name}"] = at, 3
        for i in range(3):
            velocities[:, index, i] = swing(at, molecule.mass, len(index))
            if molecule.inertia[i] > 0:
                librates = 300.0 + 100 * i if name == "spce" else 220.0
                L[:, index, i] = molecule.inertia[i] * swing(
                    librates, molecule.inertia[i], len(index)
                )
                title = f"omega {name} axis {i + 1}" if name == "spce" else f"omega {name}"
                expected[title] = librates, 1 if name == "spce" else 2
    seen = spectrum(history(system, time, found.positions, np.eye(3) * 30, found.Q, velocities, L))
    step = seen["wave number (1/cm)"][1]
    assert step == pytest.approx(1 / (interval * (frames // 5) * SPEED_OF_LIGHT), rel=1e-9)
    assert len(expected) == 7
    for title, (wave_number, freedom) in expected.items():
        assert seen.value(f"highest peak of {title}").value == pytest.approx(
            wave_number, abs=0.6 * step
        )
        assert np.sum(seen[title]) * step == pytest.approx(freedom, rel=0.03)


# forces


@pytest.mark.parametrize("mixing", ["lorentz-berthelot", "geometric"])
def test_the_tail_of_a_mixture_is_a_sum_over_all_pairs_of_its_sites(mixing):
    """U = (2 pi/V) sum_ij 4 eps (s¹²/9 rc⁹ - s⁶/3 rc³) and P = (2 pi/3V²) sum_ij 4 eps (12 s¹²/9
    rc⁹ - 6 s⁶/3 rc³), i and j over all sites: each unlike pair twice. Allen & Tildesley 2017,
    section 2.8."""
    cutoff, volume = 5.5, 20.0**3
    forces = {"cutoff_A": cutoff, "truncation": "plain", "tail_correction": True, "mixing": mixing}
    system = build(small_scene(COUNTS, 20.0, forces=forces))
    all_sites = [
        (sigma, epsilon)
        for molecule, count in zip(system.species, COUNTS.values(), strict=True)
        for sigma, epsilon in zip(molecule.sigma, molecule.epsilon, strict=True)
        for _ in range(count)
        if epsilon > 0
    ]
    assert len(all_sites) == 9 + 14 + 4
    energy = pressure = 0.0
    for (s, e), (t, f) in product(all_sites, repeat=2):
        sigma = (s + t) / 2 if mixing == "lorentz-berthelot" else np.sqrt(s * t)
        twelve, six = (4 * np.sqrt(e * f) * sigma**p for p in (12, 6))
        energy += 2 * np.pi / volume * (twelve / (9 * cutoff**9) - six / (3 * cutoff**3))
        pressure += (
            2
            * np.pi
            / (3 * volume**2)
            * (12 * twelve / (9 * cutoff**9) - 6 * six / (3 * cutoff**3))
        )
    assert system.tail.energy(volume) == pytest.approx(energy, rel=1e-9)
    assert system.tail.pressure(volume) == pytest.approx(pressure, rel=1e-9)


@pytest.mark.parametrize("cutoff", [5.5, 6.4])
@pytest.mark.parametrize(
    "truncation", ["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
)
def test_the_tail_leaves_out_pairs_of_sites_of_one_molecule(truncation, cutoff):
    """A molecule is part of the uniform liquid and not among its own neighbours: U has less by half
    the sum, over its pairs of sites and each site with itself, of what the truncation removes from
    them. No force, and no pressure."""
    counts, edge = {"argon": 5, "co2_trappe": 4, "benzene_opls": 3}, 20.0
    forces = {"cutoff_A": cutoff, "truncation": truncation, "tail_correction": True}
    system = build(small_scene(counts, edge, forces=forces))
    start = system.scene.forces.switch_start_A or cutoff
    less = 0.0
    for molecule, count in zip(system.species, counts.values(), strict=True):
        for i, j in product(range(len(molecule.masses)), repeat=2):
            r = np.linalg.norm(molecule.positions_body[i] - molecule.positions_body[j])
            sigma = (molecule.sigma[i] + molecule.sigma[j]) / 2
            strength = 4 * np.sqrt(molecule.epsilon[i] * molecule.epsilon[j])
            for sign, p in ((1, 12), (-1, 6)):
                less += (
                    count
                    * sign
                    * strength
                    * sigma**p
                    * removed_power(r, p, cutoff, start, truncation)
                    / 2
                )
    constant = system.tail.energy(edge**3) - system.tail.energy_volume / edge**3
    assert constant == pytest.approx(-less, rel=1e-5, abs=1e-9)
    assert constant > 0.5 or truncation not in ("shift", "force_shift", "force_switch")


def removed_power(r, p, cutoff, start, truncation):
    """What a truncation removes from r⁻ᵖ at a distance, also at 0: there it is that of 1.5 Å, but
    for a slope."""
    if r == 0 and truncation == "force_shift":
        return (1 + p) * cutoff**-p
    r = r or 1.5
    return r**-p - inverse_power(r, p, cutoff, start, truncation)


@pytest.mark.parametrize(("name", "edge"), [("argon", 5.3), ("co2_trappe", 5.7)])
def test_the_tail_gives_the_energy_of_a_crystal(name, edge):
    """Crystals with four molecules along the diagonals of a cube. The sum over all neighbours of
    each molecule, truncated and corrected, has on average over cutoffs the energy of the whole
    crystal: the density of neighbours is uniform but for the molecule itself."""
    (molecule,) = build(small_scene({name: 4}, 40.0)).species
    diagonals = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    along = np.ptp(molecule.positions_body, axis=0).argmax()
    offsets = molecule.positions_body[:, along]
    centres = edge * np.array([[0, 0, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    grid, reach = np.arange(-7, 8), 35.0
    cells = edge * np.array(list(product(grid, repeat=3)))
    pairs = []  # (sigma, 4 epsilon, sorted distances)
    for i, j, k in product(range(len(offsets)), range(len(offsets)), range(4)):
        between = centres[k] + offsets[j] * diagonals[k] - offsets[i] * diagonals[0] + cells
        distance = np.linalg.norm(between[np.any(cells != 0, axis=1) | (k != 0)], axis=1)
        sigma = (molecule.sigma[i] + molecule.sigma[j]) / 2
        pairs.append(
            (
                sigma,
                4 * np.sqrt(molecule.epsilon[i] * molecule.epsilon[j]),
                distance[distance < reach],
            )
        )
    density = 4 / edge**3

    def v(sigma, strength, r):
        return strength * ((sigma / r) ** 12 - (sigma / r) ** 6)

    whole = sum(v(*kind, r).sum() / 2 for *kind, r in pairs)
    whole -= (
        sum(
            2 * np.pi * density * strength * sigma**6 / 3 / reach**3 for sigma, strength, _ in pairs
        )
        / 4
    )
    errors, less = [], []
    for cutoff in np.linspace(9.0, 14.0, 26).tolist():
        forces = {"cutoff_A": cutoff, "truncation": "shift", "tail_correction": True}
        tail = build(small_scene({name: 4}, 40.0, forces=forces)).tail
        within = sum((v(*kind, r[r < cutoff]) - v(*kind, cutoff)).sum() / 2 for *kind, r in pairs)
        errors.append(within + (tail.energy_volume * density / 4 + tail.constant) / 4 - whole)
        less.append(tail.constant / 4)
    assert abs(np.mean(errors)) < 0.15 * np.mean(less)
