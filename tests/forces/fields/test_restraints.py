"""Restraints of positions."""

from support.common import small_scene

from rigidmd.assemble.build import build


def test_restraints_hold_the_molecules_that_are_named():
    molecules = [{"model": "argon", "count": 5, "frozen": [5]}, {"model": "krypton", "count": 3}]
    restraints = [
        {"species": "krypton", "stiffness_kJ_mol_A2": 2.0, "position_A": [1.0, 2.0, 3.0]},
        {"species": "argon", "molecules": [2, 4], "stiffness_kJ_mol_A2": [0.0, 0.0, 3.0]},
        {"species": "argon", "stiffness_kJ_mol_A2": 1.0},
    ]
    system = build(small_scene({}, 30.0, molecules=molecules, fields={"restraints": restraints}))
    found = [system.terms[f"restraints_{k}"] for k in range(3)]
    assert [term.molecule.tolist() for term in found] == [[5, 6, 7], [1, 3], [0, 1, 2, 3]]
    assert (found[0].reference == [1.0, 2.0, 3.0]).all()
    assert (found[1].reference == system.state.position[[1, 3]]).all()
    assert found[1].stiffness.tolist() == [0, 0, 300]
