"""Structure files of any format: frames, encodings, packed files, damaged files."""

import bz2
import codecs
import gzip
import io
import lzma

import ase
import ase.build
import ase.io
import numpy as np
import pytest
from support.structures import (
    GRO,
    NAMES,
    WATERS,
    Truth,
    cif,
    cryst1,
    data_of,
    dump_of,
    lammps,
    pdb,
    read,
    same_molecules,
    unreadable,
)


def frames_of(ending, truths):
    if ending == "gro":
        return "".join(t.gro() for t in truths)
    if ending == "xyz":
        return "".join(t.xyz(names=NAMES[0]) for t in truths)
    models = [f"MODEL {k}\n{pdb(t.atoms(), '')}TER\nENDMDL\n" for k, t in enumerate(truths, 1)]
    return cryst1(truths[0].cell) + "\n" + "".join(models) + "END\n"


@pytest.mark.parametrize("ending", ["gro", "xyz", "pdb"])
def test_one_of_several_frames(ending, tmp_path):
    truths = [Truth(["spce"] * n, n) for n in (2, 3, 4)]
    text = frames_of(ending, truths)
    for frame, truth in ((1, truths[0]), (2, truths[1]), (-1, truths[2])):
        found = read(tmp_path, text, f"a.{ending}", frame=frame)
        same_molecules(found, truth, 0.02)
        assert np.diag(found.cell) == pytest.approx(np.diag(truth.cell), abs=2e-3)
    unreadable(
        r"holds 3 structures.*select one by structure.frame .1 to 3, -1 for the last",
        tmp_path,
        text,
        f"a.{ending}",
    )
    unreadable(
        r"structure.frame is 4: it holds 3, 1 is the first and -1 the last",
        tmp_path,
        text,
        f"a.{ending}",
        frame=4,
    )
    one = read(
        tmp_path, frames_of(ending, truths[:1]), f"b.{ending}"
    )  # a single MODEL is not a choice
    assert len(one.species) == 2


@pytest.mark.parametrize("ending", ["gro", "xyz", "pdb"])
@pytest.mark.parametrize("gap", ["\n", "   \n\n"])
def test_frames_with_empty_lines_between_them(ending, gap, tmp_path):
    truths = [Truth(["spce"] * n, n) for n in (2, 3, 4)]
    text = gap + gap.join(frames_of(ending, [truth]) for truth in truths) + gap
    for frame in (1, 2, -1):
        found = read(tmp_path, text, f"a.{ending}", frame=frame)
        same_molecules(found, truths[frame - (frame > 0)], 0.02)
    unreadable(r"holds 3 structures", tmp_path, text, f"a.{ending}")
    unreadable(
        r"line \d+: expected the number of atoms|is truncated|promises|no atoms",
        tmp_path,
        f"{text}nonsense\nnonsense\nnonsense\n" if ending != "pdb" else "nonsense",
        f"b.{ending}",
    )


def text_in(ending) -> str:
    truth = Truth(["spce"] * 4, 29)
    if ending in ("cif", "vasp"):
        written = io.BytesIO() if ending == "cif" else io.StringIO()
        ase.io.write(written, truth.ase(), format=ending)
        text = written.getvalue()
        return text.decode() if ending == "cif" else text
    if ending == "data":
        return data_of(truth)
    if ending == "dump":
        return dump_of(truth, "id element x y z")
    return frames_of(ending, [truth])


@pytest.mark.parametrize("ending", ["gro", "xyz", "pdb", "data", "dump", "cif", "vasp"])
@pytest.mark.parametrize("how", ["utf-8-sig", "utf-16", "utf-16-be", "crlf", "gz", "bz2", "xz"])
def test_marks_of_encodings_and_packed_files(ending, how, tmp_path):
    """They change nothing, and take no atom."""
    text, cell = text_in(ending), np.diag([14.0, 15.0, 16.0])
    plain = read(tmp_path, text, f"plain.{ending}", cell=cell)
    pack = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}
    name = f"a.{ending}"
    if how in pack:
        name, content = f"{name}.{how}", pack[how](text.encode())
    elif how == "crlf":
        content = text.replace("\n", "\r\n")
    else:
        content = (codecs.BOM_UTF16_BE if how == "utf-16-be" else b"") + text.encode(how)
    found = read(tmp_path, content, name, cell=cell)
    assert found.position == pytest.approx(plain.position)
    assert len(found.species) == 4
    assert found.notes == plain.notes


def test_a_packed_file_that_is_damaged(tmp_path):
    for name, content in (
        ("a.xyz.gz", b"no gzip"),
        ("b.xyz.bz2", bz2.compress(b"3\n")[:-4]),
        ("c.xyz.xz", b"x"),
        ("d.xyz.gz", gzip.compress(GRO.encode())[:-9]),
    ):
        unreadable("cannot be unpacked", tmp_path, content, name)


