"""Shipped potentials of bodies: Gay-Berne, multipoles, patches; compared with LAMMPS and general forms."""

import shutil
import subprocess
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.body_pairs import DISC, ROD, evaluated, named

from rigidmd.features.potentials.poses.formulas import formula_of_poses
from rigidmd.features.potentials.poses.gay_berne import PARAMETERS, GayBerne
from rigidmd.features.potentials.poses.multipoles import dipole, quadrupole
from rigidmd.features.potentials.poses.patch import PARAMETERS as PATCH
from rigidmd.features.potentials.poses.patch import Patch
from rigidmd.units import COULOMB, DEBYE, KJ_PER_MOL

BALL = {"length_A": 4.0, "width_A": 4.0, "epsilon_kJ_mol": 0.8, "side": 1.0, "end": 1.0}


def test_gay_berne_of_two_rods_has_the_wells_of_its_paper():
    """Side by side epsilon_0 / sqrt(1 - chi²) = 5/3 deep, end to end a fifth of it."""
    z, energy = np.array([0.0, 0.0, 1.0]), GayBerne()
    side = 4.0 * 2 ** (1 / 6) * np.array([1.0, 0.0, 0.0])
    end = (8.0 + 4.0 * 2 ** (1 / 6)) * z
    assert energy(side, z, z, named(ROD), named(ROD)) == pytest.approx(-5 / 3, rel=1e-12)
    assert energy(end, z, z, named(ROD), named(ROD)) == pytest.approx(-1 / 3, rel=1e-12)


def from_matrices(r, u, v, p, q, upsilon, mu, gamma):
    """The general form for ellipsoids by 3 x 3 matrices, Everaers & Ejtehadi 2003."""
    distance = np.linalg.norm(r)
    unit = r / distance

    def matrix(axis, across, along):
        return across * np.eye(3) + (along - across) * np.outer(axis, axis)

    bodies = (u, p), (v, q)
    shape = sum(matrix(axis, (x.width_A / 2) ** 2, (x.length_A / 2) ** 2) for axis, x in bodies)
    wells = sum(matrix(axis, x.side ** (-1 / mu), x.end ** (-1 / mu)) for axis, x in bodies)
    sizes = [((x.width_A / 2) ** 2 + (x.length_A / 2) ** 2) * x.width_A / 2 for _, x in bodies]
    eta = (2 * sizes[0] * sizes[1] / np.linalg.det(shape)) ** (upsilon / 2)
    chi = (2 * unit @ np.linalg.solve(wells, unit)) ** mu
    contact = (0.5 * unit @ np.linalg.solve(shape, unit)) ** -0.5
    sigma = (p.width_A + q.width_A) / 2
    ratio = sigma / (distance - contact + gamma * sigma)
    epsilon = np.sqrt(p.epsilon_kJ_mol * q.epsilon_kJ_mol)
    return 4 * epsilon * (ratio**12 - ratio**6) * eta * chi


@pytest.mark.parametrize("exponents", [(1.0, 2.0, 1.0), (3.0, 1.0, 0.8)])
def test_unlike_ellipsoids_are_those_of_the_general_form(exponents):
    rng, energy = np.random.default_rng(1), GayBerne(*exponents)
    kinds = [named(ROD), named(DISC), named(BALL)]
    for p, q in product(kinds, kinds):
        u, v, direction = (x / np.linalg.norm(x) for x in rng.standard_normal((3, 3)))
        r = 11.0 * direction
        expected = from_matrices(r, u, v, p, q, *exponents)
        assert energy(r, u, v, p, q) == pytest.approx(expected, rel=1e-11)
        assert energy(-r, v, u, q, p) == pytest.approx(expected, rel=1e-11)


def original_gay_berne(r, u, v, width, strength, kappa, wells, mu, nu):
    """Gay & Berne 1981, equal ellipsoids."""
    distance = np.linalg.norm(r)
    a, b, c = u @ r / distance, v @ r / distance, u @ v
    chi = (kappa**2 - 1) / (kappa**2 + 1)
    of_wells = (wells ** (1 / mu) - 1) / (wells ** (1 / mu) + 1)
    shape, depth = (
        1 - x / 2 * ((a + b) ** 2 / (1 + x * c) + (a - b) ** 2 / (1 - x * c))
        for x in (chi, of_wells)
    )
    rho = (distance - width / np.sqrt(shape) + width) / width
    epsilon = strength * (1 - (chi * c) ** 2) ** (-nu / 2) * depth**mu
    return 4 * epsilon * (rho**-12 - rho**-6)


