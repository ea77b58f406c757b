"""A crystal as a frozen framework: its sites and charges, insertion into it, a published Henry
constant, what is refused."""

import re
from unittest.mock import ANY

import numpy as np
import pytest
from support.common import ROOT, small_scene

from rigidmd import Simulation
from rigidmd.assemble.build import build
from rigidmd.assemble.species import species_of
from rigidmd.commands.cli import main
from rigidmd.errors import InputError, OutputError, SceneError
from rigidmd.features.analysis.registry import known
from rigidmd.features.analysis.rigid_frames import frames_of_start
from rigidmd.features.free_energy.guest import Guest, model_named
from rigidmd.mechanics.rotation import random_rotations

insertion = known()["insertion"].function
CIF = """data_x
_cell_length_a 7.0
_cell_length_b 8.0
_cell_length_c 9.0
_cell_angle_alpha 85
_cell_angle_beta 95
_cell_angle_gamma 100
_space_group_name_H-M_alt 'P -1'
loop_
_atom_site_label
_atom_site_type_symbol
_atom_site_fract_x
_atom_site_fract_y
_atom_site_fract_z
_atom_site_charge
Si1 Si 0.10 0.20 0.30 1.2
O1  O  0.30 0.15 0.35 -0.7
O2  O  0.60 0.70 0.20 -0.5
"""
SITES = [
    {"name": "Si", "mass_u": 28.1, "sigma_A": 2.3, "epsilon_K": 22.0},
    {"name": "O", "mass_u": 16.0, "sigma_A": 3.3, "epsilon_K": 53.0},
]
REPEAT = [2, 2, 2]


def scene_in(tmp_path, text=CIF, repeat=REPEAT, sites=SITES, more=(), frozen=True, **changes):
    """A scene with a framework, and other molecules."""
    (tmp_path / "a.cif").write_text(text)
    framework = {"name": "wall", "file": "a.cif", "repeat": repeat, "frozen": frozen}
    forces = {"cutoff_A": 6.0, "electrostatics": "reaction_field"}
    molecules = [*more, framework | {"sites": sites}]
    sections = {"molecules": molecules, "box": {}, "forces": forces} | changes
    return small_scene({}, 1.0, tmp_path, **sections)


def atoms_of(tmp_path, charge):
    """The same atoms as frozen bodies of one site, read as a structure of three species."""
    text = re.sub("^(Si1|O1|O2) +[SO]i?", r"\1 .", CIF, flags=re.MULTILINE)
    (tmp_path / "b.cif").write_text(text)
    molecules = [
        {"name": name, "frozen": True}
        | {
            "sites": [
                SITES[name != "Si1"] | {"name": name, "position_A": [0, 0, 0]} | {"charge_e": q}
            ]
        }
        for name, q in charge.items()
    ]
    forces = {"cutoff_A": 6.0, "electrostatics": "reaction_field"}
    structure = {"file": "b.cif", "repeat": REPEAT}
    sections = {"molecules": molecules, "structure": structure, "box": {}, "forces": forces}
    return small_scene({}, 1.0, tmp_path, **sections)


def energies_in(system, model, count=100):
    """Energies of trial molecules at random positions."""
    rng = np.random.default_rng(5)
    position, rotation = rng.random((count, 3)) @ system.state.cell, random_rotations(rng, count)
    return Guest(system, model_named(model), 300.0).energies(system.state, position, rotation)


@pytest.mark.parametrize(
    ("model", "method"),
    [("co2_trappe", "reaction_field"), ("argon", "reaction_field"), ("na_spce", "pme")],
)
def test_a_framework_acts_as_its_atoms_do(tmp_path, model, method):
    """Also on a point that has energies by the engine: the framework keeps its rotation."""
    scene = scene_in(tmp_path, forces={"cutoff_A": 6.0, "electrostatics": method})
    whole, one_by_one = build(scene), atoms_of(tmp_path, {"Si1": 1.2, "O1": -0.7, "O2": -0.5})
    resolved = {"forces": whole.scene.forces}  # of the framework, such as the grid of PME
    atoms = build(one_by_one.model_copy(update=resolved))
    np.testing.assert_allclose(whole.state.cell, atoms.state.cell)
    one, other = energies_in(whole, model), energies_in(atoms, model)
    assert np.isfinite(one).sum() > 10
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-8)


def test_charges_of_the_scene_replace_those_of_the_file(tmp_path):
    charged = [site | {"charge_e": q} for site, q in zip(SITES, (2.0, -1.0), strict=True)]
    (wall,) = build(scene_in(tmp_path, sites=charged)).species
    assert sorted(set(wall.charges)) == [-1.0, 2.0]
    labels = [*SITES, SITES[1] | {"name": "O2", "charge_e": -0.4}]
    (wall,) = build(scene_in(tmp_path, sites=labels)).species
    assert sorted(set(wall.charges)) == [-0.7, -0.4, 1.2]


