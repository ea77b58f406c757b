"""Crystals from CIF: the symmetry that a file states in any way, and the atoms that it makes.
Truths are lists of operations of International Tables A, expanded here, and published cells."""

import re

import ase.data
import numpy as np
import pytest

from rigidmd.assemble.structure import read_structure
from rigidmd.errors import StructureError
from rigidmd.io.structure_file import read_atoms
from rigidmd.scene.models import load_model

CELL_KEYS = ("length_a", "length_b", "length_c", "angle_alpha", "angle_beta", "angle_gamma")
#: A bent molecule of three atoms, fractional.
ATOMS = (
    ("O1", "O", (0.13, 0.21, 0.17)),
    ("H1", "H", (0.2, 0.25, 0.2)),
    ("H2", "H", (0.08, 0.27, 0.22)),
)


def cif(cell, atoms=ATOMS, operations=(), **tags) -> str:
    """A CIF of the cell, the atoms (label, type, fractional coordinates) and other tags, with __
    for -."""
    lines = [
        "data_test",
        *(f"_cell_{key} {value}" for key, value in zip(CELL_KEYS, cell, strict=True)),
    ]
    lines += [f"_{tag.replace('__', '-')} '{value}'" for tag, value in tags.items()]
    if operations:
        lines += [
            "loop_",
            "_space_group_symop_operation_xyz",
            *(f"'{operation}'" for operation in operations),
        ]
    lines += [
        "loop_",
        *(f"_atom_site_{key}" for key in ("label", "type_symbol", "fract_x", "fract_y", "fract_z")),
    ]
    lines += [f"{label} {symbol} {' '.join(map(str, x))}" for label, symbol, x in atoms]
    return "\n".join([*lines, ""])


def read(tmp_path, text, name="a.cif"):
    (tmp_path / name).write_bytes(text.encode())
    return read_atoms(tmp_path / name)


def expanded(operations, x) -> np.ndarray:
    """Images of a point by operations such as 1/2-x,y,z."""
    values = dict(zip("xyz", x, strict=True))
    return np.array(
        [[eval(part, {}, values) for part in operation.split(",")] for operation in operations]
    )


def same_points(one, other, cell, tolerance=1e-6):
    """Two sets of fractional coordinates are the same in the lattice."""
    assert len(one) == len(other)
    step = np.asarray(one)[:, None] - np.asarray(other)
    distance = np.linalg.norm((step - np.round(step)) @ cell, axis=2)
    assert distance.min(axis=0).max() < tolerance
    assert distance.min(axis=1).max() < tolerance


def is_expanded(found, operations, atoms=ATOMS):
    """The atoms read are the images of the atoms in the file."""
    for label, _, x in atoms:
        mine = found.position[[name == label for name in found.names]] @ np.linalg.inv(found.cell)
        same_points(mine, expanded(operations, x), found.cell)


def pairs(found, radius):
    """Pairs of atoms nearer than the radius, each once, in a cell with edges longer than that."""
    i, j = np.triu_indices(len(found.names), 1)
    step = (found.position[i] - found.position[j]) @ np.linalg.inv(found.cell)
    distance = np.linalg.norm((step - np.round(step)) @ found.cell, axis=1)
    return i[distance < radius], j[distance < radius], distance[distance < radius]


