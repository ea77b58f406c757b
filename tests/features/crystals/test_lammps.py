"""Data files and dumps of LAMMPS."""

import gzip
import re

import numpy as np
import pytest
from support.common import small_scene
from support.structures import (
    SPECIES,
    WATERS,
    Truth,
    data_of,
    dump_of,
    ion,
    lammps,
    read,
    same_molecules,
    unreadable,
)

from rigidmd.assemble.build import build
from rigidmd.errors import StructureError
from rigidmd.io.structure_file import read_atoms
from rigidmd.scene.models import with_masses


@pytest.mark.parametrize("molecule_ids", [True, False])
@pytest.mark.parametrize(
    ("units", "velocity_unit"), [("real", 1000.0), ("metal", 1.0), (None, 1.0)]
)
def test_lammps_data(units, velocity_unit, molecule_ids, tmp_path):
    truth = Truth(["spce", "argon", "spce"], 12)
    species = [SPECIES["argon"], SPECIES["spce"]]
    first = "LAMMPS data file via write_data, version 1, timestep = 0" + (
        f", units = {units}" if units else ""
    )
    found = read(tmp_path, lammps(truth, first, velocity_unit, molecule_ids), "a.data", species)
    partner = same_molecules(found, truth, 1e-7, species)
    if units:
        assert found.velocity == pytest.approx(truth.velocity[partner], rel=1e-5)
    else:
        assert found.velocity is None
        assert any("does not name its units" in note for note in found.notes)


#: Å, u and Å/ps in the units of LAMMPS.
SCALES = {
    "si": (1e-10, 1.66053907e-27, 100.0),
    "cgs": (1e-8, 1.66053907e-24, 1e4),
    "electron": (1 / 0.529177211, 1.0, 1.95163e-3),
    "micro": (1e-4, 1.66053907e-12, 100.0),
    "nano": (0.1, 1.66053907e-6, 100.0),
    "Metal": (1.0, 1.0, 1.0),
}


@pytest.mark.parametrize("units", SCALES)
@pytest.mark.parametrize("form", ["data", "dump"])
def test_units_of_lammps(units, form, tmp_path):
    """Lengths, masses (from which elements follow) and velocities of each system of units."""
    length, mass, speed = SCALES[units]
    lines = [
        f"{k} 1 {' '.join(f'{x:.9e}' for x in length * np.array([k, 2.0, 3.0]))}" for k in (1, 2)
    ]
    edge = f"0 {8 * length:.9e}"
    if form == "data":
        text = (
            f"made by me, units = {units}\n\n2 atoms\n1 atom types\n"
            + "".join(f"{edge} {x}lo {x}hi\n" for x in "xyz")
            + f"\nMasses\n\n1 {39.948 * mass:.9e}\n\nAtoms # atomic\n\n"
            + "\n".join(lines)
            + f"\n\nVelocities\n\n1 {speed:.9e} 0 0\n2 {speed:.9e} 0 0\n"
        )
    else:
        bounds = f"ITEM: BOX BOUNDS pp pp pp\n{edge}\n{edge}\n{edge}\n"
        text = (
            f"ITEM: UNITS\n{units}\nITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n2\n{bounds}"
            "ITEM: ATOMS id type x y z mass vx vy vz\n"
            + "".join(f"{line} {39.948 * mass:.9e} {speed:.9e} 0 0\n" for line in lines)
        )
    path = tmp_path / ("a.data" if form == "data" else "a.lammpstrj")
    path.write_text(text)
    found = read_atoms(path)
    assert found.position == pytest.approx(np.array([[1.0, 2, 3], [2, 2, 3]]), rel=1e-6)
    assert found.cell == pytest.approx(8 * np.eye(3), rel=1e-6)
    assert found.masses == pytest.approx([39.948, 39.948], rel=1e-6)
    assert found.elements == ["Ar", "Ar"]
    assert found.velocity == pytest.approx(np.array([[1.0, 0, 0]] * 2), rel=1e-5)


