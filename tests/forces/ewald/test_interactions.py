"""Ewald sums and PME of a scene: lattice energies, gradients, virials, settings."""

import json
from functools import partial

import numpy as np
import pytest
from support.common import bits_with, built, observe, shaken, site, small_scene
from support.ewald import SALT, TIGHT_EWALD, TIGHT_PME, coulomb, oracle_of, salty
from support.reference import KE
from support.slopes import energy_of, force_on, torque_on, trace_of_virial, virial_of

from rigidmd.assemble.build import build
from rigidmd.compile.machine import MOST_THREADS
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.errors import SceneError
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.run.kind import describe
from rigidmd.scene import Scene
from rigidmd.units import COULOMB, KJ_PER_MOL

# --- published figures ----------------------------------------------------------------------------


@pytest.mark.parametrize("method", [pytest.param("ewald", marks=pytest.mark.soak), "pme"])
def test_ions_in_a_triclinic_cell(reference, method, tmp_path):
    """Energy and forces of OpenMM's test, which has them from GROMACS: Lennard-Jones cut at 10
    Å."""
    given = json.loads((reference / "openmm" / "REFERENCE.json").read_text())["triclinic_8_ions"]
    (tmp_path / "ions.gro").write_bytes((reference / "openmm" / "triclinic.gro").read_bytes())
    ions = [
        {
            "name": name,
            "residue_names": [name.upper(), name],
            "sites": [
                site(
                    name,
                    mass,
                    charge=charge,
                    element=name,
                    sigma_A=10 * given["LJ"][name][0],
                    epsilon_kJ_mol=given["LJ"][name][1],
                )
            ],
        }
        for name, mass, charge in (("Cl", 35.45, -1.0), ("Na", 22.99, 1.0))
    ]
    data = {
        "structure": {"file": "ions.gro"},
        "molecules": ions,
        "forces": {
            "cutoff_A": 10.0,
            "truncation": "plain",
            "electrostatics": method,
            "ewald_accuracy": 1e-8,
            "tail_correction": False,
        },
        "start": {"temperature_K": 100.0},
        "stages": [{"duration_ps": 1.0}],
    }
    system = build(Scene.from_dict(data, tmp_path))
    assert cell_of(system.space) == pytest.approx(10 * np.array(given["box_nm"]))
    seen = observe(system, system.engine(), system.state)
    assert sum(seen.components.values()) / KJ_PER_MOL == pytest.approx(
        given["DERIVED_converged"]["no_LRC"], rel=1e-6
    )
    forces = 10 * seen.load.force / KJ_PER_MOL
    assert forces == pytest.approx(
        np.array(given["forces_kJ_mol_nm"]), abs=given["force_rtol"] * np.abs(forces).max()
    )


@pytest.mark.parametrize(
    ("method", "asked", "error"),
    [pytest.param("ewald", 1e-10, 1e-9, marks=pytest.mark.soak), ("pme", 1e-8, 1e-7)],
)
def test_madelung_constant_of_rock_salt(reference, method, asked, error, tmp_path):
    lines = (reference / "openmm" / "nacl_crystal.xyz").read_text().splitlines()[2:]
    rows = [(line.split()[0], *(10 * float(x) for x in line.split()[1:4])) for line in lines]
    text = [
        str(len(rows)),
        'Lattice="28.2 0 0 0 28.2 0 0 0 28.2"',
        *(" ".join(map(str, row)) for row in rows),
    ]
    (tmp_path / "salt.xyz").write_text("\n".join(text) + "\n")
    ions = [
        {
            "name": name,
            "sites": [site(name, mass, charge=charge, element=name, sigma_A=1.0, epsilon_K=1e-9)],
        }
        for name, mass, charge in (("Na", 22.99, 1.0), ("Cl", 35.45, -1.0))
    ]
    data = {
        "structure": {"file": "salt.xyz"},
        "molecules": ions,
        "forces": {"cutoff_A": 12.0, "electrostatics": method, "ewald_accuracy": asked},
        "start": {"temperature_K": 100.0},
        "stages": [{"duration_ps": 1.0}],
    }
    system = build(Scene.from_dict(data, tmp_path))
    seen = observe(system, system.engine(), system.state)
    madelung = -coulomb(seen.components) / (COULOMB / 2.82 * 500)
    assert madelung == pytest.approx(1.7475645946331822, rel=error)
    given = json.loads((reference / "openmm" / "REFERENCE.json").read_text())["nacl_crystal"][
        "E_kJ_mol"
    ]
    assert coulomb(seen.components) / KJ_PER_MOL == pytest.approx(given, rel=1e-6)
    assert np.abs(seen.load.force).max() < 100 * error * COULOMB / 2.82**2


