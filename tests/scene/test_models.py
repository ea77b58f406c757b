"""The models that come along: published geometry, dipoles and inertia, parameters in the units of their papers."""

import json
import re

import numpy as np
import pytest
from support.common import small_scene

from rigidmd.assemble.build import build
from rigidmd.errors import MoleculeError, SceneError
from rigidmd.formats.bonds import bonds
from rigidmd.scene import Scene
from rigidmd.scene.models import (
    GROUPS,
    Site,
    available_models,
    load_model,
    molecule,
    read_molecule,
    with_masses,
)
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

ALL = available_models()
DEBYE = 4.80320471  # D in e Å
#: B in cm⁻¹ times I in u Å²: h / (8 pi² c), CODATA 2018.
ROTATIONAL = 16.857629


# name: kind, degrees of freedom, mass u, dipole D and what it may differ by (the digits of its
# source), lengths Å, angles. Dipoles are the values of the models' papers, or of Vega & Abascal
# 2011, Phys. Chem. Chem. Phys. 13, 19663 (water), and where no paper is available computed by the
# formula next to it.
OH, HOH = ("OW", "HW1"), ("HW1", "OW", "HW2")
MODEL_TABLE = {
    "spc": ("asymmetric", 6, 18.0154, (2.27, 6e-3), {OH: 1.0}, {HOH: 109.47}),
    "spce": ("asymmetric", 6, 18.0154, (2.351, 1e-3), {OH: 1.0}, {HOH: 109.47}),
    "tip3p": ("asymmetric", 6, 18.0154, (2.347, 1e-3), {OH: 0.9572}, {HOH: 104.52}),
    "tip3pew": (
        "asymmetric",
        6,
        18.0154,
        (2.347 * 0.415 / 0.417, 1e-3),
        {OH: 0.9572},
        {HOH: 104.52},
    ),
    "tip4p": (
        "asymmetric",
        6,
        18.0154,
        (2.177, 1e-3),
        {OH: 0.9572, ("OW", "MW"): 0.15},
        {HOH: 104.52},
    ),
    "tip4pew": (
        "asymmetric",
        6,
        18.0154,
        (2.321, 1e-3),
        {OH: 0.9572, ("OW", "MW"): 0.125},
        {HOH: 104.52},
    ),
    "tip4p2005": (
        "asymmetric",
        6,
        18.0154,
        (2.305, 1e-3),
        {OH: 0.9572, ("OW", "MW"): 0.1546},
        {HOH: 104.52},
    ),
    "tip4pice": (
        "asymmetric",
        6,
        18.0154,
        (2.426, 1e-3),
        {OH: 0.9572, ("OW", "MW"): 0.1577},
        {HOH: 104.52},
    ),
    # charges, lengths and the angle give 2.4345 D
    "tip4peps": (
        "asymmetric",
        6,
        18.0154,
        (2 * 0.527 * (0.9572 * np.cos(np.radians(52.26)) - 0.105) * DEBYE, 1e-6),
        {OH: 0.9572, ("OW", "MW"): 0.105},
        {HOH: 104.52},
    ),
    "tip5p": (
        "asymmetric",
        6,
        18.0154,
        (2.29, 5e-3),
        {OH: 0.9572, ("OW", "LP1"): 0.7, ("OW", "LP2"): 0.7},
        {HOH: 104.52, ("LP1", "OW", "LP2"): 109.47},
    ),
    "opc": (
        "asymmetric",
        6,
        18.0154,
        (2.48, 5e-3),
        {OH: 0.8724, ("OW", "MW"): 0.1594},
        {HOH: 103.6},
    ),
    "opc3": (
        "asymmetric",
        6,
        18.0154,
        (2.43, 5e-3),
        {OH: 0.97888, ("HW1", "HW2"): 1.598507},
        {HOH: 109.47},
    ),
    "nitrogen": ("linear", 5, 28.0134, (0.0, 1e-9), {("N1", "N2"): 1.09}, {}),
    "nitrogen_trappe": (
        "linear",
        5,
        28.0134,
        (0.0, 1e-9),
        {("N1", "N2"): 1.1, ("N1", "M"): 0.55},
        {},
    ),
    "nitrogen_2cljq": ("linear", 5, 28.0134, (0.0, 1e-9), {("N1", "N2"): 1.0464}, {}),
    "oxygen_trappe": ("linear", 5, 31.9988, (0.0, 1e-9), {("O1", "O2"): 1.21}, {}),
    "oxygen_2cljq": ("linear", 5, 31.9988, (0.0, 1e-9), {("O1", "O2"): 0.9699}, {}),
    "co2_trappe": (
        "linear",
        5,
        44.0098,
        (0.0, 1e-9),
        {("C", "O1"): 1.16},
        {("O1", "C", "O2"): 180.0},
    ),
    "co2_epm2": (
        "linear",
        5,
        44.0098,
        (0.0, 1e-9),
        {("C", "O1"): 1.149},
        {("O1", "C", "O2"): 180.0},
    ),
    "co2_2cljq": ("linear", 5, 44.0098, (0.0, 1e-9), {("CO1", "CO2"): 2.4176}, {}),
    "ethane_trappe": ("linear", 5, 30.07, (0.0, 1e-9), {("C1", "C2"): 1.54}, {}),
    "ethane_2cljq": ("linear", 5, 30.07, (0.0, 1e-9), {("C1", "C2"): 2.3762}, {}),
    "ethylene_trappe": ("linear", 5, 28.054, (0.0, 1e-9), {("C1", "C2"): 1.33}, {}),
    "ethylene_2cljq": ("linear", 5, 28.054, (0.0, 1e-9), {("C1", "C2"): 1.2695}, {}),
    "acetylene_2cljq": ("linear", 5, 26.038, (0.0, 1e-9), {("C1", "C2"): 1.2998}, {}),
    # three charges at the height of the hydrogens below nitrogen, less M: 3 q (h - 0.08), h² =
    # 1.012² (1 - 4/3 sin²(t/2))
    "ammonia_trappe": (
        "symmetric",
        6,
        17.0307,
        (1.23 * (1.012 * np.sqrt(1 - 4 / 3 * np.sin(np.radians(53.35)) ** 2) - 0.08) * DEBYE, 1e-6),
        {("N", "H1"): 1.012, ("N", "M"): 0.08},
        {("H1", "N", "H2"): 106.7, ("H2", "N", "H3"): 106.7},
    ),
    # 2 0.235 1.336 cos(46.035°)
    "h2s_opls": (
        "asymmetric",
        6,
        34.076,
        (0.47 * 1.336 * np.cos(np.radians(46.035)) * DEBYE, 1e-6),
        {("S", "H1"): 1.336},
        {("H1", "S", "H2"): 92.07},
    ),
    "so2": (
        "asymmetric",
        6,
        64.0588,
        (1.998, 5e-4),
        {("S", "O1"): 1.4782},
        {("O1", "S", "O2"): 119.82},
    ),
    "methane_trappe": ("point", 3, 16.043, (0.0, 1e-9), {}, {}),
    "methane_opls": (
        "spherical",
        6,
        16.043,
        (0.0, 1e-9),
        {("C", "H1"): 1.09},
        {("H1", "C", "H3"): 109.4712},
    ),
    "benzene_opls": (
        "symmetric",
        6,
        78.114,
        (0.0, 1e-9),
        {("C1", "C2"): 1.4, ("C4", "H4"): 1.08},
        {("C1", "C2", "C3"): 120.0, ("C1", "C2", "H2"): 120.0},
    ),
    "benzene_trappe": (
        "symmetric",
        6,
        78.114,
        (0.0, 1e-9),
        {("C1", "C2"): 1.392, ("C4", "H4"): 1.08},
        {("C1", "C2", "C3"): 120.0, ("C1", "C2", "H2"): 120.0},
    ),
    # 0.725 0.917 - 1.45 0.166
    "hf_jorgensen": (
        "linear",
        5,
        20.006,
        ((0.725 * 0.917 - 1.45 * 0.166) * DEBYE, 1e-6),
        {("F", "H"): 0.917, ("F", "M"): 0.166},
        {},
    ),
    "methanol_trappe": (
        "asymmetric",
        6,
        32.0424,
        (2.22, 5e-3),
        {("CH3", "O"): 1.43, ("O", "H"): 0.945},
        {("CH3", "O", "H"): 108.5},
    ),
    "acetonitrile_opls": (
        "linear",
        5,
        41.0527,
        (3.44, 5e-3),
        {("CH3", "C"): 1.458, ("C", "N"): 1.157},
        {},
    ),
    # 0.269 1.54 + 0.398 1.157
    "acetonitrile_trappe": (
        "linear",
        5,
        41.0527,
        ((0.269 * 1.54 + 0.398 * 1.157) * DEBYE, 1e-6),
        {("CH3", "C"): 1.54, ("C", "N"): 1.157},
        {},
    ),
    "ccl4": (
        "spherical",
        6,
        153.823,
        (0.0, 1e-9),
        {("C", "CL1"): 2.0438},
        {("CL1", "C", "CL2"): 109.4712},
    ),
    "argon": ("point", 3, 39.948, (0.0, 1e-9), {}, {}),
    "neon": ("point", 3, 20.1797, (0.0, 1e-9), {}, {}),
    "krypton": ("point", 3, 83.798, (0.0, 1e-9), {}, {}),
    "xenon": ("point", 3, 131.293, (0.0, 1e-9), {}, {}),
}