def test_molecules_move_in_a_framework_at_rest(tmp_path):
    guests = [{"model": "neon", "count": 4}]
    stages = [{"ensemble": "nvt", "temperature_K": 100.0, "duration_ps": 0.2}]
    scene = scene_in(tmp_path, more=guests, stages=stages)
    start, state = build(scene).state, Simulation(scene).run().state
    assert (state.position[4] == start.position[4]).all()
    assert (state.position[:4] != start.position[:4]).all()


def test_a_published_henry_constant(capsys, monkeypatch):
    """FEASST 0.6.0, tutorial 7_henry: 1.7017e-4 mol/(kg Pa) and 33.7794 kJ/mol."""
    monkeypatch.chdir(ROOT / "systems")
    assert main(["analyse", "lta.toml", "insertion", "model=ethane", "trials=3000"]) == 0
    found = re.findall(r"(\d[\d.e-]*) ± ([\d.]+)", capsys.readouterr().out)
    (_, _), (henry, error), (heat, heat_error) = [tuple(map(float, pair)) for pair in found]
    assert abs(henry - 1.7017e-4) < 3 * error < 4e-5
    assert abs(heat - 33.779) < 3 * heat_error < 1.0


def test_another_temperature(tmp_path):
    def henry(kelvin, **options):
        stages = [{"ensemble": "nvt", "temperature_K": kelvin, "duration_ps": 1.0}]
        frames = frames_of_start(scene_in(tmp_path, stages=stages, start={}), 20)
        found = insertion(frames, "argon", trials=100, zero_loading=True, **options)
        return [value.value for value in found.values]

    assert henry(300.0, temperature=350.0) == henry(350.0)
    assert henry(300.0) != henry(350.0)
    with pytest.raises(OutputError, match="zero_loading"):
        insertion(frames_of_start(scene_in(tmp_path), 20), "argon", temperature=350.0)


def test_forces_may_name_the_sites_of_the_inserted_model(tmp_path):
    """The parameters of the mixing rule, by name, and others."""
    forces = {"cutoff_A": 6.0, "electrostatics": "none"}

    def energies(pairs):
        scene = scene_in(tmp_path, forces=forces | {"pairs": pairs})
        system = frames_of_start(scene, 2, "methane_trappe").system
        assert len(system.state.position) == 1
        return energies_in(system, "methane_trappe")

    def pair(epsilon):
        return [{"sites": ["O", "CH4"], "sigma_A": 3.5, "epsilon_kJ_mol": epsilon}]

    none, weak, strong = energies([]), energies(pair(0.5)), energies(pair(2.0))
    assert not np.allclose(none[np.isfinite(none)][:5], weak[np.isfinite(none)][:5])
    fits = np.isfinite(weak) & np.isfinite(strong)
    silent = energies(pair(0.0))[fits]
    np.testing.assert_allclose(strong[fits] - silent, 4 * (weak[fits] - silent), rtol=1e-9)
    with pytest.raises(SceneError, match="no site is 'CH4'"):
        build(scene_in(tmp_path, forces=forces | {"pairs": pair(0.5)}))


def test_long_labels_are_named_by_their_first_five_characters(tmp_path):
    text = CIF.replace("O1  O", "O_bridge O").replace("O2  O", "O_term O")
    bridge, term = (
        SITES[1] | {"name": n, "charge_e": q} for n, q in (("O_bri", -0.9), ("O_ter", -0.3))
    )
    (wall,) = build(scene_in(tmp_path, text, sites=[SITES[0], bridge, term])).species
    of_name = dict(zip(wall.site_names, wall.charges.tolist(), strict=True))
    assert of_name == {"Si1": 1.2, "O_bri": -0.9, "O_ter": -0.3}
    with pytest.raises(InputError, match="first five characters"):
        scene_in(tmp_path, text, sites=[SITES[0], bridge | {"name": "O_bridge"}, term])