# --- the oracle -----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [pytest.param(TIGHT_EWALD, marks=pytest.mark.soak), TIGHT_PME])
def test_total_does_not_depend_on_how_it_is_split(method):
    """A charged box with everything in it; the oracle at another alpha."""
    system, engine, state = salty(method)
    oracle = oracle_of(system, state, 1.0, 6.4)
    found = observe(system, engine, state).components
    assert found["coulomb_background"] == pytest.approx(
        -np.pi / (2 * 2730 * 0.81) * 36 * KE, rel=1e-10
    )
    assert coulomb(found) == pytest.approx(
        oracle.total, rel=1e-9 if method is TIGHT_EWALD else 1e-6
    )


# --- gradients ------------------------------------------------------------------------------------


def surrounded(method, surface, angles):
    """A scene with a permittivity around all images, or with images of a slab across z removed."""
    if surface == "z":
        molecules, box = [SALT[1]], {"lengths_A": [10.0, 10.5, 7.0], "vacuum_A": 8.0}
        forces = method | {"ewald_slab": "z", "cutoff_A": 4.9, "ewald_alpha_per_A": 1.2}
        return small_scene({}, None, molecules=molecules, box=box, forces=forces)
    molecules = [SALT[1]] if surface < np.inf else SALT
    box = {"lengths_A": [13.5, 14.0, 15.0], "angles_deg": [angles] * 3}
    forces = method | {"ewald_surface_permittivity": surface}
    return small_scene({}, None, molecules=molecules, box=box, forces=forces)


@pytest.mark.parametrize("method", [TIGHT_EWALD, TIGHT_PME])
@pytest.mark.parametrize(
    ("surface", "angles"), [(np.inf, 90.0), (2.0, 90.0), ("z", 90.0), (np.inf, 80.0)]
)
def test_forces_and_torques_are_the_gradient(method, surface, angles):
    scene = surrounded(method, surface, angles)
    system, engine, state = shaken(build(scene), 8)
    engine = Engine(
        system.model,
        {name: term for name, term in system.terms.items() if name.startswith("coulomb")},
    )
    load, _ = engine.evaluate(state)
    scale = np.abs(load.force).max()
    energy, h = partial(energy_of, engine), 1e-3
    for m in range(0, len(state.position), 4):
        force, torque = force_on(m, energy, state, h), torque_on(m, energy, state, h)
        assert load.force[m] == pytest.approx(force, abs=1e-7 * scale)
        assert load.torque_body[m] == pytest.approx(torque, abs=1e-7 * scale)


@pytest.mark.parametrize(
    ("method", "surface", "angles"),
    [
        (TIGHT_EWALD, np.inf, 90.0),
        (TIGHT_EWALD, 2.0, 90.0),
        (TIGHT_PME, np.inf, 90.0),
        (TIGHT_PME, 2.0, 90.0),
        (TIGHT_EWALD, np.inf, 80.0),
        (TIGHT_PME, np.inf, 80.0),
        (TIGHT_EWALD, "z", 90.0),
        (TIGHT_PME, "z", 90.0),
    ],
)
def test_virial_is_the_slope_of_the_energy_with_the_volume(method, surface, angles):
    """Along each edge by itself with Ewald. On a grid only all together: the best influence
    function is not strained."""
    scene = surrounded(method, surface, angles)
    system, _, state = shaken(build(scene), 9)
    terms = {name: term for name, term in system.terms.items() if name.startswith("coulomb")}
    virial = sum(tally.virial for tally in Engine(system.model, terms).evaluate(state)[1].values())
    h = 1e-4

    def energy(moved):
        return energy_of(Engine(system.model, terms), moved)

    scale = np.abs(virial).max()
    assert virial.trace() == pytest.approx(trace_of_virial(energy, state, h), abs=1e-7 * scale)
    if method is TIGHT_EWALD:
        for k in range(3):
            slope = virial_of(energy, state, h, (k, k))
            assert virial[k, k] == pytest.approx(slope, abs=1e-7 * scale)


# --- accuracy -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("precision", "method"),
    [
        ("double", "pme"),
        ("double", "ewald"),
        pytest.param("mixed", "pme", marks=pytest.mark.soak),
        pytest.param("mixed", "ewald", marks=pytest.mark.soak),
    ],
)
def test_same_bits_for_any_number_of_threads(method, precision):
    if MOST_THREADS < 2:
        pytest.skip("one core")
    forces = {"cutoff_A": 9.0, "electrostatics": method, "ewald_accuracy": 1e-4, "skin_A": 0.3}
    system, _, state = built({"spce": 400}, 22.9, 7, forces=forces, precision=precision)
    assert bits_with(1, system, state) == bits_with(2, system, state)