# Rmin/2 in Å and epsilon in kcal/mol of Joung & Cheatham 2008; masses of IUPAC.
IONS = {
    "spce": {
        "li": (0.791, 0.3367344),
        "na": (1.212, 0.3526418),
        "k": (1.593, 0.4297054),
        "rb": (1.737, 0.4451036),
        "cs": (2.021, 0.0898565),
        "f": (2.257, 0.0074005),
        "cl": (2.711, 0.0127850),
        "br": (2.751, 0.0269586),
        "i": (2.919, 0.0427845),
    },
    "tip4pew": {
        "li": (0.808, 0.1039884),
        "na": (1.226, 0.1684375),
        "k": (1.590, 0.2794651),
        "rb": (1.709, 0.4331494),
        "cs": (1.888, 0.3944318),
        "f": (2.538, 0.0015752),
        "cl": (2.760, 0.0116615),
        "br": (2.768, 0.0303773),
        "i": (2.952, 0.0417082),
    },
}
MASSES = {
    "li": 6.94,
    "na": 22.98977,
    "k": 39.0983,
    "rb": 85.4678,
    "cs": 132.90545,
    "f": 18.998403,
    "cl": 35.453,
    "br": 79.904,
    "i": 126.90447,
}


def at(m, name):
    return m.positions_body[m.site_names.index(name)]