@pytest.mark.parametrize("name", ["water", "water.dat", "water.txt", "water.foo", "conf.1"])
@pytest.mark.parametrize("ending", ["gro", "xyz", "pdb", "data", "dump"])
def test_a_format_is_known_by_how_a_file_begins(name, ending, tmp_path):
    found = read(tmp_path, text_in(ending), name, cell=np.diag([14.0, 15.0, 16.0]))
    assert len(found.species) == 4


def cut(text, lines):
    return "\n".join(text.splitlines()[:lines]) + "\n"


DAMAGED = {
    "cut.gro": (cut(GRO, 8), r"line 2 promises 12 atoms and a box, 5 are there: truncated\?"),
    "cut_in_line.gro": (
        cut(GRO, 13) + GRO.splitlines()[13][:30] + "\n1 1 1\n",
        r"line 14: expected an atom of a .gro",
    ),
    "no_number.gro": (
        GRO.replace("\n12\n", "\ntwelve\n"),
        r"line 2: expected the number of atoms, found 'twelve'",
    ),
    "too_few.gro": (
        GRO.replace("\n12\n", "\n11\n"),
        r"line 14: expected the box, 3 or 9 numbers .is the number of atoms right",
    ),
    "no_box.gro": (cut(GRO, 14), r"promises 12 atoms and a box, 11 are there"),
    "box.gro": (
        cut(GRO, 14) + "1.4 1.5\n",
        r"line 15: expected the box, 3 or 9 numbers .*found '1.4 1.5'",
    ),
    "nan.gro": (
        GRO.replace(GRO.splitlines()[4][20:28], "     nan"),
        r"atom 3 has a position that is not a finite",
    ),
    "nan_box.gro": (
        cut(GRO, 14) + "1.4 nan 1.4\n",
        r"its box has an edge that is not a finite number",
    ),
    "empty.gro": ("", "holds no atoms"),
    "cut.pdb": (
        cryst1(WATERS.cell) + "\nATOM      1  O   HOH A   1       1.000   2.0\n",
        "line 2: expected an atom of a .pdb",
    ),
    "edges_only.pdb": (
        "CRYST1   14.000   15.000   16.000\n" + pdb(WATERS.atoms(), ""),
        "line 1: CRYST1 needs three",
    ),
    "alternate.pdb": (
        "ATOM      1  O  AHOH A   1       1.000   2.000   3.000\nATOM      2  O  BHOH A   1       1.000   2.000   3.100\n",
        "alternate locations A, B",
    ),
    "empty.pdb": ("END\n", "holds no atoms"),
    "cut.xyz": (cut(WATERS.xyz(), 9), "line 1 promises 12 atoms, 7 are there"),
    "lattice.xyz": (
        '3\nLattice="9 0 0 0 9 0 0"\nO 0 0 0\nH 0 0 0\nH 0 0 0\n',
        "line 2: expected nine numbers of Lattice",
    ),
    "columns.xyz": (
        "1\nProperties=species:S:1:pos:R:3:vel:R:3\nO 0 0 0\n",
        "line 3: expected 7 columns, species:S:1",
    ),
    "decimals.xyz": (
        "1\n\nO 0,1 0,2 0,3\n",
        "line 3: expected an atom of an .xyz: name, x, y, z, found",
    ),
    "nameless.xyz": (
        '1\nLattice="9 0 0 0 9 0 0 0 9" Properties=pos:R:3\n0 0 0\n',
        "has no atoms with mass",
    ),
    "empty.cif": (" \n", "holds no atoms: it is empty"),
    "words.xyz": (
        "3\n\nO a b c\nH 0 0 0\nH 0 0 0\n",
        "line 3: expected an atom of an .xyz: .* found 'a b c'",
    ),
    "cut.data": (
        cut(lammps(WATERS, "x", 1.0), 24),
        r"line 3 promises 12 atoms, 7 are there: truncated\?",
    ),
    "no_masses.data": (lammps(WATERS, "x", 1.0).replace("Masses", "Madness"), "no section Masses"),
    "cut.cif": (cut(cif(), 8), "holds no atoms"),
    "cut_in_atoms.cif": (
        cif()[:-12],
        r"line 9: this is not valid CIF: Wrong number of values in loop _atom_site",
    ),
    "binary.gro": ("\x00\x01", "line 2: expected the number of atoms"),
    "strange.foo": ("x", "format is unknown to ASE"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_get_a_message(name, tmp_path):
    text, message = DAMAGED[name]
    unreadable(message, tmp_path, text, name)
