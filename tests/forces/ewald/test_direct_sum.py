"""Direct Ewald sums: published values of NIST, the slow oracle, k-vectors of described cells."""

import json

import numpy as np
import pytest
from support.common import observe, shaken, site, small_scene
from support.ewald import TIGHT_EWALD, charged_sites, oracle_of, salty
from support.reference import EwaldOracle

from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.errors import SceneError
from rigidmd.forces.ewald.direct_sum import ewald_sum_in_numpy
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.mechanics.rotation import from_vector
from rigidmd.run import Simulation
from rigidmd.scene import Scene
from rigidmd.scene.species import Box
from rigidmd.units import BOLTZMANN, COULOMB

BOXES = [
    {"lengths_A": [13.0, 12.5, 15.0]},
    {"lengths_A": [13.0, 14.0, 15.0], "angles_deg": [75.0, 100.0, 65.0]},
]


# --- published figures ----------------------------------------------------------------------------


def published(value, digits=6):
    """Whatever rounds to a figure printed with this many digits."""
    return pytest.approx(value, abs=0.501 * 10 ** (np.floor(np.log10(abs(value))) - digits + 1))


def nist_scene(file, cell, folder, box=None, **k_vectors):
    """A NIST configuration of SPC/E, molecules made whole, with NIST's settings."""
    rows = [line.split() for line in file.read_text().splitlines()]
    x = np.array([row[1:4] for row in rows if len(row) == 5], float).reshape(-1, 3, 3)
    x[:, 1:] -= np.round((x[:, 1:] - x[:, :1]) @ np.linalg.inv(cell)) @ cell
    rows = [
        f"{name} {a:.12f} {b:.12f} {c:.12f}"
        for m in x
        for name, (a, b, c) in zip("OHH", m, strict=True)
    ]
    lattice = " ".join(f"{edge:.15g}" for edge in np.ravel(cell))
    (folder / "water.xyz").write_text(
        "\n".join([str(len(rows)), f'Lattice="{lattice}"', *rows]) + "\n"
    )
    angle = np.radians(109.47)
    sites = [
        site("O", 15.9994, charge=-0.8476, sigma_A=3.16555789, epsilon_K=78.19743111, element="O"),
        site("H1", 1.008, [1.0, 0.0, 0.0], 0.4238, element="H"),
        site("H2", 1.008, [float(np.cos(angle)), float(np.sin(angle)), 0.0], 0.4238, element="H"),
    ]
    data = {
        "structure": {"file": "water.xyz"},
        "box": box or {},
        "molecules": [{"name": "water", "sites": sites}],
        "forces": {
            "cutoff_A": 10.0,
            "truncation": "plain",
            "tail_correction": True,
            "electrostatics": "ewald",
            **k_vectors,
        },
        "start": {"temperature_K": 0.0},
        "stages": [{"duration_ps": 1.0}],
    }
    return Scene.from_dict(data, folder)


# of components, in NIST's tables
NIST_NAMES = {
    "lennard_jones": "disp",
    "lennard_jones_tail": "LRC",
    "coulomb_real": "real",
    "coulomb_reciprocal": "fourier",
    "coulomb_self": "self",
    "coulomb_intramolecular": "intra",
}


def in_kelvin(components):
    """Energies over kB; NIST has CODATA 2010, ours differ in the eighth digit."""
    older = (
        1.602176565e-19**2
        / (4 * np.pi * 8.854187817e-12 * 1.3806488e-23)
        * 1e10
        / (COULOMB / BOLTZMANN)
    )
    assert set(components) == set(NIST_NAMES)
    return {
        name: energy / BOLTZMANN * (older if "coulomb" in name else 1)
        for name, energy in components.items()
    }


def check_nist_moments(seen, rotation, moments):
    """Virial tensor, force and torque on the first molecule."""
    tensor = np.array(moments["W_sym_K"])
    assert (seen.virial + seen.virial.T) / 2 / BOLTZMANN == pytest.approx(
        tensor, abs=3e-6 * np.abs(tensor).max()
    )
    force = seen.load.force[0] / BOLTZMANN
    torque = rotation @ seen.load.torque_body[0] / BOLTZMANN
    assert force == pytest.approx(
        np.array(moments["mol1_force_K_per_A"]), abs=1e-6 * np.abs(force).max()
    )
    assert torque == pytest.approx(
        np.array(moments["mol1_torque_K"]), abs=2e-4 * np.abs(torque).max()
    )