@pytest.mark.parametrize("exponents", [(1.0, 2.0), (2.0, 1.0)])
def test_equal_ellipsoids_have_the_original_form(exponents):
    nu, mu = exponents
    rng, energy = np.random.default_rng(4), GayBerne(nu, mu)
    for kind in (ROD, DISC):
        for _ in range(5):
            u, v, direction = (x / np.linalg.norm(x) for x in rng.standard_normal((3, 3)))
            r = rng.uniform(9, 14) * direction
            expected = original_gay_berne(
                r,
                u,
                v,
                kind["width_A"],
                kind["epsilon_kJ_mol"] * kind["side"],
                kind["length_A"] / kind["width_A"],
                kind["side"] / kind["end"],
                mu,
                nu,
            )
            assert energy(r, u, v, named(kind), named(kind)) == pytest.approx(expected, rel=1e-11)


def test_overlapping_ellipsoids_repel():
    """Where the shifted distance is 0 or negative the form alone would diverge or attract."""
    u, x = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    for distance in (1e-3, 1.0, 3.0):
        assert GayBerne()(distance * u, u, u, named(ROD), named(ROD)) > 1e9
        assert GayBerne()(distance * x, u, x, named(ROD), named(ROD)) > 1e9


def test_torques_and_force_of_a_pair_add_up_to_no_torque():
    rng, formula = np.random.default_rng(11), formula_of_poses(Patch(), PATCH, "x")
    evaluate = evaluated(formula)
    kind = {"sigma_A": 4.0, "epsilon_kJ_mol": 2.0, "width": 0.4}
    row = np.array(formula.numbers(kind, kind))
    for _ in range(5):
        r = 5 * rng.standard_normal(3)
        a, b = Rotation.random(2, random_state=rng).as_matrix()
        _, slope, torque, other = map(np.array, evaluate(row, tuple(r), a, b))
        size = np.abs(torque).max() + np.abs(other).max()
        assert torque + other - np.cross(r, slope) == pytest.approx(0.0, abs=1e-12 * size)