@pytest.mark.parametrize("units", ["lj", "LJ", "furlong", ""])
def test_unknown_units_of_lammps_are_refused(units, tmp_path):
    truth = Truth(["spce", "argon", "spce"], 12)
    path = tmp_path / "a.data"
    path.write_text(lammps(truth, f"LAMMPS data file, units = {units}", 1.0))
    says = "units of sigma.*convert it to real" if units.lower() == "lj" else "expected real, metal"
    with pytest.raises(StructureError, match=f"line 1: its units are '{units}'.*{says}"):
        read_atoms(path)
    path.write_text(lammps(truth, "a melt of six repeat units, from units made by hand", 1.0))
    assert "its velocities are not used" in " ".join(read_atoms(path).notes)
    dump = tmp_path / "a.lammpstrj"
    water = Truth(["tip4p2005"] * 2, 12)
    dump.write_text(dump_of(water, "id element x y z", units=units or " "))
    with pytest.raises(StructureError, match=f"line 2: its units are '{units}'.*{says}"):
        read_atoms(dump)


def repartitioned(truth, labels=("", ""), section="") -> str:
    """Data of waters with mass moved from oxygen to hydrogen, as for long time steps."""
    text = (
        lammps(truth, "x, units = real", 1.0)
        .replace("3 atom types", "2 atom types")
        .replace("3 39.948\n", "")
    )
    words = [f" # {label}" if label else "" for label in labels]
    text = text.replace("1 15.9994", f"1 9.9994{words[0]}").replace(
        "2 1.008", f"2 4.00794{words[1]}"
    )
    return text.replace("Masses", f"{section}Masses")


def test_lammps_atom_types_by_name(tmp_path):
    truth = Truth(["spce"] * 4, 12)
    text = repartitioned(truth)
    unreadable(
        r"atom types 1 \(9.9994 u\), 2 \(4.00794 u\) have masses .* \(1.008, 15.9994 u\): .*structure.atom_types",
        tmp_path,
        text,
        "a.data",
    )
    ways = [
        (text, {"1": "O", "2": "H"}),
        (text, {"1": "OW", "2": "HW1"}),
        (
            text.replace("2 4.00794\n", "2 4.00794 # He\n"),
            {"1": "O", "2": "H"},
        ),  # the scene counts for more
        (repartitioned(truth, ("O", "H")), None),
        (repartitioned(truth, ("OW", "HW2")), None),
        (repartitioned(truth, section="Atom Type Labels\n\n1 OW\n2 HW1\n\n"), None),
    ]
    helium = ion("He", 4.0026)  # weighs as much as this hydrogen, and counts for less than its name
    begun = repartitioned(
        truth, ("Oxygen", "HW")
    )  # names that only begin like elements count for less than masses
    for file, atom_types, others in [(*way, [helium]) for way in ways] + [(begun, None, [])]:
        found = read(tmp_path, file, "a.data", ["spce", *others], atom_types=atom_types)
        same_molecules(found, truth, 1e-6)
        assert any(
            "masses of the scene are used, not the masses in the file" in note
            for note in found.notes
        )
    found = read(tmp_path, text.replace("9.9994", "15.9994").replace("4.00794", "1.008"), "a.data")
    assert not any("masses" in note for note in found.notes)
    heavy = with_masses(SPECIES["spce"], {"O": 9.9994, "H": 4.00794})
    assert (
        len(read(tmp_path, text, "a.data", [heavy]).species) == 4
    )  # or by masses that the scene has too


def test_lammps_atom_types_without_masses_and_with_massless_sites(tmp_path):
    truth = Truth(["tip4p2005", "argon", "tip4p2005"], 12)
    text = lammps(truth, "x, units = real", 1.0).replace("3 atom types", "4 atom types")
    begin, end = text.index("Masses"), text.index("Atoms #")
    text = text[:begin] + text[end:]
    numbers = {"O": 1, "H": 2, "X": 3, "Ar": 4}
    for i, (_, element, *_) in enumerate(truth.atoms(), 1):
        text = re.sub(
            rf"^({i} \d+) \d+ 0.0 ", rf"\1 {numbers[element]} 0.0 ", text, flags=re.MULTILINE
        )
    unreadable(
        r"no section Masses.*name its atom types by structure.atom_types",
        tmp_path,
        text,
        "a.data",
        ["tip4p2005", "argon"],
    )
    for massless in ("MW", "X"):
        atom_types = {"1": "O", "2": "H", "3": massless, "4": "Ar"}
        found = read(tmp_path, text, "a.data", ["tip4p2005", "argon"], atom_types=atom_types)
        same_molecules(found, truth, 1e-6, ["tip4p2005", "argon"])