def angle(m, a, corner, b):
    u, v = at(m, a) - at(m, corner), at(m, b) - at(m, corner)
    return np.degrees(np.arccos(np.clip(u @ v / np.linalg.norm(u) / np.linalg.norm(v), -1, 1)))


def epsilon(m, name="", unit=KJ_PER_MOL):
    return m.epsilon[m.site_names.index(name) if name else 0] / unit


def test_every_model_is_in_a_table_here():
    ions = {f"{ion}_{water}" for water, table in IONS.items() for ion in table}
    assert {*MODEL_TABLE, *ions} == set(ALL)


def test_a_file_states_what_it_is_and_who_made_it():
    for name in ALL:
        m = load_model(name)
        assert m.name == name
        assert m.title, name
        assert m.group in GROUPS[:-1], name
        # a source has a year, a journal and a page
        assert re.search(r"\b(19|20)\d\d, .*\d", m.source), name
        assert m.residue_names, name
        assert m.charge == {"ion": round(m.charge)}.get(m.group, 0), name


@pytest.mark.parametrize("name", MODEL_TABLE)
def test_geometry_mass_and_dipole_are_the_published_ones(name):
    kind, freedom, mass, (dipole, within), lengths, angles = MODEL_TABLE[name]
    m = load_model(name)
    assert (m.kind, m.degrees_of_freedom) == (kind, freedom)
    assert m.planar == (name.startswith("benzene") or (kind == "asymmetric" and name != "tip5p"))
    assert m.mass == pytest.approx(mass, abs=2e-4)
    assert m.dipole_debye == pytest.approx(dipole, abs=within)
    for (a, b), length in lengths.items():
        assert np.linalg.norm(at(m, a) - at(m, b)) == pytest.approx(length, abs=6e-5), (a, b)
    for (a, corner, b), degrees in angles.items():
        assert angle(m, a, corner, b) == pytest.approx(
            degrees, abs=2e-2 if name in ("so2",) else 6e-3
        ), (a, corner, b)