@pytest.mark.parametrize("config", [1, pytest.param(3, marks=pytest.mark.soak)])
def test_nist_spce_component_by_component(reference, config, tmp_path):
    table = json.loads((reference / "nist_spce_cuboid" / "REFERENCE.json").read_text())
    file = reference / "nist_spce_cuboid" / f"spce_sample_config_periodic{config}.txt"
    system = build(
        nist_scene(
            file,
            20 * np.eye(3),
            tmp_path,
            ewald_alpha_per_A=5.6 / 20,
            ewald_k_max=5,
            ewald_k2_max=26,
        )
    )
    seen = observe(system, system.engine(), system.state)
    found = in_kelvin(seen.components)
    figures = table["NIST_10A"][f"config{config}"]
    for name, printed in NIST_NAMES.items():
        assert found[name] == published(figures[f"E_{printed}"]), name
    assert sum(found.values()) == pytest.approx(
        figures["E_total"], rel=2e-5
    )  # NIST's erfc is good to 1e-7

    derived = table["DERIVED_by_this_hunt"]
    exact = derived["exact_erfc_10A"][f"config{config}"]
    for name, key in zip(
        NIST_NAMES, ("Elj", "Elrc", "Ereal", "Efour", "Eself", "Eintra"), strict=True
    ):
        assert found[name] == pytest.approx(exact[key], rel=2e-9), name
    moments = next(value for key, value in derived.items() if key.startswith("molecular_virial"))[
        f"config{config}"
    ]
    check_nist_moments(seen, system.state.rotation[0], moments)


def test_nist_spce_in_a_triclinic_cell(reference, tmp_path):
    folder = reference / "nist_spce_noncuboid"
    table = json.loads((folder / "REFERENCE.json").read_text())
    figures = table["NIST"]["triclinic_sample_periodic1"]
    cell = Box(lengths_A=figures["abc_A"][0], angles_deg=figures["alpha_beta_gamma_deg"]).cell
    radius = (
        2 * np.pi * 7 / np.diag(cell).min() * np.sqrt(1.00001)
    )  # k-vectors as REFERENCE.json states
    file = folder / "spce_triclinic_sample_periodic1.txt"
    system = build(
        nist_scene(
            file,
            cell,
            tmp_path,
            ewald_alpha_per_A=0.285,
            ewald_k_max=7,
            ewald_k_radius_per_A=radius,
        )
    )
    assert system.terms["coulomb_reciprocal"].k_vectors.total == 2 * 755
    seen = observe(system, system.engine(), system.state)
    found = in_kelvin(seen.components)
    for name, printed in NIST_NAMES.items():
        assert found[name] == published(figures[f"E_{printed}"]), name
    moments = table["DERIVED_by_this_hunt"]["molecular_virial_etc (NIST k set)"][
        "triclinic_sample_periodic1"
    ]
    check_nist_moments(seen, system.state.rotation[0], moments)


# NIST's table for 100 molecules, edges 36 Å, angles 90, 60, 90°: K
MONOCLINIC = {
    "lennard_jones": 2.50251e4,
    "lennard_jones_tail": -1.63091e2,
    "coulomb_real": -1.71462e5,
    "coulomb_reciprocal": 2.23372e4,
    "coulomb_self": -2.89549e6,
    "coulomb_intramolecular": 2.85884e6,
}


def test_nist_spce_in_a_monoclinic_cell_that_tilts_by_half_an_edge(reference, tmp_path):
    """What `rigidmd energy --unit K` prints, with k-vectors as in the triclinic case; 942 of them and
    their opposites."""
    file = reference / "nist_spce_noncuboid" / "spce_monoclinic_sample_periodic4.txt"
    if not file.is_file():
        pytest.skip(f"no {file}")
    box = {"lengths_A": 36.0, "angles_deg": [90.0, 60.0, 90.0]}
    cell = Box(**box).cell
    radius = 2 * np.pi * 7 / np.diag(cell).min() * np.sqrt(1.00001)
    scene = nist_scene(
        file,
        cell,
        tmp_path,
        box,
        ewald_alpha_per_A=0.285,
        ewald_k_max=7,
        ewald_k_radius_per_A=radius,
    )
    simulation = Simulation(scene)
    found = simulation._start_energy(BOLTZMANN, "K")
    assert any("1884 k-vectors" in note for note in found["notes"])
    assert set(found["components"]) == set(MONOCLINIC)
    for name, printed in MONOCLINIC.items():
        assert found["components"][name] == published(printed), name
    assert found["potential"] == published(-1.60912e5)


