"""Second virial coefficients: closed forms, quadrature in NumPy, published values, what is refused."""

import csv
from math import factorial, gamma, pi

import numpy as np
import pytest
from scipy.integrate import quad

import rigidmd
from rigidmd.commands.cli import main
from rigidmd.errors import MoleculeError, SceneError, SimulationError
from rigidmd.scene.models import load_model
from rigidmd.studies.virial import CM3_PER_MOL, integrate, second_virial
from rigidmd.units import BOLTZMANN, COULOMB, KJ_PER_MOL

ARGON = load_model("argon")
SIGMA, WELL = float(ARGON.sigma[0]), float(ARGON.epsilon[0])
TEMPERATURES = [90.0, 300.0, 1000.0]


def lennard_jones(t):
    """B2 over 2 pi sigma³/3 at t = kT/epsilon (Hirschfelder, Curtiss & Bird, eq. 3.6-9)."""
    return -sum(
        2 ** (n + 0.5) / (4 * factorial(n)) * gamma((2 * n - 1) / 4) * t ** (-(2 * n + 1) / 4)
        for n in range(80)
    )


def test_lennard_jones():
    found = second_virial("argon", temperatures=TEMPERATURES)
    exact = [
        2 / 3 * pi * SIGMA**3 * CM3_PER_MOL * lennard_jones(BOLTZMANN * t / WELL)
        for t in TEMPERATURES
    ]
    np.testing.assert_allclose(found.B2, exact, rtol=1e-7)
    near = [
        second_virial("argon", temperatures=[t * s for t in TEMPERATURES]) for s in (0.999, 1.001)
    ]
    slope = (near[1].B2 - near[0].B2) / (0.002 * found.temperature)
    np.testing.assert_allclose(found.dB2_dT, slope, rtol=1e-4)


def test_square_well():
    sigma, reach, well, kt = 3.0, 1.7, 80.0, BOLTZMANN * np.array([100.0, 300.0])

    def energy(position, rotation):
        r = np.linalg.norm(position, axis=1)
        return np.select([r < sigma, r < reach * sigma], [np.inf, -well], 0.0)

    found = integrate(energy, kt / BOLTZMANN, points=True)
    core = 2 / 3 * pi * sigma**3 * CM3_PER_MOL
    exact = core * (1 - (reach**3 - 1) * np.expm1(well / kt))
    np.testing.assert_allclose(found.B2, exact, rtol=1e-6)
    slope = core * (reach**3 - 1) * well / kt * np.exp(well / kt) / (kt / BOLTZMANN)
    np.testing.assert_allclose(found.dB2_dT, slope, rtol=1e-6)


def argon_nitrogen(temperature):
    """B2 of argon and TraPPE nitrogen by quadrature over the angle and r, in NumPy."""
    nitrogen = load_model("nitrogen_trappe")
    x, weight = np.polynomial.legendre.leggauss(48)
    at = nitrogen.positions_body[:, 0]

    def shell(r):
        d2 = r**2 + at[:, None] ** 2 - 2 * r * x * at[:, None]
        sigma, well = (SIGMA + nitrogen.sigma) / 2, np.sqrt(WELL * nitrogen.epsilon)
        six = (sigma[:, None] ** 2 / d2) ** 3
        u = (4 * well[:, None] * (six**2 - six)).sum(axis=0)
        return r**2 * (weight @ np.expm1(-u / (BOLTZMANN * temperature))) / 2

    parts = [quad(shell, a, b, limit=500)[0] for a, b in ((0.1, 2), (2, 4), (4, 8), (8, 100))]
    return -2 * pi * CM3_PER_MOL * (sum(parts) - 0.1**3 / 3)


def test_errors_are_honest():
    """Pulls of cross coefficients over seeds, of a molecule and of an atom as the first one."""
    exact, pulls = argon_nitrogen(300.0), []
    for seed in range(12):
        pair = ("argon", "nitrogen_trappe")[:: 1 - 2 * (seed % 2)]
        found = second_virial(*pair, temperatures=[300.0], error=0.2, seed=100 * seed)
        assert found.error[0] <= 0.2
        pulls.append((found.B2[0] - exact) / found.error[0])
    assert np.abs(pulls).max() < 4
    assert 0.4 < np.std(pulls) < 1.6


#: SPC/E with the numbers of the authors' program, etomica, see the guide.
ETOMICA = """
name = "spce"
sites = [
    { name = "O", mass_u = 16, charge_e = -0.8476, position_A = [0, 0, 0], sigma_A = 3.167, epsilon_K = 78.21 },
    { name = "H1", mass_u = 1, charge_e = 0.4238, position_A = [0.8166415552, 0.5771451900, 0] },
    { name = "H2", mass_u = 1, charge_e = 0.4238, position_A = [-0.8166415552, 0.5771451900, 0] },
]
"""


