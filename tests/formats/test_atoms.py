"""Elements of atoms by their names and masses."""

import numpy as np
import pytest
from support.structures import Truth, read, same_molecules

from rigidmd.formats.atoms import element_of, element_of_mass


def test_names_begin_with_an_element_of_the_scene_if_they_can():
    water = frozenset({"O", "H"})
    names = {
        "OW": "O",
        "HO": "H",
        "1HW": "H",
        "M": "X",
        "MW": "X",
        "CL": "Cl",
        "B1": "B",
        "": "",
        "17": "",
    }
    assert {name: element_of(name, water) for name in names} == names
    assert element_of("Na", frozenset("N")) == "Na"  # nobody writes a nitrogen so
    assert element_of("NA", frozenset({"N", "Na"})) == "Na"
    assert element_of("CA", frozenset("C")) == "C"


@pytest.mark.parametrize("form", ["xyz", "cif"])
def test_names_in_capitals_in_a_column_of_elements(form, tmp_path):
    """HO is hydrogen in a scene with water, and holmium in none."""
    truth = Truth(["spce"] * 3, 5)
    rows = [(n, {"H": "HO"}.get(e, e), k, x, v) for n, e, k, x, v in truth.atoms()]
    text = truth.xyz(rows)
    if form == "cif":
        inverse = np.linalg.inv(truth.cell)
        edges = [
            f"_cell_length_{x} {edge}" for x, edge in zip("abc", np.diag(truth.cell), strict=True)
        ]
        edges += [f"_cell_angle_{x} 90" for x in ("alpha", "beta", "gamma")]
        columns = [f"_atom_site_{c}" for c in ("type_symbol", "fract_x", "fract_y", "fract_z")]
        lines = [f"{e} {' '.join(f'{u:.9f}' for u in x @ inverse)}" for _, e, _, x, _ in rows]
        text = "\n".join(["data_x", *edges, "loop_", *columns, *lines, ""])
    found = read(tmp_path, text, f"a.{form}")
    same_molecules(found, truth, 1e-5)
    assert any("were read: HO as a name of H" in note for note in found.notes)


@pytest.mark.parametrize(
    ("mass", "element"),
    [
        (1.008, "H"),
        (2.014, "D"),
        (3.016, "T"),
        (4.0026, "He"),
        (15.9994, "O"),
        (15.035, ""),
        (9.9994, ""),
        (22.99, "Na"),
    ],
)
def test_elements_by_mass(mass, element):
    """What weighs as nothing does, a united atom for one, is not a element."""
    assert element_of_mass(mass) == element