@pytest.mark.parametrize("name", [n for n in MODEL_TABLE if load_model(n).group == "water"])
def test_the_inertia_of_water(name):
    """In the plane, by hand: two hydrogens at a distance 2 x, all of them y from the oxygen."""
    m = load_model(name)
    r, half = np.linalg.norm(at(m, "OW") - at(m, "HW1")), np.radians(angle(m, *HOH)) / 2
    x, y, hydrogens, oxygen = r * np.sin(half), r * np.cos(half), 2 * 1.008, 15.9994
    across, along = hydrogens * x**2, hydrogens * oxygen / (hydrogens + oxygen) * y**2
    assert m.inertia == pytest.approx(sorted([along, across, along + across]), rel=1e-9)


@pytest.mark.parametrize(
    (
        "name",
        "constants",
    ),  # cm⁻¹ of the real molecule in its ground state, Huber & Herzberg 1979 and Herzberg 1966
    [
        ("nitrogen_trappe", [1.9896]),
        ("oxygen_trappe", [1.4377]),
        ("co2_trappe", [0.39022]),
        ("co2_epm2", [0.39022]),
        ("ammonia_trappe", [9.9443]),
        ("methane_opls", [5.2412]),
        ("benzene_opls", [0.18977]),
        ("benzene_trappe", [0.18977]),
        ("hf_jorgensen", [20.5597]),
        ("h2s_opls", [10.36, 9.016, 4.734]),
        ("tip3p", [27.88, 14.51, 9.285]),
    ],
)
def test_the_inertia_of_real_molecules(name, constants):
    """A model that keeps the shape of its molecule rotates as it does, within the 3 % that vibration
    is worth (of water's plane, whose moments do not add up in the ground state)."""
    m = load_model(name)
    found = ROTATIONAL / m.inertia[m.inertia > 0][: len(constants)]
    assert found == pytest.approx(constants, rel=3e-2)


@pytest.mark.parametrize(
    ("name", "quadrupole"),  # D Å: Vrabec, Stoll & Hasse 2001; with the signs of experiment
    [
        ("nitrogen_2cljq", -1.4397),
        ("oxygen_2cljq", -0.8081),
        ("co2_2cljq", -3.7938),
        ("ethane_2cljq", -0.8277),
        ("ethylene_2cljq", 4.331),
        ("acetylene_2cljq", 5.073),
        ("so2", -5.334),
    ],
)
def test_charges_in_place_of_a_quadrupole(name, quadrupole):
    m = load_model(name)
    if name == "so2":
        row = [i for i, site in enumerate(m.site_names) if site.startswith("Q")]
        x, q = m.positions_body[row], m.charges[row]
        assert q.sum() == pytest.approx(0, abs=1e-12)
        centred = x - x.mean(axis=0)
        found = np.sum(q * (1.5 * centred[:, 0] ** 2 - 0.5 * np.sum(centred**2, axis=1))) * DEBYE
    else:
        found = m.quadrupole_debye_A[0, 0]
        assert np.trace(m.quadrupole_debye_A) == pytest.approx(0, abs=1e-9)
    assert found == pytest.approx(quadrupole, abs=2e-4)


@pytest.mark.parametrize(
    ("turn", "within"), [("T", 0.006), ("side by side", 0.04), ("slipped", 0.017)]
)
def test_how_well_charges_stand_for_a_quadrupole(turn, within):
    """What the files state: energies of two at 4 Å against those of point quadrupoles (Gray & Gubbins
    1984)."""
    m = load_model("acetylene_2cljq")
    row = np.flatnonzero(m.charges)
    along, q = m.positions_body[row, 0], m.charges[row]
    x, z = np.eye(3)[0], np.eye(3)[2]
    one, other = {"T": (z, x), "side by side": (x, x), "slipped": ((x + z) / 2**0.5,) * 2}[turn]
    distance = 4.0
    a, b = along[:, None] * one, along[:, None] * other + distance * z
    energy = np.sum(q[:, None] * q / np.linalg.norm(a[:, None] - b, axis=2))
    c1, c2, c12 = one @ z, other @ z, one @ other
    ideal = 1 - 5 * (c1**2 + c2**2) - 15 * c1**2 * c2**2 + 2 * (5 * c1 * c2 - c12) ** 2
    ideal *= 0.75 * (5.073 / DEBYE) ** 2 / distance**5
    assert abs(energy / ideal - 1) == pytest.approx(within, rel=0.1)


