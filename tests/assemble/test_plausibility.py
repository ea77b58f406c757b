"""Numbers in another unit are given with the likely cause; shipped models and scenes give no
warning."""

import json
import re

import numpy as np
import pytest
from support.common import MOLECULES, ROOT, small_scene
from support.scenes import GOOD
from support.schema_scenes import FIELDS, IONS

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.assemble.plausibility import molecule_warnings
from rigidmd.errors import SceneError
from rigidmd.run.kind import describe
from rigidmd.scene import Scene
from rigidmd.scene.models import available_models, load_model

ARGON = {
    "name": "Ar",
    "element": "Ar",
    "mass_u": 39.948,
    "position_A": [0.0, 0.0, 0.0],
    "sigma_A": 3.4,
    "epsilon_kJ_mol": 1.0,
}
OXYGEN = {
    "name": "O",
    "element": "O",
    "mass_u": 15.999,
    "position_A": [0.0, 0.0, 0.0],
    "sigma_A": 3.2,
    "epsilon_kJ_mol": 0.65,
}
HYDROGEN = {
    "name": "H",
    "element": "H",
    "mass_u": 1.008,
    "position_A": [0.9572, 0.0, 0.0],
    "charge_e": 0.4,
}


def of_sites(*sites, count=2, edge=30.0, **tables):
    molecules = [{"name": "mine", "count": count, "sites": list(sites)}]
    forces = {"cutoff_A": 10.0, "electrostatics": "none"}
    return small_scene({}, edge, molecules=molecules, **{"forces": forces} | tables)


@pytest.mark.parametrize(
    ("sites", "cause"),
    [
        ([OXYGEN | {"mass_u": 1.6}, HYDROGEN], "mass_u of O is 1.6 u, and O has 16 u"),
        ([OXYGEN, HYDROGEN | {"mass_u": 10.08}], "mass_u of H is 10.08 u, and H has 1.008 u"),
        (
            [OXYGEN, HYDROGEN | {"position_A": [0.09572, 0.0, 0.0]}],
            "0.09572 Å, below 0.5: are the positions in nm?",
        ),
        (
            [OXYGEN, HYDROGEN | {"position_A": [95.72, 0.0, 0.0]}],
            "95.72 Å, above 15: are the positions in pm?",
        ),
        ([ARGON | {"sigma_A": 0.34}], "largest sigma_A is 0.34 Å, below 0.9: is it in nm?"),
        (
            [ARGON | {"epsilon_kJ_mol": 996.0}],
            "well depth is 996 kJ/mol, above 40: is it in J/mol or in K?",
        ),
        ([ARGON | {"epsilon_kJ_mol": 119.8}], "is it in J/mol or in K?"),
        (
            [OXYGEN | {"charge_e": -0.4}, HYDROGEN | {"charge_e": 6.4e-20}],
            "charge_e of H is 6.4e-20 e",
        ),
        (
            [OXYGEN | {"element": "X", "mass_u": 2.7e-26}],
            "mass_u of O is 2.7e-26 u, below 0.1: is it in kg or g?",
        ),
    ],
)
def test_a_model_in_another_unit(sites, cause):
    edge = 400.0 if "pm" in cause else 30.0
    warnings = build(of_sites(*sites, edge=edge)).warnings
    assert any(cause in warning for warning in warnings), warnings


@pytest.mark.parametrize(
    "site",
    [
        ARGON,
        OXYGEN | {"mass_u": 17.007},
        HYDROGEN | {"mass_u": 2.014},
        HYDROGEN | {"mass_u": 3.024},
        ARGON | {"element": "C", "mass_u": 16.043},
        ARGON | {"element": "C", "mass_u": 14.027},
        ARGON | {"element": "Li", "mass_u": 6.015},
    ],
)
def test_isotopes_and_united_atoms_are_what_they_are(site):
    assert build(of_sites(site)).warnings == []


def test_no_shipped_model_is_suspected():
    warnings = {name: molecule_warnings(load_model(name)) for name in available_models()}
    assert not any(warnings.values()), warnings


@pytest.mark.parametrize("path", MOLECULES, ids=lambda path: path.stem)
def test_no_shipped_scene_is_suspected(path):
    assert build(Scene.read(path)).warnings == []


BODIES = sorted({*(ROOT / "systems").glob("*.toml")} - {*MOLECULES})


@pytest.mark.parametrize("path", BODIES, ids=lambda path: path.stem)
def test_no_shipped_body_is_suspected(path, printed):
    assert printed("check", path).err == ""


NPT = {"ensemble": "npt", "temperature_K": 90.0, "duration_ps": 0.01}