P21N = ["x,y,z", "1/2-x,1/2+y,1/2-z", "-x,-y,-z", "1/2+x,1/2-y,1/2+z"]
P21C = ["x,y,z", "-x,1/2+y,1/2-z", "-x,-y,-z", "x,1/2-y,1/2+z"]
P21B = ["x,y,z", "-x,1/2-y,1/2+z", "-x,-y,-z", "x,1/2+y,1/2-z"]  # unique axis c
PBNM = [
    "x,y,z",
    "-x,-y,1/2+z",
    "1/2+x,1/2-y,-z",
    "1/2-x,1/2+y,1/2-z",
    "-x,-y,-z",
    "x,y,1/2-z",
    "1/2-x,1/2+y,z",
    "1/2+x,1/2-y,1/2+z",
]
PCAB = [
    "x,y,z",
    "1/2-x,1/2+y,-z",
    "1/2+x,-y,1/2-z",
    "-x,1/2-y,1/2+z",
    "-x,-y,-z",
    "1/2+x,1/2-y,z",
    "1/2-x,y,1/2+z",
    "x,1/2+y,1/2-z",
]
P42N_1 = [
    "x,y,z",
    "-x,-y,z",
    "1/2-y,1/2+x,1/2+z",
    "1/2+y,1/2-x,1/2+z",
    "1/2-x,1/2-y,1/2-z",
    "1/2+x,1/2+y,1/2-z",
    "y,-x,-z",
    "-y,x,-z",
]
P42N_2 = [
    "x,y,z",
    "1/2-x,1/2-y,z",
    "-y,1/2+x,1/2+z",
    "1/2+y,-x,1/2+z",
    "-x,-y,-z",
    "1/2+x,1/2+y,-z",
    "y,1/2-x,1/2-z",
    "1/2-y,x,1/2-z",
]
R3_RHOMBOHEDRAL = ["x,y,z", "z,x,y", "y,z,x", "-x,-y,-z", "-z,-x,-y", "-y,-z,-x"]
R3_HEXAGONAL = [
    ",".join(f"({part})+{shift}" for part, shift in zip(operation.split(","), shifts, strict=True))
    for shifts in (("0", "0", "0"), ("2/3", "1/3", "1/3"), ("1/3", "2/3", "2/3"))
    for operation in ("x,y,z", "-y,x-y,z", "y-x,-x,z", "-x,-y,-z", "y,y-x,-z", "x-y,x,-z")
]
MONOCLINIC, UNIQUE_C = (9, 8, 10, 90, 101, 90), (9, 8, 10, 90, 90, 101)
ORTHORHOMBIC, TETRAGONAL = (9, 11, 13, 90, 90, 90), (9, 9, 8, 90, 90, 90)
RHOMBOHEDRAL, HEXAGONAL = (8, 8, 8, 75, 75, 75), (9, 9, 12, 90, 90, 120)
NAME, HALL, CODE = (
    "symmetry_space_group_name_H__M",
    "space_group_name_Hall",
    "space_group_IT_coordinate_system_code",
)
NUMBER = "space_group_IT_number"
#: Cell, operations, and what a file without a list may state instead.
STATED = [
    (MONOCLINIC, P21N, {NAME: "P 1 21/n 1", NUMBER: 14}),
    (MONOCLINIC, P21N, {NAME: "P 21/n"}),
    (MONOCLINIC, P21N, {NAME: "P2(1)/n"}),
    (MONOCLINIC, P21N, {NAME: "P 2_1/n", NUMBER: 14}),
    (MONOCLINIC, P21N, {HALL: "-P 2yn", NUMBER: 14}),
    (MONOCLINIC, P21N, {NUMBER: 14, CODE: "b2"}),
    (MONOCLINIC, P21N, {"space_group_name_H__M_alt": "P 1 21/n 1"}),
    (MONOCLINIC, P21C, {NAME: "P2~1~/c"}),
    (MONOCLINIC, P21C, {NAME: "P 1 21/c 1 (No. 14)"}),
    (UNIQUE_C, P21B, {NAME: "P 21/b"}),
    (UNIQUE_C, P21B, {NAME: "P 1 1 21/b", NUMBER: 14}),
    (ORTHORHOMBIC, PBNM, {NAME: "P b n m", NUMBER: 62}),
    (ORTHORHOMBIC, PBNM, {NAME: "PBNM"}),
    (ORTHORHOMBIC, PBNM, {NUMBER: 62, CODE: "cab"}),
    (ORTHORHOMBIC, PCAB, {NAME: "P c a b", NUMBER: 61}),
    (ORTHORHOMBIC, PCAB, {HALL: "-P 2bc 2ac"}),
    (TETRAGONAL, P42N_1, {NAME: "P 42/n :1", NUMBER: 86}),
    (TETRAGONAL, P42N_1, {NAME: "P 42/n S"}),
    (TETRAGONAL, P42N_2, {NAME: "P 42/n :2", NUMBER: 86}),
    (TETRAGONAL, P42N_2, {NAME: "P 42/n:2"}),
    (TETRAGONAL, P42N_2, {NAME: "P 42/n Z"}),
    (TETRAGONAL, P42N_2, {NAME: "P 42/n", HALL: "-P 4bc"}),
    (TETRAGONAL, P42N_2, {NAME: "P 42/n", CODE: "2"}),
    (TETRAGONAL, P42N_2, {NUMBER: 86, CODE: "2"}),
    (RHOMBOHEDRAL, R3_RHOMBOHEDRAL, {NAME: "R -3", NUMBER: 148}),
    (RHOMBOHEDRAL, R3_RHOMBOHEDRAL, {NAME: "R -3 :R"}),
    (RHOMBOHEDRAL, R3_RHOMBOHEDRAL, {NUMBER: 148}),
    (HEXAGONAL, R3_HEXAGONAL, {NAME: "R -3"}),
    (HEXAGONAL, R3_HEXAGONAL, {NAME: "R -3 :H", NUMBER: 148}),
    (HEXAGONAL, R3_HEXAGONAL, {NAME: "R -3 H"}),
    (HEXAGONAL, R3_HEXAGONAL, {NAME: "H -3"}),
    (HEXAGONAL, R3_HEXAGONAL, {HALL: "-R 3"}),
    (RHOMBOHEDRAL, R3_RHOMBOHEDRAL, {NAME: "R -3 R"}),
    (MONOCLINIC, P21N, {NAME: "P 21/n :b2"}),
    (ORTHORHOMBIC, PBNM, {"space_group_name_H__M_full": "P 21/b 21/n 2/m"}),
    (ORTHORHOMBIC, PCAB, {"space_group_name_H__M_full": "P 2/c 2/a 2/b", NUMBER: 61}),
]


