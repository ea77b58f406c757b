"""Second virial coefficients: closed forms, quadrature in NumPy, published values, what is refused."""

import csv
from math import factorial, gamma, pi

import numpy as np
import pytest
from scipy.integrate import quad

import rigidmd
from rigidmd.commands.cli import main
from rigidmd.errors import MoleculeError, SceneError, SimulationError
from rigidmd.features.free_energy import virial
from rigidmd.features.free_energy.virial import CM3_PER_MOL, Pair, integrate, second_virial
from rigidmd.scene.models import available_models, load_model
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

    found = integrate(Pair(("A", "B"), kt / BOLTZMANN, energy, points=True))
    core = 2 / 3 * pi * sigma**3 * CM3_PER_MOL
    exact = core * (1 - (reach**3 - 1) * np.expm1(well / kt))
    np.testing.assert_allclose(found.B2, exact, rtol=1e-6)
    slope = core * (reach**3 - 1) * well / kt * np.exp(well / kt) / (kt / BOLTZMANN)
    np.testing.assert_allclose(found.dB2_dT, slope, rtol=1e-6)


def test_points_at_one_temperature_do_not_depend_on_others():
    together = second_virial("argon", temperatures=[0.2, 300.0])
    alone = second_virial("argon", temperatures=[300.0])
    assert together.B2[0] < -1e250
    assert together.B2[1] == alone.B2[0]
    assert together.error[1] == alone.error[0] < 1e-6


def argon_nitrogen(temperature):
    """B2 and dB2/dT of argon and TraPPE nitrogen by quadrature over the angle and r, in NumPy."""
    nitrogen = load_model("nitrogen_trappe")
    x, weight = np.polynomial.legendre.leggauss(48)
    at = nitrogen.positions_body[:, 0]
    sigma, well = (SIGMA + nitrogen.sigma) / 2, np.sqrt(WELL * nitrogen.epsilon)

    def shell(r, of):
        d2 = r**2 + at[:, None] ** 2 - 2 * r * x * at[:, None]
        six = (sigma[:, None] ** 2 / d2) ** 3
        reduced = (4 * well[:, None] * (six**2 - six)).sum(axis=0) / (BOLTZMANN * temperature)
        return r**2 * (weight @ of(reduced)) / 2

    def integral(of):
        ends = ((0.1, 2), (2, 4), (4, 8), (8, 100))
        return sum(quad(shell, a, b, args=(of,), limit=500)[0] for a, b in ends)

    value = integral(lambda u: np.expm1(-u)) - 0.1**3 / 3
    slope = integral(lambda u: u * np.exp(-u)) / temperature
    return -2 * pi * CM3_PER_MOL * np.array([value, slope])


def test_the_derivative_and_its_error():
    """Pulls of few coarse values."""
    exact, options = argon_nitrogen(300.0)[1], {"temperatures": [300.0], "error": 1.0}
    pulls = []
    for seed in range(6):
        found = second_virial("argon", "nitrogen_trappe", **options, seed=100 * seed)
        pulls.append((found.dB2_dT[0] - exact) / found.dB2_dT_error[0])
    assert 0.3 < np.sqrt(np.mean(np.square(pulls))) < 2.5


def test_errors_are_honest():
    """Pulls of cross coefficients over seeds, of a molecule and of an atom as the first one."""
    exact, pulls = argon_nitrogen(300.0), []
    for seed in range(24):
        pair = ("argon", "nitrogen_trappe")[:: 1 - 2 * (seed % 2)]
        found = second_virial(*pair, temperatures=[300.0], error=0.2, seed=100 * seed)
        assert found.error[0] <= 0.2
        off = np.concatenate([found.B2, found.dB2_dT]) - exact
        pulls.append(off / np.concatenate([found.error, found.dB2_dT_error]))
    assert np.abs(pulls).max() < 4
    assert (np.std(pulls, axis=0) > 0.6).all()
    assert (np.std(pulls, axis=0) < 1.5).all()


def test_a_molecule_with_charges_that_cancel():
    """Values of a separate program: Gauss-Legendre panels of ln r to 400 Å, random orientations
    with the 24 rotations of a cube."""
    found = second_virial("nitrogen_trappe", temperatures=[250.0, 300.0, 500.0], error=0.5)
    off = np.abs(found.B2 - [-14.67, -3.00, 18.07])
    assert (off < 4 * np.hypot(found.error, [0.05, 0.04, 0.03])).all()
    assert found.error.max() < 0.5
    mixed = ("nitrogen_trappe", "co2_trappe")
    found = second_virial(*mixed, temperatures=[250.0, 300.0, 500.0], error=1.0)
    off = np.abs(found.B2 - [-55.36, -33.29, 5.30])
    assert (off < 4 * np.hypot(found.error, [0.07, 0.06, 0.04])).all()
    assert found.species == mixed


NEUTRAL = [name for name in available_models() if abs(load_model(name).charges.sum()) < 1e-6]
CHARGED = [name for name in available_models() if name not in NEUTRAL]


def converges(monkeypatch, *pair):
    """Whether few samples give an answer at three temperatures."""
    monkeypatch.setattr(virial, "FEWEST", 2**6)
    monkeypatch.setattr(virial, "AT_ONCE", 2**8)
    found = second_virial(*pair, temperatures=[250.0, 500.0, 1000.0], error=1e9)
    assert np.isfinite([found.B2, found.error, found.dB2_dT, found.dB2_dT_error]).all()
    assert found.samples <= virial.SETS * virial.FEWEST * 12
    return True