@pytest.mark.parametrize(
    ("tables", "cause"),
    [
        ({"stages": [NPT | {"pressure_bar": 101325.0}]}, "1 atm is 101325 Pa, or 1.01325 bar"),
        ({"stages": [NPT | {"pressure_bar": 1e5}]}, "1 atm is 101325 Pa"),
        (
            {"stages": [NPT | {"pressure_bar": 2e6}]},
            "stages.0.pressure_bar is 2e+06 bar, above 50000: is it in Pa?",
        ),
        (
            {"fields": {"gravity_m_s2": [0.0, 0.0, 9.81]}},
            "points up, along +z: should it be [0, 0, -9.81]?",
        ),
        (
            {"fields": {"gravity_m_s2": [0.0, 0.0, -981.0]}},
            "is 981 m/s², above 500: is it in cm/s²?",
        ),
        (
            {"fields": {"electric_V_per_nm": [0.0, 1e8, 0.0]}},
            "fields.electric_V_per_nm is 1e+08 V/nm",
        ),
    ],
)
def test_a_scene_in_another_unit(tables, cause):
    charged = [
        ARGON | {"charge_e": 1.0},
        ARGON | {"name": "Cl", "charge_e": -1.0, "position_A": [2.5, 0.0, 0.0]},
    ]
    edge = None if "gravity_m_s2" in tables.get("fields", {}) else 30.0  # what falls needs no box
    warnings = build(of_sites(*charged, edge=edge, **tables)).warnings
    assert any(cause in warning for warning in warnings), warnings


def test_water_at_25_kelvin():
    stages = [{"ensemble": "nvt", "temperature_K": 25.0, "duration_ps": 0.01}]
    assert "is it in °C?" in build(small_scene({"spce": 20}, 20.0, stages=stages)).warnings[0]
    stages[0]["temperature_K"] = 298.0
    assert build(small_scene({"spce": 20}, 20.0, stages=stages)).warnings == []


@pytest.mark.parametrize("cutoff", [1e-3, 0.9])
def test_a_cutoff_within_the_molecules_is_refused(cutoff):
    with pytest.raises(SceneError, match=r"forces.cutoff_A is .* touch at 3.8\d Å"):
        build(small_scene({"argon": 20}, 25.0, forces={"cutoff_A": cutoff}))
    with pytest.raises(SceneError, match=r"forces.cutoff_A is 10 Å, .* touch at"):
        build(of_sites(ARGON | {"sigma_A": 1e6}))


PAIRS = {"name": "lj", "energy": "4*e*((s/r)**12 - (s/r)**6)", "parameters": {"e": 1.0, "s": 3.4}}
ROD = {
    "name": "rod",
    "count": 20,
    "sites": [{"name": f"A{z}", "mass_u": 20.0, "position_A": [0, 0, z]} for z in (-1.0, 1.0)],
}
SPHERES = {"energy": "(4/r)**12*(1 + 0.1*a_b)"}


@pytest.mark.parametrize("length", [0.01, 0.5, 1.2])
@pytest.mark.parametrize(
    ("forces", "key"),
    [
        ({"truncation": "switch"}, "forces.switch_start_A"),
        ({"truncation": "force_switch", "tail_correction": False}, "forces.switch_start_A"),
        ({"electrostatics": "pme"}, "forces.ewald_cutoff_A"),
        ({"custom": [PAIRS]}, "forces.custom.0.cutoff_A"),
        ({"custom": [PAIRS | {"truncation": "switch"}]}, "forces.custom.0.switch_start_A"),
        ({"bodies": [SPHERES]}, "forces.bodies.0.cutoff_A"),
        ({"bodies": [SPHERES]}, "forces.bodies.0.switch_start_A"),
        (
            {"bodies": [{"potential": "dipole", "parameters": {"water": {"dipole_D": 1.0}}}]},
            "forces.bodies.0.options.reaction_field_A",
        ),
    ],
)
def test_lengths_of_forces_within_the_molecules_are_refused(forces, key, length):
    """Where Lennard-Jones sites touch at 3.6 Å, each key alone; `is it in nm?` if that helps."""
    *tables, name = key.removeprefix("forces.").split(".")
    forces = json.loads(json.dumps({"cutoff_A": 9.0} | forces))
    table = forces
    for part in tables:
        table = table[int(part)] if part.isdigit() else table.setdefault(part, {})
    table[name] = length
    molecules = [{"model": "spce", "name": "water", "count": 60}]
    with pytest.raises(SceneError) as refused:
        build(small_scene({"spce": 60}, 20.0, forces=forces, molecules=molecules))
    assert f"{key} is {length:g} Å, and the sites of two molecules touch at 3.55 Å" in str(
        refused.value
    )
    assert ("is it in nm?" in str(refused.value)) == (length > 0.4)