def test_published_values(tmp_path):
    """SPC/E: Benjamin, Singh, Schultz & Kofke 2007; ethane: Martin & Siepmann 1998."""
    (tmp_path / "spce.toml").write_text(ETOMICA)
    water = str(tmp_path / "spce.toml")
    found = second_virial(water, temperatures=[500.0, 773.0], error=0.8)
    off = np.abs(found.B2 - [-408.2, -85.96])
    assert (off < 4 * found.error + [0.4, 0.09]).all()
    assert found.error.max() < 0.8
    ethane = second_virial("ethane_trappe", temperatures=[423.2], error=0.2)
    assert abs(ethane.B2[0] + 73) < 1


def test_water_in_numpy():
    """The same coefficient by plain random numbers and energies in NumPy."""
    model, rng, count, farthest = load_model("spce"), np.random.default_rng(3), 400_000, 40.0
    x, q = model.positions_body, model.charges
    r = np.exp(rng.uniform(np.log(1.5), np.log(farthest), count))
    direction = rng.normal(size=(count, 3))
    centre = r[:, None] * direction / np.linalg.norm(direction, axis=1)[:, None]
    mean = 0.0
    turned = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    turned *= np.linalg.det(turned)[:, None, None]
    for flip in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]):
        sites = centre[:, None] + np.einsum("mij,sj->msi", turned, x * flip)
        d = np.linalg.norm(sites[:, :, None] - x, axis=3)
        six = (model.sigma[0] / d[:, 0, 0]) ** 6
        core = 4 * model.epsilon[0] * (six**2 - six)
        u = np.where(core > 1e5, np.inf, core + COULOMB * (q[:, None] * q / d).sum(axis=(1, 2)))
        mean = mean + np.expm1(-u / (BOLTZMANN * 773)) / 4
    values = -2 * pi * CM3_PER_MOL * np.log(farthest / 1.5) * mean * r**3
    exact = values.mean() + 2 / 3 * pi * 1.5**3 * CM3_PER_MOL
    error = values.std() / count**0.5
    found = second_virial("spce", temperatures=[773.0], error=0.5)
    assert error < 2
    assert abs(found.B2[0] - exact) < 4 * np.hypot(error, found.error[0])


def test_user_potentials():
    """A user's Lennard-Jones potential in place of the built-in one, from Python and by a key."""
    depth, settings = WELL / 100, {"forces.lennard_jones": False}
    formula = "4*depth*((size/r)**12 - (size/r)**6)"
    mine = rigidmd.pair_potential(formula, {"depth": depth, "size": SIGMA})
    exact = second_virial("argon", temperatures=TEMPERATURES).B2
    found = second_virial("argon", temperatures=TEMPERATURES, forces=[mine], settings=settings)
    np.testing.assert_allclose(found.B2, exact, rtol=1e-7)
    entry = {"name": "mine", "energy": formula, "parameters": {"depth": depth, "size": SIGMA}}
    settings["forces.custom"] = [entry]
    found = rigidmd.second_virial("argon", temperatures=TEMPERATURES, settings=settings)
    np.testing.assert_allclose(found.B2, exact, rtol=1e-7)


def test_a_barrier_is_a_core():
    """A Buckingham potential falls without limit inside of its barrier."""
    mine = rigidmd.pair_potential("1.6e6*exp(-4.4*r) - 6.2e3/r**6", sites=["AR"])
    settings = {"forces.lennard_jones": False}
    found = second_virial("argon", temperatures=[300.0], forces=[mine], settings=settings)

    def shell(r):
        u = 100 * (1.6e6 * np.exp(-4.4 * r) - 6.2e3 / r**6)
        return r**2 * np.expm1(-u / (BOLTZMANN * 300))

    integral = quad(shell, 1.2, 5)[0] + quad(shell, 5, 1e3, limit=500)[0] - 1.2**3 / 3
    assert found.B2[0] == pytest.approx(-2 * pi * CM3_PER_MOL * integral, rel=1e-6)


def test_keys_of_forces_act():
    """A mixing rule and parameters of a pair."""
    names, options = ("argon", "xenon"), {"temperatures": [300.0]}
    usual = second_virial(*names, **options).B2[0]
    geometric = second_virial(*names, **options, settings={"forces.mixing": "geometric"}).B2[0]
    pair = {"sites": ["argon.AR", "xenon.XE"], "sigma_A": SIGMA, "epsilon_kJ_mol": WELL / 100}
    special = second_virial(*names, **options, settings={"forces.pairs": [pair]}).B2[0]
    assert abs(usual - geometric) > 0.01
    assert special == pytest.approx(second_virial("argon", **options).B2[0], rel=1e-7)