REFUSED = {
    "no entry of sites": {"sites": SITES[:1]},
    "occupied only partly": {
        "text": CIF.replace("_charge\n", "_occupancy\n").replace("1.2", "1").replace("-0.", "0.")
    },
    r"Use repeat = \[2, 2, 2\], or": {"repeat": [1, 1, 1]},
    r"repeat = \[2, 2, 2\]": {"repeat": [2, 1, 2]},
    "set frozen = true": {"frozen": False},
    "is the box: omit": {"box": {"lengths_A": 20.0}},
    "must not have more than": {"repeat": [20, 20, 20]},
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_is_refused(tmp_path, message):
    with pytest.raises(InputError, match=message):
        build(scene_in(tmp_path, **REFUSED[message]))


def test_what_needs_a_run_is_refused(tmp_path, capsys):
    scene = scene_in(tmp_path)
    with pytest.raises(SceneError, match="Insertion needs no run"):
        Simulation(scene)
    with pytest.raises(OutputError, match="needs a molecule"):
        insertion(frames_of_start(scene, 20), zero_loading=True)
    path = str(ROOT / "systems" / "lta.toml")
    assert main(["analyse", path]) == 2
    assert "only insertion needs no run" in capsys.readouterr().err
    assert main(["analyse", path, "insertion", "trial=3"]) == 2
    assert "unknown option" in capsys.readouterr().err


def in_capitals(form: str, first: str, second: str, formula: str = "") -> str:
    """Two atoms of these symbols in a cube of 12 Å."""
    points = [(1.2, 1.2, 1.2), (3.6, 4.8, 6.0)]
    rows = list(zip((first, second), points, strict=True))
    if form == "xyz":
        body = "".join(f"{e} {x} {y} {z}\n" for e, (x, y, z) in rows)
        return f'2\nLattice="12 0 0 0 12 0 0 0 12" Properties=species:S:1:pos:R:3\n{body}'
    if form == "pdb":
        return "CRYST1   12.000   12.000   12.000  90.00  90.00  90.00 P 1\n" + "".join(
            f"HETATM{k:5d} {e:>4} FRM A   1    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00{e:>12}\n"
            for k, (e, (x, y, z)) in enumerate(rows, 1)
        )
    if form == "lammpstrj":
        body = "".join(f"{k} {e} {x} {y} {z}\n" for k, (e, (x, y, z)) in enumerate(rows, 1))
        head = "ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n2\nITEM: BOX BOUNDS pp pp pp\n"
        return head + "0 12\n" * 3 + "ITEM: ATOMS id element x y z\n" + body
    dot = "." if form == "mmcif" else "_"
    tags = [f"_cell{dot}length_{x} 12" for x in "abc"]
    tags += [f"_cell{dot}angle_{x} 90" for x in ("alpha", "beta", "gamma")]
    if form == "mmcif":
        columns = "id type_symbol label_atom_id label_comp_id Cartn_x Cartn_y Cartn_z"
        body = [f"{k} {e} {e} FRM {x} {y} {z}" for k, (e, (x, y, z)) in enumerate(rows, 1)]
    else:
        columns = "label type_symbol fract_x fract_y fract_z"
        body = [
            f"{e}{k} {e} {x / 12:.6f} {y / 12:.6f} {z / 12:.6f}"
            for k, (e, (x, y, z)) in enumerate(rows, 1)
        ]
        tags += [f"_chemical_formula_sum '{formula}'"] * bool(formula)
        tags += ["loop_", "_symmetry_equiv_pos_as_xyz", "x,y,z"]
    return "\n".join(
        ["data_x", *tags, "loop_", *(f"_atom_site{dot}{c}" for c in columns.split()), *body, ""]
    )


def elements_in(tmp_path, form, text, *names):
    """The elements of a framework with entries of these names, and the notes on its file."""
    name = f"f.{form}"
    (tmp_path / name).write_text(text)
    sites = [{"name": name, "sigma_A": 2.5, "epsilon_K": 20.0} for name in names]
    framework = {"name": "fw", "file": name, "repeat": [1, 1, 1], "frozen": True, "sites": sites}
    forces = {"cutoff_A": 5.0, "electrostatics": "none"}
    [body] = species_of(
        small_scene({}, 1.0, tmp_path, molecules=[framework], box={}, forces=forces)
    )
    return body.elements, " ".join(body.reading)


@pytest.mark.parametrize("form", ["cif", "mmcif", "xyz", "pdb", "lammpstrj"])
@pytest.mark.parametrize("symbol", ["SI", "CU", "FE", "NI", "CO", "ZN", "CL", "HO"])
def test_elements_in_capitals(form, symbol, tmp_path):
    """As in all mmCIF and PDB, and in CIF and other files of some programs."""
    element = symbol.capitalize()
    text = in_capitals(form, symbol, "O")
    assert elements_in(tmp_path, form, text, element, "O") == ((element, "O"), ANY)
    one = "H" if symbol == "HO" else symbol[0]
    with pytest.raises(SceneError, match=f"no entry of sites has this name or the name {element};"):
        elements_in(tmp_path, form, in_capitals(form, symbol, one), one)  # next to C, CO is cobalt


def test_symbols_in_capitals_that_are_names(tmp_path):
    """CO of a file with names of sites as types is carbon, by the formula or by the elements of the scene."""
    of_formula = in_capitals("cif", "CO", "O", "C1 O1")
    assert elements_in(tmp_path, "cif", of_formula, "CO", "O")[0] == ("C", "O")
    text = in_capitals("cif", "CO", "O")
    elements, notes = elements_in(tmp_path, "cif", text, "C", "O")
    assert elements == ("C", "O")
    assert "in capitals in its column of elements were read: CO as a name of C" in notes
    elements, notes = elements_in(tmp_path, "cif", text, "CO", "O")
    assert elements == ("Co", "O")
    assert "were read: CO as Co" in notes
    of_formula = in_capitals("cif", "CO", "C", "Co1 C1")
    assert elements_in(tmp_path, "cif", of_formula, "Co", "C") == (("Co", "C"), ANY)


def test_elements_of_names_are_those_of_the_entries(tmp_path):
    """A .gro has names only."""
    text = "x\n    1\n    1FRM     CU    1   0.100   0.100   0.100\n   1.2   1.2   1.2\n"
    assert elements_in(tmp_path, "gro", text, "Cu")[0] == ("Cu",)
    assert elements_in(tmp_path, "gro", text, "C")[0] == ("C",)