@pytest.mark.parametrize(
    ("water", "ion"), [(water, ion) for water, table in IONS.items() for ion in table]
)
def test_ions(water, ion):
    m = load_model(f"{ion}_{water}")
    half, depth = IONS[water][ion]
    assert m.sigma[0] == pytest.approx(2 ** (5 / 6) * half, rel=1e-8)
    assert epsilon(m) == pytest.approx(4.184 * depth, rel=1e-9)
    assert m.charge == (-1 if ion in ("f", "cl", "br", "i") else 1)
    assert m.mass == MASSES[ion]
    assert (m.kind, m.degrees_of_freedom) == ("point", 3)


def test_lennard_jones_parameters_in_the_units_of_their_papers():
    spc = load_model("spc")  # A = 0.37122 nm (kJ/mol)^(1/6), B = 0.3428 nm (kJ/mol)^(1/12)
    assert (4 * epsilon(spc) * (spc.sigma[0] / 10) ** 6) ** (1 / 6) == pytest.approx(
        0.37122, rel=1e-6
    )
    assert (4 * epsilon(spc) * (spc.sigma[0] / 10) ** 12) ** (1 / 12) == pytest.approx(
        0.3428, rel=1e-6
    )
    tip4p = load_model("tip4p")  # 600,000 and 610 kcal/mol
    assert 4 * epsilon(tip4p) / 4.184 * tip4p.sigma[0] ** 12 == pytest.approx(600e3, rel=1e-3)
    assert 4 * epsilon(tip4p) / 4.184 * tip4p.sigma[0] ** 6 == pytest.approx(610, rel=1e-3)
    for name, site, sigma, kelvin in [
        ("tip4p2005", "OW", 3.1589, 93.2),
        ("tip4pice", "OW", 3.1668, 106.1),
        ("tip4peps", "OW", 3.165, 93.0),
        ("co2_trappe", "C", 2.8, 27.0),
        ("co2_trappe", "O1", 3.05, 79.0),
        ("co2_epm2", "C", 2.757, 28.129),
        ("co2_epm2", "O1", 3.033, 80.507),
        ("methanol_trappe", "CH3", 3.75, 98.0),
        ("methanol_trappe", "O", 3.02, 93.0),
        ("ammonia_trappe", "N", 3.42, 185.0),
        ("ccl4", "CL1", 3.25, 212.6),
        ("xenon", "XE", 3.9011, 227.55),
        ("benzene_trappe", "C1", 3.6, 30.7),
        ("benzene_trappe", "H1", 2.36, 25.45),
        ("hf_jorgensen", "F", 2.984, 75.75),
    ]:
        m = load_model(name)
        assert m.sigma[m.site_names.index(site)] == sigma
        assert epsilon(m, site, BOLTZMANN) == pytest.approx(kelvin, rel=1e-12)
    for name, site, kilojoules in [  # oplsaa.ff of GROMACS, which prints kJ/mol
        ("benzene_opls", "C1", 0.29288),
        ("benzene_opls", "H1", 0.12552),
        ("methane_opls", "C", 0.276144),
        ("acetonitrile_opls", "CH3", 0.866088),
        ("acetonitrile_opls", "N", 0.71128),
        ("h2s_opls", "S", 1.046),
        ("tip5p", "OW", 0.66944),
        ("tip4pew", "OW", 0.680946),
        ("opc", "OW", 0.8903586),
    ]:
        assert epsilon(load_model(name), site) == pytest.approx(kilojoules, rel=1e-6)


def test_lone_pairs_are_where_gromacs_builds_them():
    """oplsaa.ff/tip5p.itp: x_L = x_O + a (r_1 + r_2) ± c (r_1 x r_2), a = -0.344908, c =
    6.4437903493 / nm."""
    m = load_model("tip5p")
    first, second = at(m, "HW1") - at(m, "OW"), at(m, "HW2") - at(m, "OW")
    across = 0.64437903493 * np.cross(first, second)
    built = [at(m, "OW") - 0.344908 * (first + second) + sign * across for sign in (1, -1)]
    pairs = [at(m, "LP1"), at(m, "LP2")]
    if np.linalg.norm(built[0] - pairs[0]) > 0.1:
        pairs.reverse()
    assert np.array(built) == pytest.approx(np.array(pairs), abs=2e-5)