@pytest.mark.parametrize("key", ["cutoff_A", "switch_start_A"])
@pytest.mark.parametrize("kind", ["custom", "bodies"])
def test_lengths_within_the_cores_of_a_users_potential_are_refused(kind, key):
    """Without Lennard-Jones sites: bodies touch where the potential rises."""
    entry = SPHERES if kind == "bodies" else PAIRS | {"truncation": "switch"}
    for length, contact in ((0.9, "touch at "), (6.0, "")):
        forces = {"cutoff_A": 9.0, "lennard_jones": False, kind: [entry | {key: length}]}
        scene = small_scene({"spce": 1}, 24.0, forces=forces, molecules=[ROD])
        if contact:
            with pytest.raises(SceneError, match=f"{key} is 0.9 Å, and its .* {contact}.* in nm?"):
                build(scene)
        else:
            build(scene)


def test_potentials_without_a_core_have_cutoffs_of_any_length():
    soft = {"name": "soft", "energy": "25*(1 - r/1.2)**2", "cutoff_A": 1.2}
    like = {"name": "like", "energy": "1389/r", "cutoff_A": 9.0, "truncation": "shift"}
    for entry in (soft, like):
        forces = {"lennard_jones": False, "custom": [entry]}
        build(small_scene({"spce": 1}, 24.0, forces=forces, molecules=[ROD]))


def test_a_switch_that_begins_within_the_molecules_has_no_tail_correction():
    """Its integral would be one over overlaps."""
    for start, has_tail in ((2.5, False), (3.2, True)):
        forces = {"cutoff_A": 8.0, "truncation": "switch", "switch_start_A": start}
        scene = small_scene({"argon": 100}, 18.0, forces=forces | {"tail_correction": None})
        system = build(scene)
        assert (system.tail is not None) == has_tail
        assert ("the switch begins where molecules" in " ".join(system.left_out)) != has_tail
    forces |= {"switch_start_A": 2.5, "tail_correction": True}
    with pytest.raises(SceneError, match="tail_correction needs a switch that begins near"):
        build(small_scene({"argon": 100}, 18.0, forces=forces))


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (FIELDS, "forces.cutoff_A"),
        (IONS, "forces.ewald_cutoff_A"),
        (IONS, "forces.custom.0.cutoff_A"),
        (FIELDS, "fields.walls.0.cutoff_A"),
    ],
)
def test_a_cutoff_whose_reciprocal_overflows_in_single_precision_is_refused(text, key, tmp_path):
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(SceneError, match=f"{key}: is 1e-30, must not be less than 0.001"):
        Scene.read(tmp_path / "scene.toml", {key: 1e-30})


def test_a_cutoff_below_contact_has_no_tail_correction():
    """Its integral would be one over overlaps."""
    for cutoff, has_tail in ((3.0, False), (4.0, True)):
        forces = {"cutoff_A": cutoff, "tail_correction": None}
        system = build(small_scene({"argon": 100}, 18.0, forces=forces))
        assert (system.tail is not None) == has_tail
        assert ("molecules touch beyond the cutoff" in " ".join(system.left_out)) != has_tail
    with pytest.raises(SceneError, match="tail_correction needs a cutoff beyond the contact"):
        build(small_scene({"argon": 100}, 18.0, forces={"cutoff_A": 3.0, "tail_correction": True}))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        (
            {"start.euler_angles_deg": [0.0, 0.52, 0.0]},
            "are these radians? They would be [0, 29.79, 0]°",
        ),
        (
            {"start.euler_angles_deg": [1.5708, 0.7854, 0.0]},
            "are these radians? They would be [90, 45, 0]°",
        ),
        ({"gravity.acceleration_m_s2": [0.0, 0.0, 9.81]}, "points up, along +z"),
        (
            {"run.timestep_s": 0.05, "run.integrator": "velocity_verlet"},
            "timestep_s = 0.05 is inaccurate",
        ),
    ],
)
def test_a_body_in_another_unit(override, words, printed):
    words_of = [word for key, value in override.items() for word in ("--set", f"{key}={value}")]
    assert words in printed("check", ROOT / "systems" / "heavy_top_3.toml", *words_of).err


