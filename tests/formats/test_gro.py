"""Files of GROMACS: .gro and .g96."""

import numpy as np
import pytest
from support.structures import (
    GRO,
    SPECIES,
    Truth,
    as_g96,
    as_gen,
    gro,
    read,
    same_molecules,
    unreadable,
)


@pytest.mark.parametrize("file", ["a.gro", "a.g96"])
@pytest.mark.parametrize("edge", [12000.0, 999999.0, 1.5e6])
def test_boxes_that_fill_their_columns(file, edge, tmp_path):
    """As GROMACS writes them, ten or fifteen characters to a number and no space between."""
    truth = Truth(["spce"] * 3, 5)
    cell = np.diag([edge, edge + 7.0, edge + 9.0])
    rows = truth.atoms()
    box = "".join(f"{x / 10:10.5f}" for x in np.diag(cell))
    atoms = [(name, x) for name, _, _, x, _ in rows]
    text = gro(rows, box) if file == "a.gro" else as_g96(atoms, cell)
    found = read(tmp_path, text, file)
    assert found.cell == pytest.approx(cell)
    assert len(found.species) == 3


def test_columns_of_a_gro_that_are_too_narrow(tmp_path):
    """Coordinates from 100,000 Å on move the following ones; velocities are three or none."""
    row = "    1ARG     Ar    1{}\n"
    head, box = "x\n    2\n" + row.format("   1.000   2.000   3.000"), "  30.0  30.0  30.0\n"
    for columns in ("10000.00012345.67810000.000", "10000.000   2.000   3.000"):
        unreadable(
            r"line 4: expected an atom of a \.gro with coord",
            tmp_path,
            head + row.format(columns) + box,
            "a.gro",
            ["argon"],
        )
    for columns in ("  1.0000", "  1.0000  2.0000"):
        text = head + row.format("   4.000   5.000   6.000" + columns) + box
        unreadable("line 4: expected three velocities or none", tmp_path, text, "a.gro", ["argon"])


def test_further_digits_and_velocities_of_a_gro(tmp_path):
    truth = Truth(["tip4p2005"] * 5, 8)
    species = [SPECIES["tip4p2005"]]
    for digits, error in ((3, 0.02), (6, 2e-5), (9, 2e-8)):
        found = read(
            tmp_path,
            truth.gro(digits=digits, velocities=True),
            "a.gro",
            species,
        )
        same_molecules(found, truth, error, species)
        assert found.velocity == pytest.approx(truth.velocity, abs=2 * error)
        # of inertia below 3 u Å² and arms below 1 Å
        assert found.angular_momentum_body == pytest.approx(
            truth.angular_momentum_body(), abs=40 * error
        )


def test_velocities_and_frames_of_g96(tmp_path):
    truths = [Truth(["spce"] * 3, seed) for seed in (43, 44)]
    texts = []
    for truth in truths:
        atoms = truth.atoms()
        rows = [(name, tuple(x)) for name, _, _, x, _ in atoms]
        texts.append(as_g96(rows, truth.cell, [v for *_, v in atoms]))
    text = texts[0] + "TIMESTEP\n 5 0.01\nEND\n" + texts[1].replace("TITLE\nwater\nEND\n", "")
    unreadable("holds 2 structures", tmp_path, text, "a.g96")
    for frame, truth in ((1, truths[0]), (2, truths[1])):
        found = read(tmp_path, text, "a.g96", frame=frame)
        partner = same_molecules(found, truth, 1e-4)
        assert found.velocity == pytest.approx(truth.velocity[partner], abs=1e-4)
    for old, new, message in (
        ("BOX", "BOX\n1 2 3 4", "expected the box, 3 or 9 numbers"),
        (
            "    1 MIX   OW         1",
            "    1                   ",
            "expected residue number, residue name, atom name",
        ),
        ("END\nBOX", "BOX", "three numbers of VELOCITY from column 25"),
    ):
        unreadable(message, tmp_path, texts[0].replace(old, new), "a.g96")
    unreadable(
        "its block POSITION has no END: truncated",
        tmp_path,
        texts[0][: texts[0].index("END\nVEL")],
        "a.g96",
    )
    unreadable(
        "names an atom Zz, but ASE, which reads this format, knows elements only",
        tmp_path,
        as_gen([("Zz", (0, 0, 0))], np.diag([9.0] * 3)),
        "a.gen",
    )


def test_titles_in_any_encoding(tmp_path):
    titled = GRO.replace("t\n", "Gefrierpunkt 0 °C\n", 1).encode("latin-1")
    assert len(read(tmp_path, titled, "a.gro").species) == 4
    unreadable("line 2: expected the number of atoms", tmp_path, b"\xff\xfe\x00\x80", "a.gro")