def test_heavy_water():
    light, heavy = load_model("spce"), with_masses(load_model("spce"), {"H": 2.014})
    assert heavy.mass == pytest.approx(15.9994 + 2 * 2.014)
    assert heavy.dipole_debye == pytest.approx(light.dipole_debye, rel=1e-12)
    x, y = np.sin(np.radians(109.47 / 2)), np.cos(np.radians(109.47 / 2))
    across, along = 2 * 2.014 * x**2, 2 * 2.014 * 15.9994 / heavy.mass * y**2
    assert heavy.inertia == pytest.approx(sorted([along, across, along + across]), rel=1e-9)
    assert (heavy.title, heavy.source, heavy.group) == (light.title, light.source, light.group)
    half = with_masses(light, {"H": 2.014, "HW1": 1.008})  # a name states more than an element
    assert half.mass == pytest.approx(15.9994 + 2.014 + 1.008)
    assert (heavy.charges == light.charges).all()


def test_isotopes_in_a_scene(tmp_path, capsys):
    data = small_scene({"tip4p2005": 27}, 12.0, forces={"cutoff_A": 5.0}).model_dump(
        exclude_none=True
    )
    data["molecules"] = [data["molecules"][0] | {"masses_u": {"H": 2.014, "OW": 17.999}}]
    assert build(Scene.from_dict(data)).species[0].mass == pytest.approx(17.999 + 2 * 2.014)
    data["molecules"] = [data["molecules"][0] | {"masses_u": {"MW": 1.0, "D": 2.0}}]
    with pytest.raises(SceneError, match="massless") as caught:
        build(Scene.from_dict(data))
    assert "masses_u.D is not a site or element of it; there are O, H, X, OW" in str(caught.value)
    data["molecules"] = [data["molecules"][0] | {"masses_u": {"H": 0.0}}]
    with pytest.raises(SceneError, match="greater than 0"):
        Scene.from_dict(data)


def test_bonds_are_those_of_chemistry_and_join_everything():
    def named(name):
        m = load_model(name)
        return {frozenset((m.site_names[i], m.site_names[j])) for i, j in bonds(m)}

    assert named("tip4p2005") == {
        frozenset(p) for p in (("OW", "HW1"), ("OW", "HW2"), ("OW", "MW"))
    }
    assert len(named("benzene_opls")) == 12
    assert named("so2") >= {frozenset(("S", "O1")), frozenset(("S", "O2"))}
    assert frozenset(("O1", "O2")) not in named("so2")
    assert named("ethane_2cljq") >= {frozenset(("C1", "C2"))}  # further from each other than a bond
    assert len(named("ccl4")) == 4
    assert named("argon") == set()


def test_the_schema_knows_the_new_keys(printed):
    keys = json.loads(printed("schema").out)["$defs"]["Molecules"]["properties"]
    assert {"parameters", "masses_u"} <= set(keys)


def test_a_model_that_is_not_there():
    with pytest.raises(MoleculeError, match="unknown model 'ice'"):
        load_model("ice")


def test_a_molecule_file_with_a_text_without_quotes(tmp_path):
    (tmp_path / "mine.toml").write_text("name = mine\n")
    with pytest.raises(MoleculeError, match=r"mine.toml: line 1: name: is mine without quotes"):
        read_molecule(tmp_path / "mine.toml")


@pytest.mark.parametrize(
    ("sites", "expected"),
    [
        ([(1.0, (0, 0, 0)), (1.0, (0, 0, 0)), (1.0, (1, 0, 0))], "coincide"),
        ([(0.0, (0, 0, 0)), (0.0, (1, 0, 0))], "massless"),
        ([(1.0, (0, 0, 0)), (0.0, (1, 0, 0))], "nothing resists its torque"),
        (
            [(1.0, (0, 0, 0)), (1.0, (0, 0, 1)), (0.0, (0.3, 0, 0.5))],
            "off the axis of a linear body",
        ),
    ],
)
def test_sites_that_make_no_body(sites, expected):
    with pytest.raises(MoleculeError, match=expected):
        molecule(
            "x",
            tuple(
                Site(name=f"A{k}", mass_u=m, position_A=tuple(map(float, x)))
                for k, (m, x) in enumerate(sites)
            ),
        )