# --- the oracle -----------------------------------------------------------------------------------


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize(
    "limit", [{"ewald_k_max": [5, 4, 7]}, {"ewald_k_max": 6, "ewald_k2_max": 30}]
)
def test_ewald_is_the_oracle_term_by_term(limit, box):
    forces = {
        "cutoff_A": 6.0,
        "electrostatics": "ewald",
        "ewald_alpha_per_A": 0.4,
        "ewald_surface_permittivity": 4.0,
    }
    forces |= {"truncation": "plain"}
    scene = small_scene(
        {"tip4p2005": 8, "nitrogen": 3, "spce": 5}, None, box=box, forces=forces | limit
    )
    system, engine, state = shaken(build(scene), 4)
    most = np.array(limit["ewald_k_max"]) * np.ones(3)
    square = limit.get("ewald_k2_max", np.inf)
    oracle = oracle_of(
        system,
        state,
        0.4,
        6.0,
        lambda n: (np.abs(n) <= most).all(axis=1) & ((n**2).sum(axis=1) <= square),
    )
    found = observe(system, engine, state).components
    assert found["coulomb_real"] == pytest.approx(oracle.real, rel=1e-11)
    assert found["coulomb_reciprocal"] == pytest.approx(oracle.reciprocal, rel=1e-11)
    assert found["coulomb_self"] == pytest.approx(oracle.self, rel=1e-11)
    assert found["coulomb_intramolecular"] == pytest.approx(oracle.intramolecular, rel=1e-11)
    assert found["coulomb_surface"] == pytest.approx(oracle.surface(4.0), rel=1e-11)
    assert "coulomb_background" not in found


@pytest.mark.parametrize("angle", [60.0, 59.0])
@pytest.mark.parametrize(
    "limit",
    [
        {"ewald_k_max": [5, 4, 7]},
        {"ewald_k_max": [5, 7, 4], "ewald_k2_max": 30},
        {"ewald_k_max": [3, 7, 4], "ewald_k_radius_per_A": 0.8},
    ],
)
def test_k_vectors_are_those_of_the_cell_that_was_described(limit, angle):
    """36 cos 60° is 18.000000000000004, and 59° tilts by more than half an edge: another cell
    stands for it."""
    box = {"lengths_A": 36.0, "angles_deg": [90.0, angle, 90.0]}
    forces = {
        "cutoff_A": 10.0,
        "electrostatics": "ewald",
        "ewald_alpha_per_A": 0.285,
        "truncation": "plain",
    }
    system, engine, state = shaken(
        build(small_scene({"spce": 10}, None, box=box, forces=forces | limit)), 4
    )
    cell, most = Box(**box).cell, np.array(limit["ewald_k_max"])
    reciprocal = 2 * np.pi * np.linalg.inv(cell).T
    square, radius = limit.get("ewald_k2_max", np.inf), limit.get("ewald_k_radius_per_A", np.inf)

    def inside(n):
        short = (n**2).sum(axis=1) <= square
        return (
            (np.abs(n) <= most).all(axis=1)
            & short
            & (((n @ reciprocal) ** 2).sum(axis=1) <= radius**2)
        )

    x, q, owner = charged_sites(system, state)
    seen = observe(system, engine, state)
    assert seen.components["coulomb_reciprocal"] == pytest.approx(
        EwaldOracle(x, q, owner, cell, 0.285, 10.0, inside).reciprocal, rel=1e-11
    )
    described = any(
        "box: its lattice is given by" in note and "c' = c - a" in note for note in system.notes
    )
    assert described == (angle == 59.0)