@pytest.mark.parametrize(("cell", "operations", "tags"), STATED, ids=lambda value: str(value)[:60])
def test_symmetry_without_a_list_of_operations(cell, operations, tags, tmp_path):
    found = read(tmp_path, cif(cell, **tags))
    is_expanded(found, operations)
    assert any("as the file lists none" in note for note in found.notes)
    assert not any("assumed" in note for note in found.notes)


@pytest.mark.parametrize(
    "name", [None, "P 1 21/n 1", "P2(1)/n", "P 21/n (cell choice 2)", "?", "R -3 :H"]
)
@pytest.mark.parametrize("number", [None, 14, 62])
def test_a_list_of_operations_defines_the_symmetry(name, number, tmp_path):
    """Whatever name and number are; those of another group are reported."""
    tags = ({NAME: name} if name else {}) | ({NUMBER: number} if number else {})
    found = read(tmp_path, cif(MONOCLINIC, operations=P21N, **tags))
    is_expanded(found, P21N)
    assert found.notes[0] == "4 symmetry operations in the file, which are those of P 1 21/n 1"
    notes = " ".join(found.notes)
    assert ("its space group R -3 :H" in notes) == (name == "R -3 :H")
    assert ("its space group number 62" in notes) == (number == 62)
    assert ("would be another symmetry" in notes) == (name == "R -3 :H" or number == 62)


@pytest.mark.parametrize(
    ("cell", "tags", "assumed", "others"),
    [
        (ORTHORHOMBIC, {NUMBER: 61}, "P b c a", "P c a b"),
        (TETRAGONAL, {NUMBER: 86}, "P 42/n:1", "P 42/n:2"),
        (TETRAGONAL, {NAME: "P 42/n"}, "P 42/n:1", "P 42/n:2"),
        (MONOCLINIC, {NUMBER: 14}, "P 1 21/c 1", "P 1 21/n 1, P 1 21/a 1"),
        (UNIQUE_C, {NUMBER: 14}, "P 1 1 21/a", "P 1 1 21/n, P 1 1 21/b"),
    ],
)
def test_an_assumed_setting_is_reported(cell, tags, assumed, others, tmp_path):
    found = read(tmp_path, cif(cell, **tags))
    expected = (
        f"the setting {assumed} was assumed, which the file does not state (it may be {others})"
    )
    assert any(expected in note for note in found.notes)


@pytest.mark.parametrize(
    ("cell", "operations", "tags", "message"),
    [
        (
            ORTHORHOMBIC,
            (),
            {NAME: "P 42/n :2"},
            r"its space group P 42/n :2 cannot be in its cell, edges 9.0000, 11.0000",
        ),
        (HEXAGONAL, (), {NAME: "R -3 :R"}, r"its space group R -3 :R cannot be in its cell"),
        (ORTHORHOMBIC, ("x,y,z", "y,x,z"), {}, "its list of operations cannot be in its cell"),
        (
            MONOCLINIC,
            (),
            {NAME: "P 1 21/n 1", NUMBER: 15},
            "P 1 21/n 1 and its space group number 15 contradict each other",
        ),
        (
            ORTHORHOMBIC,
            (),
            {HALL: "-P 2bc 2ac", NAME: "P b c a"},
            "-P 2bc 2ac and its space group P b c a contradict",
        ),
        (MONOCLINIC, P21N[:3], {}, "its 3 symmetry operations are not a group: is one missing"),
        (MONOCLINIC, ("-x,-y,-z",), {}, "its 1 symmetry operations are not a group"),
        (
            MONOCLINIC,
            (),
            {NAME: "P wrong"},
            "its space group P wrong is unknown: give its operations",
        ),
        (MONOCLINIC, (), {NUMBER: 231}, "its space group 231 is unknown"),
        (MONOCLINIC, (), {HALL: "P wrong"}, "its space group P wrong is unknown"),
        (
            MONOCLINIC,
            ("x,y,z", "-x,y"),
            {},
            "expected an operation such as x,1/2-y,z, found '-x,y'",
        ),
        (MONOCLINIC, ("x,y,z", "x,x,z"), {}, "neither a rotation nor a reflection"),
    ],
)
def test_contradictions_are_refused(cell, operations, tags, message, tmp_path):
    with pytest.raises(StructureError, match=message):
        read(tmp_path, cif(cell, operations=operations, **tags))