# --- input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("forces", "words"),
    [
        (
            {"ewald_accuracy": 1e-3},
            "ewald_accuracy would have no effect with electrostatics = 'reaction_field'",
        ),
        (
            {"electrostatics": "pme", "ewald_k_max": 5},
            "ewald_k_max would have no effect with electrostatics = 'pme'",
        ),
        ({"electrostatics": "ewald", "pme_order": 4}, "pme_order would have no effect"),
        ({"electrostatics": "pme", "damping_per_A": 0.1}, "damping_per_A would have no effect"),
        (
            {"electrostatics": "ewald", "reaction_field_permittivity": 80.0},
            "reaction_field_permittivity would have no effect",
        ),
        (
            {"ewald_truncation": "plain"},
            "ewald_truncation would have no effect with electrostatics = 'reaction_field'",
        ),
        (
            {"electrostatics": "damped_shifted_force", "ewald_truncation": "shift"},
            "ewald_truncation would have no effect",
        ),
        (
            {"electrostatics": "pme", "ewald_truncation": "switch"},
            "ewald_truncation: is 'switch', must be 'plain' or 'shift'",
        ),
        ({"electrostatics": "ewald", "ewald_k2_max": 9}, "ewald_k2_max needs ewald_k_max"),
        (
            {
                "electrostatics": "ewald",
                "ewald_k_max": 9,
                "ewald_k2_max": 9,
                "ewald_k_radius_per_A": 1.0,
            },
            "not both",
        ),
        (
            {"electrostatics": "ewald", "ewald_k_radius_per_A": 1e3},
            "more than 1000 k-vectors along an edge",
        ),
        ({"electrostatics": "ewald", "ewald_k_radius_per_A": 1e-3}, "leaves no k-vector"),
        (
            {
                "electrostatics": "ewald",
                "ewald_k_max": 9,
                "ewald_alpha_per_A": 0.3,
                "ewald_accuracy": 1e-4,
            },
            "ewald_accuracy would have no effect: alpha",
        ),
        ({"electrostatics": "pme", "pme_order": 9}, "pme_order: is 9, must not be more than 8"),
        (
            {"electrostatics": "pme", "pme_grid": [4, 8, 8]},
            "pme_grid.0: is 4, must not be less than 8",
        ),
        (
            {"electrostatics": "ewald", "ewald_alpha_per_A": 2.0},
            "far below rounding. At most 1.33 is of use",
        ),
        (
            {"electrostatics": "damped_shifted_force", "damping_per_A": 2.0},
            "At most 1.33 is of use",
        ),
        (
            {
                "electrostatics": "pme",
                "pme_grid": [8, 8, 8],
                "pme_order": 4,
                "ewald_accuracy": 1e-6,
            },
            None,
        ),
        (
            {"electrostatics": "pme", "pme_grid": [8, 8, 8], "ewald_accuracy": 1e-6},
            "cannot be reached with the given forces.pme_order or",
        ),
    ],
)
def test_settings_that_make_no_sense(forces, words):
    data = {"cutoff_A": 6.0} | forces
    if words is None:
        build(small_scene({"spce": 20}, 13.0, forces=data))
        return
    with pytest.raises(SceneError) as error:
        build(small_scene({"spce": 20}, 13.0, forces=data))
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ("ewald", "needs a periodic box; use coulomb"),
        ("pme", "needs a periodic box; use coulomb"),
        ("damped_shifted_force", "needs a cutoff. Give forces.cutoff_A"),
    ],
)
def test_what_needs_a_box_or_a_cutoff_is_reported(method, words):
    with pytest.raises(SceneError, match=words):
        build(small_scene({"spce": 3}, None, forces={"electrostatics": method}))


def test_a_charged_box_is_reported_and_has_no_dipole():
    system, _, _ = salty(TIGHT_EWALD)
    assert any("net charge of +6 e" in note for note in system.notes)
    with pytest.raises(SceneError, match="the dipole of a box with a net charge is not defined"):
        salty(TIGHT_EWALD, ewald_surface_permittivity=2.0)


def test_check_states_how_and_what_is_left_out():
    water = {"cutoff_A": 6.0, "electrostatics": "pme", "ewald_accuracy": 1e-4}
    text = describe(small_scene({"spce": 20}, 13.0, forces=water))
    assert "splines of order" in text and "estimated rms error of the force on a site" in text
    scene = small_scene({"spce": 20}, 13.0, forces=water | {"electrostatics": "ewald"})
    text = describe(scene, verbose=True)
    assert "k-vectors, |n| up to" in text and "Fourier transforms: electrostatics is ewald" in text
    assert "Fourier transforms: electrostatics is reaction_field" in describe(
        small_scene({"spce": 20}, 18.1), verbose=True
    )