@pytest.mark.parametrize(
    ("atom_types", "message"),
    [
        ({"1": "O"}, r"structure.atom_types has no name for type 2"),
        (
            {"1": "O", "2": "H", "7": "H", "OW": "O"},
            r"structure.atom_types: unknown type 7, OW; there are 1, 2",
        ),
        (
            {"1": "O", "2": "hw1"},
            r"structure.atom_types.2 = 'hw1' is not a site or element .* there are OW, HW1, HW2, O, H; did you mean HW1\?",
        ),
        ({"1": "H", "2": "O"}, r"molecule 1 .* has atoms H O2, expected spce \(O H2\)"),
    ],
)
def test_atom_types_that_do_not_fit_the_file(atom_types, message, tmp_path):
    unreadable(message, tmp_path, repartitioned(WATERS), "a.data", atom_types=atom_types)


def test_atom_types_of_a_scene(tmp_path):
    (tmp_path / "a.data").write_text(repartitioned(Truth(["spce"] * 8, 5)))
    structure = {"file": "a.data", "atom_types": {"1": "O", "2": "H"}}
    scene = small_scene(
        {},
        None,
        tmp_path,
        molecules=[{"model": "spce"}],
        box={},
        structure=structure,
        forces={"cutoff_A": 6.0},
    )
    assert len(build(scene).model.species) == 8


def test_lammps_sites_of_almost_no_mass(tmp_path):
    truth = Truth(["tip4p2005"] * 3, 12)
    text = lammps(truth, "x, units = real", 1.0).replace("3 39.948", "3 1e-10")
    found = read(tmp_path, text, "a.data", ["tip4p2005"])
    same_molecules(found, truth, 1e-6, ["tip4p2005"])
    assert found.notes == ()


WATER_DATA = Truth(["spce"] * 8, 23)
LABELS = ("OW", "HW")
DATA = {
    "no style, molecular": data_of(WATER_DATA, "molecular", header="Atoms\n\n"),
    "no style, charge": data_of(WATER_DATA, "charge", header="Atoms\n\n"),
    "no style, atomic": data_of(WATER_DATA, "atomic", header="Atoms\n\n"),
    "no empty line": data_of(WATER_DATA, "full", header="Atoms\n"),
    "columns as comment": data_of(WATER_DATA, header="Atoms  # id mol type q x y z\n\n"),
    "long names of columns": data_of(
        WATER_DATA, header="Atoms  # atom-ID molecule-ID atom-type q x y z\n\n"
    ),
    "upper case": data_of(WATER_DATA, header="Atoms # Full\n\n"),
    "hybrid": data_of(WATER_DATA, "hybrid full"),
    "sphere": data_of(WATER_DATA, "sphere"),
    "comments": data_of(WATER_DATA, head="# a comment\n")
    .replace("24 atoms", "24 atoms  # all of them")
    .replace("xlo xhi", "xlo xhi # Å"),
    "indented": "\n".join(f"  {line}" for line in data_of(WATER_DATA).splitlines()),
    "labels of masses": data_of(WATER_DATA, types=LABELS, masses="OW 15.9994\nHW 1.008"),
    "labels everywhere": data_of(
        WATER_DATA,
        types=LABELS,
        masses="OW 15.9994\nHW 1.008",
        header="Atom Type Labels\n\n1 OW\n2 HW\n\nAtoms # full\n\n",
    ),
    "labels of atoms": data_of(
        WATER_DATA, types=LABELS, header="Atom Type Labels\n\n1 OW\n2 HW\n\nAtoms # full\n\n"
    ),
    "labels without masses": data_of(WATER_DATA, types=LABELS, masses=""),
    "exponents": data_of(WATER_DATA).replace(".0000000000", "D+00"),
}


#: Tilts xy, xz, yz of LAMMPS' boxes: the extremes of the bounds of dumps are at different corners.
TILTS = [None, (3.0, -2.0, 4.0), (3.0, 2.0, 4.0), (-3.0, -2.0, -4.0), (-3.0, 5.0, -4.0)]


@pytest.mark.parametrize("case", DATA)
def test_lammps_data_as_people_write_it(case, tmp_path):
    names = ["a.data", "data.spce", "water.dat", "input_structure_data.spce", "a.data.gz"]
    name, content = names[list(DATA).index(case) % len(names)], DATA[case].encode()
    content = gzip.compress(content) if name.endswith(".gz") else content
    found = read(tmp_path, content, name)
    same_molecules(found, WATER_DATA, 1e-8)
    assert found.notes == ()