def test_what_is_stated_wrongly_next_to_operations_is_reported(tmp_path):
    tags = {
        "symmetry_cell_setting": "cubic",
        "exptl_crystal_density_diffrn": 2.5,
        "cell_formula_units_Z": 2,
    }
    found = read(tmp_path, cif(MONOCLINIC, operations=P21N, chemical_formula_sum="H2 O", **tags))
    notes = "; ".join(found.notes)
    assert re.search(
        r"its cell, edges 9.0000, 8.0000, 10.0000 Å, angles 90, 101, 90°, is not cubic", notes
    )
    assert "its cell of 706.77 Å³ holds H8 O4, 0.1693 g/cm³, from 3 atoms in the file" in notes
    assert "the density in the file is 2.5 g/cm³, but its atoms make 0.1693 g/cm³" in notes
    assert "its formula and Z are H4 O2 in the cell, but its atoms make H8 O4" in notes
    unknown = read(tmp_path, cif(MONOCLINIC, **{NAME: "P wrong", NUMBER: 14}))
    assert "its space group P wrong is unknown" in unknown.notes


@pytest.mark.parametrize("operations", [(), ("x,y,z",)])
def test_molecules_that_lack_their_symmetry(operations, tmp_path):
    """Half of a carbon dioxide: the message names the reason."""
    dry_ice = (("C1", "C", (0, 0, 0)), ("O1", "O", (0.1185, 0.1185, 0.1185)))
    (tmp_path / "a.cif").write_text(cif((5.624,) * 3 + (90,) * 3, dry_ice, operations))
    reason = (
        "x,y,z is the only symmetry operation in the file"
        if operations
        else "no symmetry operations in the file"
    )
    with pytest.raises(StructureError, match=rf"has atoms C O, expected co2_trappe(?s:.*){reason}"):
        read_structure(tmp_path / "a.cif", [load_model("co2_trappe")], None, True, 0.15)
    tags = {NAME: "P a -3"}
    (tmp_path / "a.cif").write_text(cif((5.624,) * 3 + (90,) * 3, dry_ice, **tags))
    found = read_structure(tmp_path / "a.cif", [load_model("co2_trappe")], None, True, 0.15)
    assert len(found.species) == 4
    assert any(
        "holds C4 O8, 1.643 g/cm³, from 2 atoms in the file, 2 on special positions" in n
        for n in found.notes
    )


#: Published cells: name, space group, cell, atoms, and the atoms of one molecule, molecules in the
#: cell, bonds of a molecule, mean C-C, C-N or C-Cl distance.
ACETYLENE = (("C1", "C", (0.0562,) * 3), ("H1", "H", (0.1524,) * 3))
HEXAMINE = (
    ("C1", "C", (0.2378, 0, 0)),
    ("H1", "H", (0.3275, 0.0885, -0.0885)),
    ("N1", "N", (0.1232,) * 3),
)
ADAMANTANE = (
    ("C1", "C", ("0.0000", "0.0000", "0.1980(3)")),
    ("C2", "C", ("-0.0262(4)", "0.1862(4)", "0.0992(3)")),
    ("C3", "C", ("0.1600(4)", "0.2122(4)", "0.0000")),
)
HEXACHLOROBENZENE = (
    ("Cl1", "Cl", (0.408, 0.245, 0.066)),
    ("Cl2", "Cl", (0.279, -0.033, 0.204)),
    ("Cl3", "Cl", (0.128, 0.278, -0.138)),
    ("C1", "C", (0.183, 0.111, 0.030)),
    ("C2", "C", (0.126, -0.015, 0.092)),
    ("C3", "C", (0.058, 0.125, -0.062)),
)
PUBLISHED = [
    ("P a -3", ("6.0940(8)",) * 3 + (90,) * 3, ACETYLENE, {"C": 8, "H": 8}, ("C", "C", 4, 1.187)),
    ("P a 3", (6.094,) * 3 + (90,) * 3, ACETYLENE, {"C": 8, "H": 8}, ("C", "H", 8, 1.015)),
    (
        "I -4 3 m",
        (7.021,) * 3 + (90,) * 3,
        HEXAMINE,
        {"C": 12, "H": 24, "N": 8},
        ("C", "N", 24, 1.464),
    ),
    (
        "P -4 21 c",
        ("6.639(7)", "6.639(7)", "8.918(9)", 90, 90, 90),
        ADAMANTANE,
        {"C": 20},
        ("C", "C", 24, 1.533),
    ),
    (
        "P 21/c",
        (8.08, 3.87, 16.65, 90, 117, 90),
        HEXACHLOROBENZENE,
        {"C": 12, "Cl": 12},
        ("C", "Cl", 12, 1.72),
    ),
]


@pytest.mark.parametrize(
    ("name", "cell", "atoms", "contents", "bonds"), PUBLISHED, ids=lambda value: str(value)[:20]
)
def test_published_crystals(name, cell, atoms, contents, bonds, tmp_path):
    """Numbers of atoms and of bonds, and the mean length of bonds, follow from cell, space group
    and asymmetric unit."""
    found = read(tmp_path, cif(cell, atoms, **{NAME: name}))
    assert {e: found.elements.count(e) for e in set(found.elements)} == contents
    one, other, count, length = bonds
    i, j, distance = pairs(found, 1.9)
    elements = np.array(found.elements)
    bonded = (elements[i] == one) & (elements[j] == other) | (elements[i] == other) & (
        elements[j] == one
    )
    assert bonded.sum() == count
    assert distance[bonded].mean() == pytest.approx(length, abs=0.02)