@pytest.mark.parametrize("angles", [[0.0, 0.1, 0.0], [0.0, 3.0, 1.0], [0.0, 59.16, 90.0]])
def test_small_angles_are_not_suspected(angles, printed):
    top = ROOT / "systems" / "heavy_top_3.toml"
    assert printed("check", top, "--set", f"start.euler_angles_deg={angles}").err == ""


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (10, "timestep_fs = 10 is inaccurate for spce at 300 K"),
        (0.002, "times shorter than velocity_verlet needs for spce, 11.7 fs: is it in ps?"),
        (2, ""),
        (0.1, ""),
    ],
)
def test_check_warns_of_steps_by_their_accuracy(step, words, tmp_path, printed):
    (tmp_path / "s.toml").write_text(GOOD.replace("timestep_fs = 1", f"timestep_fs = {step}"))
    told = printed("check", tmp_path / "s.toml").err
    assert words in told if words else told == ""


@pytest.mark.parametrize(("step", "words"), [(10.0, "is inaccurate for spce at 300 K"), (2.0, "")])
def test_a_run_notes_inaccurate_steps(step, words):
    stages = [
        {"ensemble": "nvt", "temperature_K": 300.0, "timestep_fs": step, "duration_ps": 2e-3 * step}
    ]
    scene = small_scene(
        {"spce": 20},
        30.0,
        stages=stages,
        forces={"cutoff_A": 6.0, "electrostatics": "reaction_field"},
    )
    notes = rigidmd.Simulation(scene, warn=str).run().summary["notes"]
    assert (
        any(words in note for note in notes)
        if words
        else not any("timestep" in note for note in notes)
    )


@pytest.mark.parametrize(
    ("step", "words"), [(0.05, "timestep_s = 0.05 is inaccurate"), (0.002, "")]
)
def test_a_run_of_a_body_notes_inaccurate_steps(step, words):
    changes = {
        "run.timestep_s": step,
        "run.integrator": "velocity_verlet",
        "run.duration_s": 2 * step,
    }
    scene = rigidmd.Scene.read(
        ROOT / "systems" / "heavy_top_3.toml", changes | {"output.interval_s": step}
    )
    notes = rigidmd.Simulation(scene, warn=str).run().summary["notes"]
    assert (
        any(words in note for note in notes)
        if words
        else not any("timestep" in note for note in notes)
    )


@pytest.mark.parametrize(("sigma", "warns"), [(0.34, True), (3.4, False)])
def test_a_shown_model_is_compared_with_usual_units(sigma, warns, tmp_path, printed):
    path = tmp_path / "mine.toml"
    site = f'name = "Ar"\nmass_u = 39.948\nsigma_A = {sigma}\nepsilon_kJ_mol = 1.0\nposition_A = [0, 0, 0]\n'
    path.write_text(f'name = "mine"\n[[sites]]\n{site}')
    shown = printed("models", path)
    assert ("is it in nm?" in shown.err) == warns
    assert "mine" in shown.out


def test_a_run_repeats_the_warnings_of_check(tmp_path):
    stages = [{"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 0.004}]
    site = ARGON | {"mass_u": 4.0}
    scene = of_sites(site, count=20, edge=25.0, stages=stages)
    told = []
    results = rigidmd.Simulation(scene, warn=told.append).run()
    [expected] = [warning for warning in build(scene).warnings]
    assert expected in told and expected in results.summary["notes"]
    assert np.isfinite(results["potential"]).all()


MIE = {"energy": "4*e*((s/r)**14 - (s/r)**7)", "parameters": {"AR": {"e": 1.0, "s": 3.4}}}
SCREENED = {"energy": "a*exp(-r/2)/r", "parameters": {"AR": {"a": 5.0}}}


@pytest.mark.parametrize(
    ("counts", "cutoff", "entry", "words"),
    [
        ({"spce": 20}, 3.0, None, "3 Å is shorter than 3.55 Å"),
        ({"spce": 20}, 3.54, None, ""),  # WCA, rounded
        ({"spce": 20}, 7.0, None, ""),
        ({"argon": 10, "ccl4": 5}, 3.7, None, "shorter than 3.82 Å, where the energy of argon.AR"),
        ({"argon": 20}, 3.0, MIE, "mie: .* 3 Å is shorter than 3.7"),
        ({"argon": 20}, 3.9, MIE, ""),
        ({"argon": 20}, 3.0, SCREENED, ""),  # repels everywhere
    ],
)
def test_a_cutoff_within_the_minimum_of_an_energy_is_noted(counts, cutoff, entry, words):
    forces = {"cutoff_A": cutoff}
    if entry:
        forces = {
            "cutoff_A": 8.0,
            "lennard_jones": False,
            "custom": [entry | {"name": "mie", "cutoff_A": cutoff}],
        }
    scene = small_scene(counts, 20.0, forces=forces)
    found = [note for note in build(scene).notes if "has its minimum" in note]
    assert len(found) == bool(words) and all(re.search(words, note) for note in found)
    assert all(note in " ".join(describe(scene, verbose=True).split()) for note in found)