@pytest.mark.parametrize("tilts", TILTS[1:])
@pytest.mark.parametrize("bounds", [(0.0, 0.0, 0.0), (-5.0, 2.0, 31.0)])
@pytest.mark.parametrize("general", [False, True])
def test_tilted_boxes_of_lammps_data(tilts, bounds, general, tmp_path):
    """By bounds and tilts, or by three edges; split atoms are in the box."""
    xy, xz, yz = tilts
    truth = Truth(["spce"] * 8, 23, cell=[[15.0, 0, 0], [xy, 16.0, 0], [xz, yz, 17.0]])
    truth.centre += bounds
    text = data_of(truth)
    box = re.search(r"0 .* xlo xhi\n.*\n.* zlo zhi\n", text)[0]
    lines = [
        f"{low} {low + edge} {axis}lo {axis}hi\n"
        for low, edge, axis in zip(bounds, (15, 16, 17), "xyz", strict=True)
    ]
    lines.append(f"{xy} {xz} {yz} xy xz yz\n")
    if general:
        lines = [
            f"{' '.join(map(str, edge))} {name}vec\n"
            for edge, name in zip(truth.cell, "abc", strict=True)
        ]
    found = read(tmp_path, text.replace(box, "".join(lines)), "a.data")
    assert found.cell == pytest.approx(truth.cell)
    same_molecules(found, truth, 1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            data_of(WATER_DATA, "sphere", header="Atoms\n\n"),
            r"line 16: the meaning of the 7 columns .* 'Atoms # molecular'",
        ),
        (
            data_of(WATER_DATA, "molecular", header="Atoms # full\n\n"),
            r"line 16: an atom of style 'full' has 7 columns .*, found 6",
        ),
        (data_of(WATER_DATA).replace("24 atoms\n", ""), "has no line with the number of atoms"),
        (
            data_of(WATER_DATA).replace("24 atoms\n", "23 atoms\n"),
            "line 3 promises 23 atoms, the section Atoms has 24",
        ),
        (
            data_of(WATER_DATA).replace("2 1.008", "3 1.008"),
            "its section Masses has no mass of type 2",
        ),
        (
            data_of(WATER_DATA).replace("2 1.008", "2 light"),
            "line 12: expected a type and its mass, found 'light'",
        ),
        (data_of(WATER_DATA, masses=""), "has no section Masses"),
        (data_of(WATER_DATA) + "25 9 1\n", "line 3 promises 24 atoms, the section Atoms has 25"),
        (
            data_of(WATER_DATA, header="Atoms # bond\n\n"),
            "line 16: an atom of style 'bond' has 6 columns .*, found 7",
        ),
        (
            data_of(WATER_DATA).replace("\n3 1 2 ", "\n3 x 2 "),
            r"line 17: expected an atom .id mol type q x y z., found '3 x 2",
        ),
        (data_of(WATER_DATA).replace("xlo xhi", "xlo"), "a line 'LOW HIGH xlo xhi' is missing"),
    ],
)
def test_lammps_data_that_cannot_be_read_state_where(text, message, tmp_path):
    unreadable(message, tmp_path, text, "a.data")


def test_images_of_lammps_atoms(tmp_path):
    """They are added along the edges: a molecule is whole by them as well."""
    truth = Truth(["spce"] * 8, 24, cell=[[15.0, 0, 0], [3.0, 16.0, 0], [-2.0, 4.0, 17.0]])
    lines = data_of(truth).replace("zlo zhi\n", "zlo zhi\n3.0 -2.0 4.0 xy xz yz\n").split("\n")
    first = lines.index("Atoms # full") + 1
    lines[first : first + 24] = [f"{line} 1 -2 3" for line in lines[first : first + 24]]
    found = read(tmp_path, "\n".join(lines), "a.data")
    assert found.cell == pytest.approx(truth.cell)
    partner = same_molecules(found, truth, 1e-7)
    assert found.position == pytest.approx(
        truth.centre[partner] + np.array([1, -2, 3]) @ truth.cell, abs=1e-6
    )