def test_k_vectors_of_a_cell_that_a_file_describes_otherwise(tmp_path):
    """The cell of the file stands 2 Å high; rotated, it is a cube, and k-vectors are still the values of the
    file's cell."""
    cell = 14.0 * np.array([[1.0, 0, 0], [2.0, 1.0, 0], [2.0, 1.0, 1.0]])
    cell = cell @ from_vector(np.array([0.3, -0.5, 0.2])).T
    rows = "\n".join(
        f"{name} {x} {y} {z}" for name, x, y, z in (("Na", 1.0, 2.0, 3.0), ("Cl", 4.0, 9.5, 2.5))
    )
    lattice = " ".join(f"{edge:.15g}" for edge in np.ravel(cell))
    (tmp_path / "salt.xyz").write_text(f'2\nLattice="{lattice}"\n{rows}\n')
    ions = [
        {
            "name": name,
            "sites": [site(name, 30.0, charge=charge, element=name, sigma_A=2.0, epsilon_K=50.0)],
        }
        for name, charge in (("Na", 1.0), ("Cl", -1.0))
    ]
    data = {
        "structure": {"file": "salt.xyz"},
        "molecules": ions,
        "forces": {
            "cutoff_A": 6.0,
            "electrostatics": "ewald",
            "ewald_alpha_per_A": 0.4,
            "ewald_k_max": [4, 2, 3],
        },
        "start": {"temperature_K": 100.0},
        "stages": [{"duration_ps": 1.0}],
    }
    system = build(Scene.from_dict(data, tmp_path))
    assert cell_of(system.space) == pytest.approx(14.0 * np.eye(3))
    assert any("rotated, contents included" in note for note in system.notes)

    def inside(n):
        return (np.abs(n) <= (4, 2, 3)).all(axis=1)

    oracle = EwaldOracle([[1, 2, 3], [4, 9.5, 2.5]], [1, -1], [0, 1], cell, 0.4, 6.0, inside)
    found = observe(system, system.engine(), system.state).components
    assert found["coulomb_reciprocal"] == pytest.approx(oracle.reciprocal, rel=1e-9)
    data["forces"] = {"cutoff_A": 6.0, "electrostatics": "pme", "pme_grid": [16, 20, 24]}
    with pytest.raises(
        SceneError,
        match=r"pme_grid = \[16, 20, 24\] refers to the edges .*edges 14.0000, 14.0000, 14.0000 Å",
    ):
        build(Scene.from_dict(data, tmp_path))
    data["forces"]["pme_grid"] = [20, 20, 20]
    assert any("grid 20 x 20 x 20" in note for note in build(Scene.from_dict(data, tmp_path)).notes)


def test_a_cell_described_again_is_reported_by_every_command(tmp_path, capsys):
    (tmp_path / "triclinic.toml").write_text("""
[box]
lengths_A = 36
angles_deg = [90, 59, 90]
[[molecules]]
model = "spce"
count = 5
[forces]
pme_order = 6
[start]
temperature_K = 100
[[stages]]
duration_ps = 0.004
""")
    told = (
        "its lattice is given by the cell with edges 36.0000, 36.0000, 35.4545 Å, angles 90, 119.5, 90°, "
        "c' = c - a, in place of edges 36.0000, 36.0000, 36.0000 Å, angles 90, 59, 90°"
    )
    scene = str(tmp_path / "triclinic.toml")
    for arguments in (
        ["check"],
        ["energy"],
        ["energy", "--json"],
        ["run", "-o", str(tmp_path / "out")],
    ):
        assert main([arguments[0], scene, *arguments[1:]]) == 0
        out = " ".join(capsys.readouterr().out.split())  # lines of check are wrapped
        assert told in (out if "--json" not in arguments else "".join(json.loads(out)["notes"]))
    assert told in (tmp_path / "out" / "summary.json").read_text()


def test_the_reciprocal_sum_without_compiled_code():
    system, engine, state = salty(TIGHT_EWALD)
    engine.evaluate(state)
    term, own = system.terms["coulomb_reciprocal"], engine.workspaces["coulomb_reciprocal"].sums
    energy, force, virial = ewald_sum_in_numpy(
        term.charge, own.position, cell_of(system.space), term.smooth.alpha, term.k_vectors
    )
    assert energy == pytest.approx(own.tallies[:, 0].sum(), rel=1e-11)
    assert force == pytest.approx(own.force, abs=1e-11 * np.abs(force).max())
    assert virial.ravel() == pytest.approx(
        own.tallies[:, 1:].sum(axis=0), rel=1e-9, abs=1e-9 * abs(energy)
    )