BARE = """
name = "bare"
[[sites]]
name = "A"
mass_u = 1
position_A = [0, 0, 0]
charge_e = 1
[[sites]]
name = "B"
mass_u = 1
position_A = [1, 0, 0]
charge_e = -1
"""


def test_what_is_refused(tmp_path):
    (bare := tmp_path / "bare.toml").write_text(BARE)
    for models, error, words in (
        (["na_spce", "cl_spce"], SceneError, "both molecules have a net charge"),
        (["spc_e"], MoleculeError, "unknown model 'spc_e'"),
        ([str(bare)], SceneError, "without a repulsive core"),
    ):
        with pytest.raises(error, match=words):
            second_virial(*models, temperatures=[300.0])
    for wrong in ([], [0.0], [-1.0]):
        with pytest.raises(SceneError, match="temperatures must be above 0 K"):
            second_virial("argon", temperatures=wrong)
    slow = rigidmd.pair_potential("-1/r**2", sites=["AR"])
    with pytest.raises(SimulationError, match="falls too slowly"):
        second_virial("argon", temperatures=[300.0], forces=[slow])


def test_the_command(tmp_path, capsys):
    table = tmp_path / "b2.csv"
    words = ["virial", "argon", "krypton", "--temperatures", "150,300", "-o", str(table)]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert "argon-krypton" in shown
    with open(table, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["species"] for row in rows] == [
        of for of in ("argon-argon", "argon-krypton", "krypton-krypton") for _ in range(2)
    ]
    exact = second_virial("argon", "krypton", temperatures=[150.0, 300.0])
    assert [float(row["B2 (cm³/mol)"]) for row in rows[2:4]] == exact.B2.tolist()
    assert main(words) == 2  # the file exists
    with pytest.raises(SystemExit):
        main(["virial", "argon", "--temperatures", "300,cold"])
    assert "'300,cold' are not temperatures above 0 K" in capsys.readouterr().err


def segments(r, u, v, half=0.5):
    """The squared distance (Å²) of two segments: the least of five pairs of points, of which one is
    the nearest."""

    def limited(x):
        return np.maximum(np.minimum(x, half), -half)

    def between(s, t):
        apart = r + t * v - s * u
        return apart @ apart

    a, b, c = r @ u, r @ v, u @ v
    sine2 = np.maximum(1 - c * c, 1e-12)
    least = between(limited((a - b * c) / sine2), limited((a * c - b) / sine2))
    for end in (half, -half):
        least = np.minimum(least, between(end, limited(end * c - b)))
        least = np.minimum(least, between(limited(a + end * c), end))
    return least


def repulsion(n):
    """(1/d)^n, kJ/mol."""
    return lambda r, u, v: segments(r, u, v) ** (-n / 2)


def test_steep_spherocylinders_tend_to_hard_ones(tmp_path):
    """A repulsion (D/d)^n of the distance of segments with L = D = 1, at kT = 1: closed forms, and
    the limit of hard spherocylinders, 6.02138591938044 (FEASST)."""
    rod = "name = 'rod'\n" + "".join(
        f"[[sites]]\nname = '{name}'\nmass_u = 10\nposition_A = [0, 0, {z}]\n"
        for name, z in (("A", 0.5), ("B", -0.5))
    )
    (tmp_path / "rod.toml").write_text(rod)
    temperature = KJ_PER_MOL / BOLTZMANN
    powers, found, errors = (20, 40, 80), [], []
    for n in powers:
        potential = rigidmd.body_pair_potential(repulsion(n), axis="z")
        result = second_virial(
            str(tmp_path / "rod.toml"),
            temperatures=[temperature],
            forces=[potential],
            error=0.02 * CM3_PER_MOL,
        )
        found.append(result.B2[0] / CM3_PER_MOL)
        errors.append(result.error[0] / CM3_PER_MOL)
    exact = [
        2 * pi / 3 * gamma(1 - 3 / n) + pi * gamma(1 - 2 / n) + pi / 4 * gamma(1 - 1 / n)
        for n in powers
    ]
    assert np.abs(np.subtract(found, exact) / errors).max() < 4
    weights = np.array([1, -6, 8]) / 3  # of a parabola in 1/n, at 0
    assert weights @ exact == pytest.approx(6.02138591938044, abs=2e-3)
    error = float(np.linalg.norm(weights * errors))
    assert weights @ found == pytest.approx(6.02138591938044, abs=2e-3 + 4 * error)
    assert error < 0.07