@pytest.mark.parametrize(
    "columns",
    [
        "id type x y z",
        "id mol type xs ys zs",
        "id element xu yu zu",
        "id type element mass x y z",
        "id type mass xs ys zs",
        "type x y z",
        "id type vx vy vz x y z",
        "id typelabel xs ys zs",
        "id type typelabel x y z",
        "id label xu yu zu",
    ],
)
@pytest.mark.parametrize("tilts", TILTS)
def test_lammps_dumps(columns, tilts, tmp_path):
    xy, xz, yz = tilts or (0.0, 0.0, 0.0)
    truth = Truth(["tip4p2005"] * 8, 25, cell=[[15.0, 0, 0], [xy, 16.0, 0], [xz, yz, 17.0]])
    second = Truth(["tip4p2005"] * 5, 26)
    content = (dump_of(truth, columns, units="real") + dump_of(second, columns)).encode()
    file = ("dump.water", content) if tilts else ("a.lammpstrj.gz", gzip.compress(content))
    name, content = file
    told = not {"element", "mass", "label", "typelabel"} & set(columns.split())
    types, species = {"1": "O", "2": "H", "3": "MW"} if told else None, ["tip4p2005"]
    for frame, there in ((1, truth), (2, second)):
        found = read(tmp_path, content, name, species, frame=frame, atom_types=types)
        partner = same_molecules(found, there, 1e-6, species)
        assert found.cell == pytest.approx(there.cell, abs=1e-6)
        if "vx" in columns:
            assert found.velocity == pytest.approx(there.velocity[partner], abs=1e-6)
        assert not any("left out" in note or "missing" in note for note in found.notes)
    if told:
        message = r"has only types of atoms.*structure.atom_types"
        unreadable(message, tmp_path, content, name, species, frame=1)


@pytest.mark.parametrize(
    "columns", ["id typelabel x y z", "id type typelabel x y z", "id label x y z"]
)
def test_labels_of_a_dump_are_named_by_atom_types(columns, tmp_path):
    text = dump_of(WATER_DATA, columns).replace(" OW ", " water_O ").replace(" HW ", " +h ")
    unreadable(
        r"has atoms named .h, water_O, .* structure.atom_types gives them names",
        tmp_path,
        text,
        "a.dump",
    )
    found = read(tmp_path, text, "a.dump", atom_types={"water_O": "O", "+h": "H"})
    same_molecules(found, WATER_DATA, 1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("ITEM: ATOMS id type x y z", "ITEM: ATOMS id type q"),
            "line 9: has no columns of coordinates",
        ),
        (
            ("ITEM: NUMBER OF ATOMS\n24", "ITEM: NUMBER OF ATOMS\n25"),
            "line 4 promises 25 atoms, 24 are there",
        ),
        (
            ("ITEM: ATOMS id type x y z", "ITEM: ATOMS id type x y z ix"),
            "line 10: expected 6 columns",
        ),
        (
            ("ITEM: ATOMS id type x y z", "ITEM: ATOMS id q x y z"),
            "line 9: has no column that names its atoms: type, typel",
        ),
        (
            ("ITEM: NUMBER OF ATOMS", "ITEM: NUMBER"),
            "line 1: expected ITEM: NUMBER OF ATOMS, BOX BOUNDS and ATOMS",
        ),
        (("pp pp pp", "pp pp ff"), "its cell is periodic along a, b only"),
    ],
)
def test_lammps_dumps_that_cannot_be_read_state_where(change, message, tmp_path):
    text = dump_of(WATER_DATA, "id type x y z")
    assert change[0] in text
    unreadable(
        message, tmp_path, text.replace(*change), "a.lammpstrj", atom_types={"1": "O", "2": "H"}
    )


def test_velocities_of_a_dump_without_units_are_not_used(tmp_path):
    found = read(tmp_path, dump_of(WATER_DATA, "id element x y z vx vy vz"), "a.dump")
    assert found.velocity is None
    assert found.notes == (
        "it does not name its units (dump_modify units yes): its velocities are not used",
    )


def test_a_column_that_a_dump_names_twice(tmp_path):
    truth = Truth(["tip4p2005"] * 2, 12)
    text = dump_of(truth, "id element x y z").replace("element x y z", "element x y z x id")
    unreadable("line 9: names the column id, x twice", tmp_path, text, "a.lammpstrj", ["tip4p2005"])


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (
            "Atom Type Labels\n\n1 O 5\n2 H\n\nMasses",
            "expected a type and its label, found '1 O 5'",
        ),
        ("Velocities\n\n77 1 0 0\n\nMasses", "expected the velocities of an atom of the file"),
    ],
)
def test_rows_of_lammps_data_that_belong_to_nothing(section, message, tmp_path):
    text = lammps(Truth(["spce", "argon"], 12), "x, units = real", 1.0)
    unreadable(message, tmp_path, text.replace("Masses", section, 1), "a.data", ["spce", "argon"])