@pytest.mark.parametrize("digits", [2, 3, 6])
def test_special_positions_are_those_of_rounded_coordinates(digits, tmp_path):
    """Atoms near special positions, by printed digits, count once and are put exactly there."""
    third = round(1 / 3, digits)
    atoms = (
        ("C1", "C", (third, round(2 / 3, digits), 0.2)),
        ("N1", "N", (0, 0, round(0.1 + 1e-3, digits))),
    )
    found = read(tmp_path, cif((10, 10, 8, 90, 90, 120), atoms, **{NAME: "P -3 m 1"}))
    assert len(found.names) == 4
    x = found.position[:2] @ np.linalg.inv(found.cell)
    same_points(x, [(1 / 3, 2 / 3, 0.2), (2 / 3, 1 / 3, 0.8)], found.cell, 1e-9)


def test_atoms_listed_with_their_images_count_once(tmp_path):
    """Whole molecules on centres, whole cells with operations, atoms on two faces of a cell."""
    cell, operations = MONOCLINIC, P21N
    whole = [(label, e, tuple(x)) for label, e, at in ATOMS for x in expanded(operations, at)]
    found = read(tmp_path, cif(cell, whole, operations))
    is_expanded(found._replace(names=[*found.names]), operations)
    assert "9 atoms of the file are images of others by symmetry and count once" in found.notes
    faces = (("Ar1", "Ar", (0, 0.5, 0.5)), ("Ar2", "Ar", (1, 0.5, 0.5)), ("Ar3", "Ar", (0.5, 0, 0)))
    assert read(tmp_path, cif(ORTHORHOMBIC, faces)).names == ["Ar1", "Ar3"]
    mixed = (("C1", "C", (0.1, 0.2, 0.3)), ("N1", "N", (0.101, 0.2, 0.3)))
    with pytest.raises(
        StructureError,
        match=r"atoms 1 and 2 are 0.009 Å apart in the cell: its atoms are disordered",
    ):
        read(tmp_path, cif(ORTHORHOMBIC, mixed))


def test_short_bonds_across_a_symmetry_element_stay(tmp_path):
    """H2 and N2 on inversion centres are not atoms on special positions."""
    for symbol, length in (("H", 0.7414), ("N", 1.0977)):
        atom = ((symbol, symbol, (0.5 * length / 9, 0, 0)),)
        found = read(tmp_path, cif(ORTHORHOMBIC, atom, **{NAME: "P -1"}))
        assert len(found.names) == 2
        assert pairs(found, 2.0)[2] == pytest.approx([length])


# syntax


SYNTAX = {
    "a comment in the head of a loop": lambda t: t.replace(
        "operation_xyz", "operation_xyz #<--must include 'x,y,z'"
    ),
    "comments after values": lambda t: t.replace("length_b 8", "length_b 8 # Angstrom"),
    "CR": lambda t: t.replace("\n", "\r"),
    "CRLF": lambda t: t.replace("\n", "\r\n"),
    "upper case": lambda t: (
        t.replace("_cell_length_a", "_Cell_Length_A")
        .replace("loop_", "LOOP_")
        .replace("x,y", "X,Y")
    ),
    "letters": lambda t: f"# 5 Å\n{t}_publ_author_name Müller\n_publ_title 'Größe'\n",
    "a text": lambda t: t.replace(
        "data_test", "data_test\n_refine_details\n;\nloop_ _atom_site_x 'don't'\n;"
    ),
    "an empty block": lambda t: f"data_global\n_publ_year 2001\n{t}",
    "uncertainties": lambda t: t.replace("0.13 ", "0.13(2) ").replace(
        "length_a 9", "length_a 9.000(12)"
    ),
    "signs and exponents": lambda t: t.replace("0.13 ", "+1.3E-1 ").replace("0.21 ", ".21 "),
    "decimals in operations": lambda t: t.replace("1/2+", "0.5+").replace("1/2-", ".5 - "),
}


@pytest.mark.parametrize("name", SYNTAX)
def test_syntax(name, tmp_path):
    text = SYNTAX[name](cif(MONOCLINIC, operations=P21N))
    assert text != cif(MONOCLINIC, operations=P21N)
    is_expanded(read(tmp_path, text), P21N)


@pytest.mark.parametrize("name", ["crystal", "crystal.txt", "a.mmcif"])
def test_a_crystal_is_known_by_its_first_lines(name, tmp_path):
    is_expanded(
        read(tmp_path, "# of the Cambridge database\n\n" + cif(MONOCLINIC, operations=P21N), name),
        P21N,
    )


def with_column(text, key, values):
    """The text with a further column of the atoms."""
    head, rows = text.split("_atom_site_fract_z\n")
    rows = [f"{row} {value}" for row, value in zip(rows.splitlines(), values, strict=True)]
    return "\n".join([f"{head}_atom_site_fract_z", f"_atom_site_{key}", *rows, ""])