def lammps(*lines: str, folder) -> None:
    program = shutil.which("lmp")
    if program is None:
        pytest.skip("LAMMPS is not installed")
    (folder / "in.lmp").write_text("\n".join(lines))
    ended = subprocess.run(
        [program, "-in", "in.lmp", "-log", "none", "-screen", "none"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_a_thousand_pairs_have_the_energies_forces_and_torques_of_lammps(tmp_path):
    pairs, apart = 1000, 100.0
    rng = np.random.default_rng(5)
    rotation = Rotation.random(2 * pairs, random_state=6)
    centre = apart * np.array(list(product(range(10), repeat=3)))[:pairs]
    direction = rng.standard_normal((pairs, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    second = centre + direction * rng.uniform(9.0, 15.0, pairs)[:, None]
    kind = rng.integers(1, 3, 2 * pairs)
    quaternion = rotation.as_quat()[:, [3, 0, 1, 2]]
    position = np.stack([centre, second], axis=1).reshape(-1, 3)
    shapes = {1: ROD, 2: DISC}
    rows = [
        f"{k + 1} {kind[k]} 1 1 {x:.17g} {y:.17g} {z:.17g}" for k, (x, y, z) in enumerate(position)
    ]
    ellipsoids = [
        f"{k + 1} {s['width_A']} {s['width_A']} {s['length_A']} "
        + " ".join(f"{x:.17g}" for x in quaternion[k])
        for k, s in enumerate(shapes[one] for one in kind)
    ]
    size = 10 * apart + 50
    (tmp_path / "pairs.data").write_text(
        f"pairs\n\n{2 * pairs} atoms\n{2 * pairs} ellipsoids\n2 atom types\n\n"
        + "".join(f"-50 {size} {x}lo {x}hi\n" for x in "xyz")
        + "\nAtoms # ellipsoid\n\n"
        + "\n".join(rows)
        + "\n\nEllipsoids\n\n"
        + "\n".join(ellipsoids)
        + "\n"
    )
    coefficients = [
        f"pair_coeff {i} {j} {np.sqrt(p['epsilon_kJ_mol'] * q['epsilon_kJ_mol']):.17g}"
        f" {(p['width_A'] + q['width_A']) / 2}"
        f" {p['side']} {p['side']} {p['end']} {q['side']} {q['side']} {q['end']}"
        for (i, p), (j, q) in product(shapes.items(), repeat=2)
        if i <= j
    ]
    lammps(
        "units lj",
        "atom_style ellipsoid",
        "boundary f f f",
        "read_data pairs.data",
        "pair_style gayberne 1.0 1.0 2.0 20.0",
        *coefficients,
        "compute energy all pe/atom",
        "dump 1 all custom 1 forces.txt id fx fy fz tqx tqy tqz c_energy",
        'dump_modify 1 sort id format float "%.17g"',
        "run 0",
        folder=tmp_path,
    )
    table = np.loadtxt(tmp_path / "forces.txt", skiprows=9).reshape(pairs, 2, 8)
    formula = formula_of_poses(GayBerne(), PARAMETERS, "z")
    evaluate = evaluated(formula)
    matrices = rotation.as_matrix().reshape(pairs, 2, 3, 3)
    for k in range(pairs):
        p, q = (shapes[one] for one in kind[2 * k : 2 * k + 2])
        row = np.array(formula.numbers(p, q))
        values = evaluate(row, tuple(second[k] - centre[k]), *matrices[k])
        energy, slope, torque, other = (np.array(part) / KJ_PER_MOL for part in values)
        size = np.abs(table[k]).max()
        assert energy == pytest.approx(table[k, :, 7].sum(), rel=1e-10, abs=1e-10 * size)
        assert slope == pytest.approx(table[k, 0, 1:4], rel=1e-10, abs=1e-10 * size)
        assert torque == pytest.approx(table[k, 0, 4:7], rel=1e-10, abs=1e-10 * size)
        assert other == pytest.approx(table[k, 1, 4:7], rel=1e-10, abs=1e-10 * size)


def test_dipoles_and_quadrupoles_are_limits_of_charges():
    """Charges at the distance 2 h on the axis: the error is of the order h²."""
    rng = np.random.default_rng(3)
    u, v, direction = (x / np.linalg.norm(x) for x in rng.standard_normal((3, 3)))
    r = 6.0 * direction

    def of_charges(first, second, h):
        return sum(
            a * b * COULOMB / KJ_PER_MOL / np.linalg.norm(r + h * y * v - h * x * u)
            for (x, a), (y, b) in product(first.items(), second.items())
        )

    two, three = {1: 1.0, -1: -1.0}, {1: 1.0, 0: -2.0, -1: 1.0}
    for h in (0.1, 0.05):
        for charges, energy, key, moment in [
            (two, dipole(), "dipole_D", 2 * h / DEBYE),
            (three, quadrupole(), "quadrupole_D_A", 2 * h * h / DEBYE),
        ]:
            expected = of_charges(charges, charges, h)
            found = energy(r, u, v, named({key: moment}), named({key: moment}))
            assert found == pytest.approx(expected, rel=10 * h * h)
    inside = dipole(12.0)(r, u, v, *[named({"dipole_D": 2.0})] * 2)
    outside = dipole()(r, u, v, *[named({"dipole_D": 2.0})] * 2)
    factor = COULOMB / KJ_PER_MOL * DEBYE**2 * 4 / 12.0**3
    assert inside - outside == pytest.approx(-factor * (u @ v), rel=1e-12)


def test_patches_attract_where_they_face_each_other():
    x, energy = np.array([1.0, 0.0, 0.0]), Patch()
    kind = named({"sigma_A": 4.0, "epsilon_kJ_mol": 2.0, "width": 0.2})
    contact = 4.0 * 2 ** (1 / 6) * x
    assert energy(contact, x, -x, kind, kind) == pytest.approx(-2.0, rel=1e-12)
    assert energy(contact, -x, x, kind, kind) > 1.9
