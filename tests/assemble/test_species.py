"""Molecules whose geometry is in a file."""

import numpy as np
import pytest
from support.common import small_scene
from support.structures import SPECIES

from rigidmd.assemble.build import build
from rigidmd.assemble.plausibility import molecule_warnings
from rigidmd.assemble.species import species_of
from rigidmd.errors import SceneError
from rigidmd.io.structure_file import read_geometry
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.scene import Scene
from rigidmd.scene.models import Molecule


def test_the_element_of_a_site_counts_for_more_than_that_of_its_file(tmp_path):
    """A united atom weighs as much as oxygen does."""
    lines = [
        "x",
        "",
        "1 atoms",
        "1 atom types",
        "",
        "Masses",
        "",
        "1 16.043",
        "",
        "Atoms # atomic",
        "",
        "1 1 0.0 0.0 0.0",
    ]
    (tmp_path / "methane.data").write_text("\n".join(lines) + "\n")
    site = {"name": "1", "sigma_A": 3.73, "epsilon_K": 148.0}
    for entry, element in ((site, "O"), (site | {"element": "C"}, "C")):
        molecules = [{"file": "methane.data", "sites": [entry], "count": 5}]
        assert build(small_scene({}, 20.0, tmp_path, molecules=molecules)).species[0].elements == (
            element,
        )


def test_a_geometry_of_heavy_hydrogen_has_its_mass(tmp_path):
    (tmp_path / "a.xyz").write_text("3\n\nOW 0 0 0\nD 0.8 0.6 0\nM 0 0.1 0\n")
    atoms = read_geometry(tmp_path / "a.xyz")
    assert (atoms.names, atoms.elements) == (["OW", "D", "M"], ["O", "D", "X"])
    assert atoms.masses == pytest.approx([15.999, 2.0141, 0.0])


def co2_in(form: str, decimals: int, bend: float, seed: int) -> str:
    """Carbon dioxide in any orientation, its carbon at this distance (Å) from the line of the
    oxygens, with these decimals of Å."""
    x = np.array([[-1.16, 0, 0], [0, bend, 0], [1.16, 0, 0]])
    x = x @ random_rotations(np.random.default_rng(seed), 1)[0].T + np.sqrt([2.0, 3.0, 5.0])
    atoms = list(zip("OCO", x, strict=True))
    if form == "gro":
        width = decimals + 6
        rows = [
            f"    1CO2  {e:>5}{k:5d}{''.join(f'{u / 10:{width}.{decimals + 1}f}' for u in p)}"
            for k, (e, p) in enumerate(atoms, 1)
        ]
        return "\n".join(["co2", "    3", *rows, "   5.0   5.0   5.0", ""])
    if form == "pdb":
        return (
            "".join(
                f"ATOM  {k:5d}  {e}   CO2     1    {''.join(f'{u:8.3f}' for u in p)}\n"
                for k, (e, p) in enumerate(atoms, 1)
            )
            + "END\n"
        )
    rows = [f"{e} {' '.join(f'{u:.{decimals}f}' for u in p)}" for e, p in atoms]
    if form == "mmcif":
        columns = ("type_symbol", "Cartn_x", "Cartn_y", "Cartn_z")
        return "\n".join(["data_x", "loop_", *(f"_atom_site.{c}" for c in columns), *rows, ""])
    if form == "data":
        rows = [f"{k} {'OC'.index(r[0]) + 1} {r[2:]}" for k, r in enumerate(rows, 1)]
        head = "units = real\n\n3 atoms\n2 atom types\n\nMasses\n\n1 15.999\n2 12.011\n\n"
        return "\n".join([head + "Atoms # atomic\n", *rows, ""])
    return "\n".join(["3", "co2", *rows, ""])


def species_in(tmp_path, text: str, form: str) -> Molecule:
    (tmp_path / f"co2.{form}").write_text(text)
    sites = [{"name": e, "sigma_A": 2.8, "epsilon_K": 30.0} for e in "CO"]
    molecules = [{"name": "co2", "file": f"co2.{form}", "count": 4, "sites": sites}]
    [kind] = species_of(small_scene({}, 30.0, tmp_path, molecules=molecules))
    return kind


@pytest.mark.parametrize(
    ("form", "decimals"),
    [
        *(("xyz", n) for n in (2, 3, 4, 5, 8)),
        *(("gro", 2), ("gro", 3), ("pdb", 3), ("mmcif", 3), ("data", 2), ("data", 3)),
    ],
)
def test_molecules_are_linear_up_to_the_decimals_of_their_file(form, decimals, tmp_path):
    kinds = [species_in(tmp_path, co2_in(form, decimals, 0.0, seed), form) for seed in range(5)]
    for kind in kinds:
        assert kind.kind == "linear"
        assert np.ptp(kind.positions_body[:, 0]) == pytest.approx(2.32, abs=2 * 10.0**-decimals)
    notes = " ".join(note for kind in kinds for note in kind.reading)
    assert (f"to the {10.0**-decimals:g} Å of its coordinates" in notes) == (decimals < 5)


@pytest.mark.parametrize(
    ("form", "decimals", "bend"),
    [("xyz", 2, 0.03), ("xyz", 3, 0.003), ("xyz", 4, 0.003), ("gro", 2, 0.03), ("pdb", 3, 0.003)],
)
def test_bent_molecules_stay_bent(form, decimals, bend, tmp_path):
    """Three times the unit of the last digit: the decimals of the file show it."""
    for seed in range(4):
        kind = species_in(tmp_path, co2_in(form, decimals, bend, seed), form)
        assert kind.kind == "asymmetric"
        assert not kind.reading
        assert any(
            "co2 is nearly linear: its atoms are" in text for text in molecule_warnings(kind)
        )
    with pytest.raises(SceneError, match=r"nothing resists its torque .* Put it on the line"):
        text = co2_in("xyz", 8, 0.0002, 1)
        species_in(tmp_path, text, "xyz")


def test_few_decimals_do_not_make_a_molecule_linear(tmp_path):
    """The unit of the last digit is near the size of the molecule."""
    kind = species_in(tmp_path, "3\n\nO -1.2 0.0 0.0\nC 0.0 0.1 0.0\nO 1.2 0.0 0.0\n", "xyz")
    assert kind.kind == "asymmetric"
    assert not any("nearly linear" in text for text in molecule_warnings(SPECIES["spce"]))


def test_a_molecule_from_a_geometry_file(tmp_path):
    (tmp_path / "co2.xyz").write_text("3\n\nO 0 0 1.16\nC 0 0 0\nO 0 0 -1.16\n")
    sites = [
        {"name": "C", "charge_e": 0.7, "sigma_A": 2.8, "epsilon_K": 27.0},
        {"name": "O", "charge_e": -0.35, "sigma_A": 3.05, "epsilon_K": 79.0},
    ]
    data = small_scene({"argon": 5}, 25.0).model_dump()
    data["molecules"] = [{"file": "co2.xyz", "sites": sites, "count": 20}]
    system = build(Scene.from_dict(data, tmp_path))
    co2 = system.species[0]
    assert (co2.name, co2.kind, co2.charge) == ("co2", "linear", 0)
    assert co2.mass == pytest.approx(44.009, abs=1e-3)
    data["molecules"][0]["sites"] = sites[:1]
    with pytest.raises(SceneError, match="atom O: no entry of sites"):
        build(Scene.from_dict(data, tmp_path))