@pytest.mark.parametrize(
    "one", ["1", "1.0", "1.", "1.000", "1.0(0)", "0.9999", "0.998(3)", ".", "?", "1.0001"]
)
def test_occupancies_of_one(one, tmp_path):
    found = read(
        tmp_path, with_column(cif(MONOCLINIC, operations=P21N), "occupancy", ["1.0", one, one])
    )
    is_expanded(found, P21N)


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        (
            "occupancy",
            ("1", "0.5", "0.5"),
            r"occupied only partly \(H1 0.5, H2 0.5\): the crystal is disordered",
        ),
        ("occupancy", ("1", "1", "0.97(1)"), r"occupied only partly \(H2 0.97\)"),
        ("occupancy", ("1", "1", "1.5"), "has the occupancy 1.5|have the occupancy 1.5"),
        (
            "disorder_group",
            (".", "1", "2"),
            "atoms are in disorder groups 1, 2: the crystal is disordered",
        ),
        (
            "disorder_group",
            (".", ".", "-1"),
            "atoms are in disorder groups -1: the crystal is disordered",
        ),
    ],
)
def test_disorder_is_refused(key, values, message, tmp_path):
    with pytest.raises(StructureError, match=message):
        read(tmp_path, with_column(cif(MONOCLINIC, operations=P21N), key, values))


def test_dummies_are_left_out(tmp_path):
    text = with_column(cif(MONOCLINIC, operations=P21N), "calc_flag", ["d", "calc", "dum"])
    found = read(tmp_path, text)
    assert set(found.names) == {"O1", "H1"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("_cell_angle_beta 101", "", "its cell is incomplete: _cell_angle_beta is not a number"),
        ("_cell_length_a 9", "_cell_length_a nine", "its cell is incomplete: _cell_length_a"),
        (
            "_cell_angle_beta 101",
            "_cell_angle_beta 190",
            "no cell has the edges and angles 9 8 10 90 190 90",
        ),
        ("_cell_angle_beta 101", "_cell_angle_beta 1e-31", "its cell: .* must be 0.5 Å at least"),
        ("_cell_length_b 8", "_cell_length_b 1e200", "its cell: it must not be longer than"),
        ("0.25 ", "? ", "atom H1 has no position, expected three numbers, found 0.2 None 0.2"),
        ("0.25 ", "1/4 ", "atom H1 has no position, expected three numbers, found 0.2 1/4 0.2"),
        ("0.22", "", r"line \d+: this is not valid CIF: Wrong number of values in loop _atom_site"),
        ("data_test", "test", "line 1: this is not valid CIF: expected block header"),
        ("data_test", "data_test\n_cell_length_a 8", "duplicate tag _cell_length_a"),
    ],
)
def test_damaged_files(old, new, message, tmp_path):
    text = cif(MONOCLINIC, operations=P21N)
    assert old in text
    with pytest.raises(StructureError, match=message):
        read(tmp_path, text.replace(old, new))


def test_a_file_without_a_cell(tmp_path):
    text = "\n".join(line for line in cif(MONOCLINIC).splitlines() if not line.startswith("_cell"))
    with pytest.raises(
        StructureError, match="has no cell: _cell_length_a to _cell_angle_gamma are missing"
    ):
        read(tmp_path, text)


# elements and massless sites


@pytest.mark.parametrize(
    ("symbol", "element"),
    [
        ("O", "O"),
        ("O2-", "O"),
        ("Fe3+", "Fe"),
        ("C4+", "C"),
        ("D", "D"),
        ("Cl", "Cl"),
        ("M", "X"),
        ("MW", "X"),
        ("EP", "X"),
        ("Du", "X"),
        ("L", "X"),
        ("Q", "X"),
        ("X", "X"),
        ("OW", ""),
        ("HW1", ""),
    ],
)
def test_types_and_elements(symbol, element, tmp_path):
    found = read(tmp_path, cif(ORTHORHOMBIC, (("A1", symbol, (0.1, 0.2, 0.3)),)))
    assert found.elements == [element]
    assert found.names == ["A1" if element not in ("", "X") else symbol]


@pytest.mark.parametrize(
    "names",
    [("OW", "HW1", "HW2", "MW"), ("O", "H", "H", "M"), ("O", "H", "H", "Du"), ("O", "D", "D", "X")],
)
def test_massless_sites_and_deuterium(names, tmp_path):
    """As GenIce writes TIP4P, with the names of sites as types, and others."""
    model = load_model("tip4p2005")
    centre, edge = np.array([[2.0, 2, 2], [6, 6, 6]]), 9.0
    x = (model.positions_body[None] + centre[:, None]).reshape(-1, 3) / edge
    atoms = [
        (f"{name}{k}", name, point)
        for k, (name, point) in enumerate(zip(2 * names, x, strict=True))
    ]
    (tmp_path / "a.cif").write_text(
        cif((edge,) * 3 + (90,) * 3, atoms, ("X,Y,Z",), **{NAME: "P 1 "})
    )
    found = read_structure(tmp_path / "a.cif", [model], None, True, 0.15)
    assert found.residual_max < 1e-6
    assert len(found.species) == 2