@pytest.mark.extended
@pytest.mark.parametrize("name", NEUTRAL)
def test_every_neutral_model_has_an_answer(name, monkeypatch):
    assert converges(monkeypatch, name)
    assert converges(monkeypatch, name, "spce") or name == "spce"


@pytest.mark.soak
@pytest.mark.parametrize("name", NEUTRAL)
def test_every_pair_of_models_has_an_answer(name, monkeypatch):
    """Pairs of neutral models, and of a neutral one with an ion."""
    for second in (*NEUTRAL[NEUTRAL.index(name) + 1 :], *CHARGED):
        assert converges(monkeypatch, name, second)


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


def test_a_reaction_field_of_the_molecule_itself_does_not_count():
    """Within the cutoff, by an energy in NumPy that has pairs of both molecules only."""
    model, cutoff = load_model("nitrogen_trappe"), 12.0
    x, q = model.positions_body, model.charges
    charged = (model.epsilon > 0)[:, None] & (model.epsilon > 0)

    def energy(position, rotation):
        sites = position[:, None] + np.einsum("mij,sj->msi", rotation, x)
        d = np.linalg.norm(sites[:, :, None] - x, axis=3)
        six, end = (model.sigma[0] / np.maximum(d, 0.1)) ** 6, (model.sigma[0] / cutoff) ** 6
        lennard_jones = 4 * model.epsilon[0] * (six**2 - six - end**2 + end) * charged
        coulomb = COULOMB * np.outer(q, q) * (1 / d + d**2 / (2 * cutoff**3) - 1.5 / cutoff)
        total = np.where(d < cutoff, lennard_jones + coulomb, 0.0).sum(axis=(1, 2))
        return np.where((charged & (lennard_jones > 1e5)).any(axis=(1, 2)), np.inf, total)

    settings = {"forces.electrostatics": "reaction_field", "forces.cutoff_A": cutoff}
    found = second_virial("nitrogen_trappe", temperatures=[200.0], error=1.0, settings=settings)
    exact = integrate(Pair(("N2", "N2"), np.array([200.0]), energy, farthest=1e4), 1.0, seed=500)
    assert abs(found.B2[0] - exact.B2[0]) < 4 * np.hypot(found.error[0], exact.error[0])


MASSES = """
name = "masses"
[[sites]]
name = "A"
mass_u = 10
position_A = [0, 0, 0]
[[sites]]
name = "B"
mass_u = 10
position_A = [0, 0, 1]
"""


def test_molecules_without_forces(tmp_path):
    (tmp_path / "masses.toml").write_text(MASSES)
    found = second_virial(str(tmp_path / "masses.toml"), "argon", temperatures=[10.0, 300.0])
    values = [found.B2, found.error, found.dB2_dT, found.dB2_dT_error]
    np.testing.assert_array_equal(values, np.zeros((4, 2)))
    assert found.species == ("masses", "argon")
    assert found.samples < 1e6


def test_progress_rises_to_one():
    shown = []
    second_virial("ethane_trappe", temperatures=[500.0], error=0.3, progress=shown.append)
    assert len(shown) > virial.SETS  # more than one pass
    assert shown == sorted(shown)
    assert 0 < shown[0] < shown[-1] == 1


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
    for wrong in ([], [0.0], [-1.0], [300.0, np.nan], [np.inf], [1e300]):
        with pytest.raises(SceneError, match="temperatures must be above 0 K and at most"):
            second_virial("argon", temperatures=wrong)
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(SceneError, match="the requested error must be above 0"):
            second_virial("argon", temperatures=[300.0], error=wrong)
    for key in ("box.periodic", "seed", "molecules.0.count", "fields.gravity", "coupling.value"):
        with pytest.raises(SceneError, match=f"{key}: two molecules .* take keys of .forces. only"):
            second_virial("argon", temperatures=[300.0], settings={key: 1})
    slow = rigidmd.pair_potential("1/r**2")
    for name in ("argon", "nitrogen_trappe"):
        with pytest.raises(SimulationError, match=f"{name}-{name} does not converge.*cutoff_A"):
            second_virial(name, temperatures=[300.0], forces=[slow])


@pytest.mark.parametrize("coldest", [1e-300, 0.01, 0.1])
def test_temperatures_of_which_no_number_exists(coldest):
    """Alone, and next to one for which there is one."""
    for temperatures in ([coldest], [coldest, 300.0]):
        with pytest.raises((SceneError, SimulationError), match=r"repulsive core|range of numbers"):
            second_virial("argon", temperatures=temperatures)
    with pytest.raises((SceneError, SimulationError), match=r"repulsive core|range of numbers"):
        second_virial("ethane_trappe", temperatures=[coldest, 300.0], error=1.0)


def test_forces_that_are_not_of_pairs_are_refused():
    class Spring(rigidmd.Force):
        def on_molecules(self, state):
            return 0.5 * (state.position**2).sum(), -state.position

    with pytest.raises(SceneError, match=r"spring is not a potential of pairs.*pair_pot"):
        second_virial("argon", temperatures=[300.0], forces=[Spring()])


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
    assert "'300,cold' are not temperatures in K" in capsys.readouterr().err


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