# mmCIF


def mmcif(rows, cell=True, header=()) -> str:
    """An mmCIF as OpenMM writes it; rows: type, name, residue, number, insertion code, alternative,
    position, model."""
    edges = [
        f"_cell.{key} {value}"
        for key, value in zip(CELL_KEYS, (20, 21, 22, 90, 90, 90), strict=True)
    ]
    columns = [
        "group_PDB",
        "id",
        "type_symbol",
        "label_atom_id",
        "label_alt_id",
        "label_comp_id",
        "label_asym_id",
        "label_seq_id",
        "pdbx_PDB_ins_code",
        "Cartn_x",
        "Cartn_y",
        "Cartn_z",
        "occupancy",
        "auth_seq_id",
        "pdbx_PDB_model_num",
    ]
    lines = [
        "data_cell",
        "#",
        *(edges if cell else ()),
        *header,
        "loop_",
        *(f"_atom_site.{c}" for c in columns),
    ]
    for k, (symbol, name, residue, number, code, alternative, at, model) in enumerate(rows, 1):
        point = " ".join(f"{x:.4f}" for x in at)
        lines.append(
            f"HETATM {k} {symbol} {name} {alternative} {residue} A . {code} {point} 0.0 {number} {model}"
        )
    return "\n".join([*lines, ""])


def waters(
    model="tip4p2005", symbols=("O", "H", "H", "?"), numbers=(1, 2), codes=("?", "?"), models=(1, 1)
):
    sites = load_model(model)
    names = ("O", "H1", "H2", "M")
    return [
        (symbol, name, "HOH", number, code, ".", np.add(x, [3.0 + 4 * k, 5, 6]), frame)
        for k, (number, code, frame) in enumerate(zip(numbers, codes, models, strict=True))
        for symbol, name, x in zip(symbols, names, sites.positions_body, strict=True)
    ]


@pytest.mark.parametrize(
    ("numbers", "codes"), [((1, 2), ("?", "?")), ((7, 7), ("A", "B")), ((3, 3), ("?", "A"))]
)
def test_mmcif_of_molecules(numbers, codes, tmp_path):
    (tmp_path / "a.cif").write_text(mmcif(waters(numbers=numbers, codes=codes)))
    found = read_structure(tmp_path / "a.cif", [load_model("tip4p2005")], None, True, 0.15)
    assert found.residual_max < 1e-3
    assert np.diag(found.cell) == pytest.approx([20, 21, 22])
    assert found.number.tolist() == list(numbers)
    assert found.notes == ()
    atoms = read_atoms(tmp_path / "a.cif")
    assert [residue[1:] for residue in atoms.residue] == [("HOH", 1)] * 4 + [("HOH", 2)] * 4


def test_models_and_alternatives_of_mmcif(tmp_path):
    (tmp_path / "a.cif").write_text(mmcif(waters(models=(1, 2))))
    with pytest.raises(StructureError, match="holds 2 structures"):
        read_atoms(tmp_path / "a.cif")
    assert read_atoms(tmp_path / "a.cif", frame=2).position[0] == pytest.approx(
        [7, 5.0, 6.0], abs=0.1
    )
    rows = [(*row[:5], "AB"[k % 2], *row[6:]) for k, row in enumerate(waters())]
    with pytest.raises(StructureError, match=r"has alternate locations A, B. Keep one of them"):
        read(tmp_path, mmcif(rows))
    assert read(tmp_path, mmcif(waters(), cell=False)).cell is None


def test_symmetry_and_orientation_of_mmcif(tmp_path):
    """The space group acts on positions in Å, in an orientation that the file may give."""
    rows = waters()[:3]
    header = ["_symmetry.space_group_name_H-M 'P 21 21 21'"]
    plain = read(tmp_path, mmcif(rows, header=header))
    operations = ["x,y,z", "1/2-x,-y,1/2+z", "-x,1/2+y,1/2-z", "1/2+x,1/2-y,-z"]
    edges = np.array([20.0, 21, 22])
    atoms = [(row[1], row[0], np.round(row[6], 4) / edges) for row in rows]
    is_expanded(plain, operations, atoms)
    matrix = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]) / edges[:, None]
    entries = [
        f"_atom_sites.fract_transf_matrix[{i + 1}][{j + 1}] {matrix[i, j]:.9f}"
        for i in range(3)
        for j in range(3)
    ]
    entries += [f"_atom_sites.fract_transf_vector[{i + 1}] 0.1" for i in range(3)]
    turned = read(tmp_path, mmcif(rows, header=[*header, *entries]))
    atoms = [(row[1], row[0], matrix @ np.round(row[6], 4) + 0.1) for row in rows]
    is_expanded(turned, operations, atoms)


def test_radii_are_in_angstrom():
    """The tolerance of special positions relies on this table."""
    assert ase.data.covalent_radii[[1, 6, 18]] == pytest.approx([0.31, 0.76, 1.06])


# syntax

#: Entries that are not needed, of which the second line is not valid CIF.
BAD_ENTRIES = {
    "comma": "_citation_author_name 'A. Author, and B. Writer',\n_citation_year 2002\n",
    "loop": "loop_\n_publ_author_name\n_publ_author_address\n'A. Author'\n'B. Writer' 'C'\n",
    "twice": "_publ_section_title 'One'\n_publ_section_title 'Two'\n",
    "quote": "_publ_section_title 'Structure of a crystal\n",
    "text": "_publ_section_title\n;\nloop_\n_cell_length_a\nin words\n;\n_journal_name 'x',\n",
    "none": "_journal_name\n_journal_year 2002\n",
}


@pytest.mark.parametrize("name", BAD_ENTRIES)
@pytest.mark.parametrize("at", ["begin", "middle", "end"])
def test_invalid_entries_that_are_not_needed(name, at, tmp_path):
    """As in RASPA's IRMOF-2: a comma after a quoted citation."""
    text = cif((9, 10, 11, 90, 90, 90), operations=("x,y,z", "-x,-y,-z"))
    expected = read(tmp_path, text)
    bad = BAD_ENTRIES[name]
    marks = {"begin": "_cell_length_a", "middle": "loop_\n_space_group"}
    changed = text + bad if at == "end" else text.replace(marks[at], bad + marks[at])
    found = read(tmp_path, changed)
    assert np.array_equal(found.position, expected.position)
    assert found.names == expected.names
    assert re.search(r"this is not valid CIF: .*, in an entry that is not needed", found.notes[0])


@pytest.mark.parametrize(
    "change",
    [
        ("'-x,-y,-z'", "'-x,-y,-z',"),
        ("_cell_length_a 9", "_cell_length_a 9 10"),
        ("_cell_length_a 9", "_cell_length_a 9\n_cell_length_a 10"),
        ("0.27 0.22", "0.27"),
        ("0.27 0.22", "'0.27 0.22"),
    ],
)
def test_invalid_entries_that_are_needed(change, tmp_path):
    text = cif((9, 10, 11, 90, 90, 90), operations=("x,y,z", "-x,-y,-z"))
    with pytest.raises(StructureError, match=r"line \d+: this is not valid CIF: .*complete\?"):
        read(tmp_path, text.replace(*change))
    bad = BAD_ENTRIES["comma"]
    with pytest.raises(StructureError, match=r"this is not valid CIF: .*complete\?"):
        read(tmp_path, text.replace(*change).replace("_cell_length_b", f"{bad}_cell_length_b"))


def test_a_file_without_the_line_of_its_block(tmp_path):
    text = cif((9, 10, 11, 90, 90, 90)).replace("data_test\n", "# made by me\n\n")
    found = read(tmp_path, text)
    assert found.names == ["O1", "H1", "H2"]
    assert "line 3: there is no 'data_' before its first entry" in found.notes
    with pytest.raises(StructureError, match="not valid CIF"):
        read(tmp_path, f"made by me\n{text}")


# what a file states and what is not used


@pytest.mark.parametrize(
    ("tags", "what"),
    [
        ({HALL: "no hall"}, "its Hall symbol no hall"),
        ({NUMBER: "999"}, "its space group number 999"),
        ({"space_group_IT_coordinate_system_code": "zzz"}, "its coordinate system code zzz"),
        ({"space_group_crystal_system": "foolish"}, "its crystal system foolish"),
    ],
)
def test_what_no_table_has_is_noted(tags, what, tmp_path):
    found = read(tmp_path, cif((9, 10, 11, 90, 90, 90), **{NAME: "P -1"}, **tags))
    assert len(found.names) == 6
    assert f"{what} is unknown" in found.notes


def test_charges_of_some_atoms_only(tmp_path):
    text = cif((9, 10, 11, 90, 90, 90), operations=("x,y,z",))
    rows = [f"{x} {q}" for x, q in zip(text.splitlines()[-3:], ("-0.8", "0.4", "0.4"), strict=True)]
    head = "\n".join(text.splitlines()[:-3])
    head += "\n_atom_site_charge\n"
    assert read(tmp_path, head + "\n".join(rows)).charges.tolist() == [-0.8, 0.4, 0.4]
    assert (
        read(tmp_path, head + "\n".join(f"{row.rsplit(' ', 1)[0]} ?" for row in rows)).charges
        is None
    )
    for bad, found in (("?", "none"), ("x", "x")):
        changed = [rows[0], rows[1].removesuffix("0.4") + bad, rows[2]]
        with pytest.raises(
            StructureError, match=f"atom H1: expected _atom_site_charge .* found {found}"
        ):
            read(tmp_path, head + "\n".join(changed))
