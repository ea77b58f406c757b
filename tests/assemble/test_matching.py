"""Molecules of a structure file are matched with molecules of the scene in any order of atoms."""

import dataclasses
import re

import ase
import ase.build
import ase.io
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.structures import (
    NAMES,
    SPECIES,
    Truth,
    gro,
    read,
    same_molecules,
    unreadable,
    wrapped,
    xyz,
)

from rigidmd.mechanics.rotation import random_rotations
from rigidmd.scene.models import Molecule, Site, load_model, molecule


@pytest.mark.parametrize("names", NAMES, ids=lambda names: "-".join(names.values()))
@pytest.mark.parametrize("ending", ["gro", "pdb", "xyz"])
@pytest.mark.parametrize(
    ("there", "wanted"), [("spce", "spce"), ("tip4p2005", "tip4p2005"), ("tip4p2005", "spce")]
)
def test_names_of_water(names, ending, there, wanted, tmp_path):
    truth = Truth([there] * 8)
    atoms = truth.atoms()
    if ending == "gro":
        text, error = truth.gro(atoms, names=names), 0.02
    elif ending == "pdb":
        text, error = truth.pdb(atoms, names, element_column=False), 0.002
    else:
        text, error = truth.xyz(atoms, names), 1e-8
    found = read(tmp_path, text, f"a.{ending}", (wanted,))
    if there == wanted:
        same_molecules(found, truth, error, [SPECIES[wanted]])
        assert found.notes == ()
    else:
        assert len(found.species) == 8
        assert any("8 sites without mass" in note and "left out" in note for note in found.notes)


def without_massless(truth):
    return truth.atoms(massless=False)


def hydrogens_first(truth):
    return sorted(truth.atoms(massless=False), key=lambda atom: (atom[2], atom[1] != "H"))


def oxygens_of_all_first(truth):
    return sorted(truth.atoms(massless=False), key=lambda atom: (atom[1] != "O", atom[0]))


def between_the_oxygens(truth):
    return sorted(
        truth.atoms(massless=False), key=lambda atom: (atom[2], "HW1 OW HW2".index(atom[0]))
    )


@pytest.mark.parametrize(
    "order", [without_massless, hydrogens_first, oxygens_of_all_first, between_the_oxygens]
)
@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("ending", ["gro", "gro without residues", "pdb", "xyz", "cif"])
def test_order_of_atoms(order, split, ending, tmp_path):
    truth = Truth(["tip4p2005"] * 9, 1)
    atoms = order(truth)
    if split:
        atoms = wrapped(atoms, truth.cell)
    species, error = [SPECIES["tip4p2005"]], 1e-7
    if ending == "xyz":
        text = truth.xyz(atoms)
    elif ending == "pdb":
        text, error = truth.pdb(atoms), 0.002
    elif ending == "cif":
        plain = truth.ase(atoms)
        ase.io.write(tmp_path / "b.cif", plain)
        text = (tmp_path / "b.cif").read_text()
    else:
        text = truth.gro(atoms, digits=9, residues=ending == "gro")
    found = read(tmp_path, text, f"a.{ending.split()[0]}", species)
    same_molecules(found, truth, error, species)
    assert any(
        "9 sites without mass are missing in the file (tip4p2005): built" in note
        for note in found.notes
    )
    if order is oxygens_of_all_first and ending in ("gro", "pdb"):
        assert any("found by bonding distance" in note for note in found.notes)


@pytest.mark.parametrize("ending", ["gro", "pdb", "xyz"])
def test_ions_among_waters(ending, tmp_path):
    truth = Truth(["spce", "sodium", "chloride", "spce", "chloride"], 2)
    upper = {"Na": "NA", "Cl": "CL"} | {name: name for name in ("OW", "HW1", "HW2")}
    species = [SPECIES[name] for name in ("spce", "sodium", "chloride", "nitrogen")]
    text = {
        "gro": truth.gro(names=upper, residue_names={1: "NA", 2: "CL", 4: "CL"}),
        "pdb": truth.pdb(names=upper, residue="MIX"),
        "xyz": truth.xyz(oxygens_of_all_first(truth)),
    }
    same_molecules(read(tmp_path, text[ending], f"a.{ending}", species), truth, 0.02, species)


def alike_by_name(molecule: Molecule, naming: str) -> Molecule:
    """The molecule with names that some of its sites share."""
    names = {
        "elements": molecule.elements,
        "hydrogens": [
            f"{e}{k}" if e not in ("H", "Cl") else e for k, e in enumerate(molecule.elements)
        ],
        "one": ["A"] * len(molecule.elements),
    }[naming]
    return dataclasses.replace(molecule, site_names=tuple(names))


@pytest.mark.parametrize("naming", ["elements", "hydrogens", "one"])
@pytest.mark.parametrize("order", ["as in the template", "shuffled within", "shuffled"])
@pytest.mark.parametrize("ending", ["gro", "pdb", "xyz"])
def test_sites_that_share_names(naming, order, ending, tmp_path):
    """Names decide only where they are unique; elements and geometry decide among the rest."""
    species = [
        alike_by_name(SPECIES[k], naming)
        for k in ("benzene", "tip4p2005", "tetrachloromethane", "chiral")
    ]
    truth = Truth(3 * species, 21, edges=(27.0, 28.0, 29.0))
    atoms, rng = truth.atoms(order == "as in the template"), np.random.default_rng(2)
    if order == "shuffled":
        rng.shuffle(atoms)
    elif order == "shuffled within":
        atoms = [
            atoms[i] for i in sorted(range(len(atoms)), key=lambda i: (atoms[i][2], rng.random()))
        ]
    called = {m.name: m.residue_names[0][:4] for m in species}
    if ending == "gro":  # only names give the element here
        if naming == "one":
            atoms = [(e, e, *rest) for _, e, *rest in atoms]
        residues = {k: called[m.name] for k, m in enumerate(truth.species)}
        text, error = truth.gro(atoms, 6, residue_names=residues), 2e-5
    elif ending == "pdb":
        text, error = truth.pdb(atoms, residue="MIX"), 2e-3
    else:
        text, error = truth.xyz(atoms), 1e-8
    same_molecules(read(tmp_path, text, f"a.{ending}", species), truth, error, species)


@pytest.mark.parametrize("named", ["A", "B"])
def test_a_unique_name_decides_between_sites_that_are_alike(named, tmp_path):
    """Whichever of the two ends of a symmetric molecule has the name of the charged end."""
    x = {"A": 1.16, "B": -1.16}
    sites = [
        Site(name=n, element="O", mass_u=16.0, position_A=(at, 0.0, 0.0)) for n, at in x.items()
    ]
    sites += [
        Site(name="C", element="C", mass_u=12.0, position_A=(0.0, y, 0.0)) for y in (0.7, -0.7)
    ]
    other = "B" if named == "A" else "A"
    rows = [("C", 5, 5.7, 5), (named, 6.16, 5, 5), ("C", 5, 4.3, 5), (other, 3.84, 5, 5)]
    atoms = [(name, "", 0, np.array(place, float), None) for name, *place in rows]
    found = read(
        tmp_path,
        gro(atoms, "2 2 2", 6),
        "a.gro",
        [molecule("m", tuple(sites), residue_names=("SOL",))],
    )
    assert found.residual_max < 1e-4
    model = molecule("m", tuple(sites))
    a = found.position[0] + found.rotation[0] @ model.positions_body[model.site_names.index("A")]
    assert a == pytest.approx([6.16 if named == "A" else 3.84, 5, 5], abs=1e-4)


@pytest.mark.parametrize(
    "pair", [("isobutane", "trans-butane"), ("CH3CH2OH", "CH3OCH3"), ("left", "right")]
)
def test_isomers_and_mirror_images_among_each_other(pair, tmp_path):
    """For one composition, without names but the elements, every molecule in an order of its own."""

    def isomer(name):
        known = ase.build.molecule("isobutane" if name in ("left", "right") else name)
        if name in ("left", "right"):  # a twist makes it chiral
            x, _, z = known.positions.T
            known.positions[:, :2] += 0.35 * np.sin(np.stack([1.3 * z, 1.3 * z + x], axis=1))
            known.positions[:, 0] *= 1 if name == "left" else -1
        columns = zip(
            known.symbols, known.get_masses().tolist(), known.positions.tolist(), strict=True
        )
        sites = tuple(
            Site(name=e, element=e, mass_u=m, position_A=(x, y, z)) for e, m, (x, y, z) in columns
        )
        return molecule(name, sites)

    species = [isomer(name) for name in pair]
    truth = Truth(30 * species, 22, edges=(30.0, 31.0, 32.0))
    rng = np.random.default_rng(4)
    atoms = sorted(truth.atoms(), key=lambda atom: (atom[2], rng.random()))
    found = read(tmp_path, truth.xyz(atoms), "a.xyz", species)
    assert found.species.tolist() == 30 * [0, 1]
    same_molecules(found, truth, 1e-8, species)


def test_the_deviation_of_sites_that_share_names_is_that_of_their_best_order(tmp_path):
    truth = Truth([alike_by_name(SPECIES["benzene"], "elements")] * 2)
    atoms = [
        (n, e, k, x + ([0.5, 0, 0] if i == 11 else 0), v)
        for i, (n, e, k, x, v) in enumerate(truth.atoms())
    ]
    text = truth.gro(atoms[::-1], residue_names={0: "BNZ", 1: "BNZ"})
    unreadable(
        r"molecule 2 .* is not benzene: an atom is 0\.[34]\d\d Å from the rigid",
        tmp_path,
        text,
        "a.gro",
        truth.species[:1],
    )


def united_propene(names=("CH3", "CH", "CH2"), **values) -> Molecule:
    """CH3-CH=CH2 of united atoms, three of one element, whose ends differ by 0.2 Å. values: of the
    second end"""
    angle = np.radians(124.0)
    places = (
        (1.54, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (1.33 * float(np.cos(angle)), 1.33 * float(np.sin(angle)), 0.0),
    )
    epsilons = (98.0, 47.0, values.pop("epsilon_K", 85.0))
    masses = (15.035, 13.019, values.pop("mass_u", 14.027))
    sites = [
        Site(name=name, element="C", mass_u=m, position_A=x, sigma_A=3.7, epsilon_K=e)
        for name, m, x, e in zip(names, masses, values.pop("places", places), epsilons, strict=True)
    ]
    return molecule("propene", tuple(sites), residue_names=("PPE",))


@pytest.mark.parametrize("names", [("CH3", "CH", "CH2"), ("C", "C", "C")])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2), (1, 2, 0)])
@pytest.mark.parametrize("digits", [10, 3])
def test_the_best_order_is_taken(names, order, digits, tmp_path):
    """In all orders of the atoms the molecules are the same, in the digits of a .gro too."""
    kind = united_propene(names)
    truth = Truth([kind] * 6, 31)
    atoms = truth.atoms()
    atoms = [
        ("C", "C", k, x.round(digits), v)
        for first in range(0, 18, 3)
        for i in order
        for _, _, k, x, v in [atoms[first + i]]
    ]
    found = read(tmp_path, truth.xyz(atoms), "a.xyz", [kind])
    partner = same_molecules(found, truth, 2 * 10.0**-digits, [kind])
    ends = found.position[:, None] + np.einsum("nij,sj->nsi", found.rotation, kind.positions_body)
    there = truth.centre[:, None] + np.einsum("nij,sj->nsi", truth.rotation, kind.positions_body)
    assert np.abs(ends - there[partner]).max() < 5 * 10.0**-digits  # each site at its own position
    assert found.notes == ()


def test_orders_are_the_best_of_all(tmp_path):
    """Molecules that are bent, in random orders of the atoms: no order of those of one element fits
    better."""
    from itertools import permutations, product

    rng = np.random.default_rng(5)
    for name in ("CH3CH2OH", "C3H4_C2v", "CH3NO2", "NH3", "CH4", "C4H4O"):
        known = ase.build.molecule(name)
        columns = zip(
            known.symbols, known.get_masses().tolist(), known.positions.tolist(), strict=True
        )
        kind = molecule(
            name,
            tuple(Site(name=e, element=e, mass_u=m, position_A=tuple(x)) for e, m, x in columns),
        )
        elements = np.array(kind.elements)
        parts = [np.flatnonzero(elements == e) for e in dict.fromkeys(kind.elements)]
        for width in (0.02, 0.04):
            truth = Truth([kind], int(rng.integers(1000)))
            atoms = [
                (n, e, k, x + width * rng.standard_normal(3), v) for n, e, k, x, v in truth.atoms()
            ]
            rng.shuffle(atoms)
            points = np.array(
                [x for *_, x, _ in sorted(atoms, key=lambda atom: kind.elements.index(atom[1]))]
            )
            least = np.inf
            template = np.concatenate(parts)
            body, masses = kind.positions_body[template], kind.masses[template]
            for orders in product(*(permutations(range(len(part))) for part in parts)):
                first = np.cumsum([0, *(len(part) for part in parts)])
                order = np.concatenate(
                    [f + np.array(o) for f, o in zip(first[:-1], orders, strict=True)]
                )
                at = points[order] - masses @ points[order] / masses.sum()
                u, _, vt = np.linalg.svd((masses[:, None] * at).T @ body)
                u[:, 2] *= np.linalg.det(u @ vt)
                least = min(least, np.sqrt(((at - body @ (u @ vt).T) ** 2).sum(axis=1).mean()))
            found = read(tmp_path, truth.xyz(atoms), "a.xyz", [kind])
            assert found.residual_rms <= 1.2 * least + 1e-4 * kind.radius, (name, width)


def test_orders_that_fit_equally_well_are_named(tmp_path):
    """Ends of one distance: where their parameters differ, the file decides by its order, and a
    note names it."""
    places = ((1.4, 0.0, 0.0), (0.0, 0.0, 0.0), (-0.7, 1.4 * np.sqrt(0.75), 0.0))
    for values, noted in (
        ({"epsilon_K": 98.0, "mass_u": 15.035}, False),
        ({"mass_u": 15.035}, True),
    ):
        kind = united_propene(("A", "B", "C"), places=places, **values)
        truth = Truth([kind] * 4, 32)
        for order in ((0, 1, 2), (2, 1, 0)):
            atoms = truth.atoms()
            atoms = [("C", "C", *atoms[first + i][2:]) for first in range(0, 12, 3) for i in order]
            found = read(tmp_path, truth.xyz(atoms), "a.xyz", [kind])
            assert found.residual_max < 1e-6
            ends = found.position + found.rotation @ kind.positions_body[0]
            assert (
                ends == pytest.approx(np.array([x for *_, x, _ in atoms[::3]]), abs=1e-6)
                or not noted
            )
            wanted = "4 molecules of propene: two orders of its atoms, in which different sites are exchanged"
            assert any(note.startswith(wanted) for note in found.notes) == noted
    named = [(n, "C", k, x, v) for n, _, k, x, v in truth.atoms()]
    text = truth.gro(named, 6, residue_names=dict.fromkeys(range(4), "PPE"))
    assert read(tmp_path, text, "a.gro", [kind]).notes == ()  # names decide


@pytest.mark.parametrize(("along", "noted"), [(0.0, False), (0.2, True)])
def test_a_massless_charge_distinguishes_equal_atoms(along, noted, tmp_path):
    """Two equal atoms and a charge without mass: off the middle, each order is another molecule."""
    sites = [
        Site(name=name, element="N", mass_u=14.0, position_A=(x, 0.0, 0.0))
        for name, x in (("N1", 0.55), ("N2", -0.55))
    ]
    sites.append(Site(name="M", mass_u=0.0, charge_e=0.5, position_A=(along, 0.0, 0.0)))
    kind = molecule("dimer", tuple(sites))
    truth = Truth([kind] * 3, 34)
    atoms = [atom for atom in truth.atoms() if atom[0] != "M"]
    found = read(tmp_path, truth.xyz(atoms), "a.xyz", [kind])
    wanted = "3 molecules of dimer: two orders of its atoms, in which different sites are exchanged"
    assert any(note.startswith(wanted) for note in found.notes) == noted


def test_names_that_fit_less_well_than_elements_are_noted(tmp_path):
    """Another program has numbered the atoms in the other direction."""
    kind = united_propene(("C1", "C2", "C3"))
    truth = Truth([kind] * 4, 33)
    atoms = [
        ({"C1": "C3", "C2": "C2", "C3": "C1"}[n], e, k, x, v) for n, e, k, x, v in truth.atoms()
    ]
    text = truth.gro(atoms, 6, residue_names=dict.fromkeys(range(4), "PPE"))
    found = read(tmp_path, text, "a.gro", [kind])
    assert any(
        re.search(
            r"fits propene with 0\.1\d\d Å .rms., and another order of atoms with 0\.000 Å", n
        )
        for n in found.notes
    )


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    kinds=st.lists(
        st.sampled_from(
            ["spce", "tip4p2005", "nitrogen", "argon", "chiral", "benzene", "tetrachloromethane"]
        ),
        min_size=1,
        max_size=8,
    ),
    seed=st.integers(0, 2**31),
    slant=st.booleans(),
    mirrored=st.booleans(),
)
def test_rotated_shifted_wrapped_and_shuffled_atoms_are_the_same_molecules(
    kinds, seed, slant, mirrored, tmp_path
):
    kinds = [
        kind if kind != "tip4p2005" or "spce" not in kinds else "spce" for kind in kinds
    ]  # those two observation alike
    rng = np.random.default_rng(seed)
    cell = np.diag([17.0, 19.0, 21.0]) + (np.tril(rng.uniform(-8, 8, (3, 3)), -1) if slant else 0.0)
    truth = Truth(kinds, seed, cell=cell)
    rotation = random_rotations(rng, 1)[0]
    shift = rng.uniform(-50, 50, 3)
    atoms = [
        (name, e, k, (x + shift + rng.integers(-3, 4, 3) @ cell) @ rotation.T, v)
        for name, e, k, x, v in truth.atoms(False)
    ]
    rng.shuffle(atoms)
    written = cell @ rotation.T * ([[1], [1], [-1]] if mirrored else 1)
    species = [SPECIES[kind] for kind in sorted(set(kinds))]
    found = read(tmp_path, xyz(atoms, written), "a.xyz", species, periodic=not slant)
    truth.centre = truth.centre + shift
    same_molecules(found, truth, 1e-6, species)
    assert any("was rotated" in note for note in found.notes)
    if not slant:
        assert found.cell == pytest.approx(cell)


def test_molecules_of_a_triclinic_cell_are_made_whole(tmp_path):
    cell = [[12.0, 0, 0], [9.0, 11.0, 0], [-8.0, 7.0, 12.0]]
    truth = Truth(["spce"] * 8, 6, cell=cell)
    text = truth.xyz(truth.wrapped())
    same_molecules(read(tmp_path, text, "a.xyz", periodic=False), truth, 1e-6)
    atoms = truth.wrapped()
    plain = truth.ase(atoms)
    for name in ("b.gro", "b.cif", "b.lmp"):
        ase.io.write(
            tmp_path / name,
            plain,
            **({"format": "lammps-data", "masses": True} if name == "b.lmp" else {}),
        )
        found = read(tmp_path, (tmp_path / name).read_text(), name, periodic=False)
        assert found.residual_max < 0.02
        same_molecules(found, truth, 0.02)
    leaning = read(
        tmp_path, text, "a.xyz"
    )  # c lies on top of b: the same lattice by a cell that tilts less
    assert leaning.cell == pytest.approx(
        np.array([[12.0, 0, 0], [-3.0, 11.0, 0], [-5.0, -4.0, 12.0]])
    )
    assert any(
        "its lattice is given by the cell with edges 12.0000, 11.4018, 13.6015" in n
        for n in leaning.notes
    )
    same_molecules(leaning, truth, 1e-6)


def test_residuals_are_those_of_the_best_fit(tmp_path):
    from scipy.spatial.transform import Rotation

    truth = Truth(["spce", "nitrogen", "argon", "benzene", "spce"], 21)
    species = [SPECIES[name] for name in ("spce", "nitrogen", "argon", "benzene")]
    rng = np.random.default_rng(1)
    atoms = [
        (name, e, k, x + 0.02 * rng.standard_normal(3), v) for name, e, k, x, v in truth.atoms()
    ]
    found = read(tmp_path, truth.xyz(wrapped(atoms, truth.cell)), "a.xyz", species)
    squares = []
    for k, m in enumerate(truth.species):
        points = np.array([x for _, _, owner, x, _ in atoms if owner == k])
        points = points - m.masses @ points / m.mass
        if len(points) > 2:
            rotation, _ = Rotation.align_vectors(points, m.positions_body, weights=m.masses)
            points = rotation.inv().apply(points)
        else:  # along the axis, which SciPy finds not unique
            points = m.positions_body * np.linalg.norm(points[0]) / max(m.radius, 1e-9)
        squares += list(((points - m.positions_body) ** 2).sum(axis=1))
    assert found.residual_rms == pytest.approx(np.sqrt(np.mean(squares)))
    assert found.residual_max == pytest.approx(np.sqrt(np.max(squares)))


def test_a_mirror_image_is_another_molecule(tmp_path):
    truth = Truth(["chiral"] * 4, 7)
    mirrored = [(name, e, k, x * [-1, 1, 1], v) for name, e, k, x, v in truth.atoms()]
    unreadable(
        r"molecule 1 \(atoms 1 to 5, by bonding distance\) is not halothane: an atom is .* mirror image of halothane",
        tmp_path,
        truth.xyz(mirrored),
        "a.xyz",
        ["chiral"],
    )
    image = dataclasses.replace(
        SPECIES["chiral"],
        name="other_hand",
        positions_body=SPECIES["chiral"].positions_body * [-1, 1, 1],
    )
    found = read(tmp_path, truth.xyz(mirrored[:5] + truth.atoms()[5:]), "a.xyz", ["chiral", image])
    assert found.species.tolist() == [1, 0, 0, 0]


def test_a_mirror_image_within_the_tolerance_is_noted(tmp_path):
    """A molecule that is barely chiral: half of a racemic crystal fits, and less well than its
    mirror image does."""
    sites = [
        Site(name=e, element=e, mass_u=m, position_A=x)
        for e, m, x in (
            ("C", 12.0, (0.0, 0.0, 0.0)),
            ("O", 16.0, (1.5, 0.0, 0.0)),
            ("N", 14.0, (-0.5, 1.4, 0.0)),
            ("F", 19.0, (-0.5, -1.4, 0.25)),
        )
    ]
    kind = molecule("nearly_flat", tuple(sites))
    truth = Truth([kind] * 4, 34)
    atoms = [(n, e, k, x * ([-1, 1, 1] if k == 2 else 1), v) for n, e, k, x, v in truth.atoms()]
    found = read(tmp_path, truth.xyz(atoms), "a.xyz", [kind])
    assert found.residual_max > 0.05
    assert any(
        re.search(r"fits nearly_flat with 0\.\d+ Å .rms., and its mirror image with 0\.000 Å", n)
        for n in found.notes
    )
    assert read(tmp_path, truth.xyz(), "a.xyz", [kind]).notes == ()


def test_hydrogen_bonds_are_none_of_the_bonds_of_larger_atoms(tmp_path):
    """Waters 1.8 Å from each other, in a scene that has bonds of 1.94 Å between other elements."""
    rows = [("O", 0, 0, 0), ("H", 1, 0, 0), ("H", -1 / 3, 0.9428, 0)]
    rows += [("O", 2.8, 0, 0), ("H", 3.3774, 0.8165, 0), ("H", 3.3774, -0.8165, 0)]
    atoms = [("", e, 0, np.array([x, y, z]), None) for e, x, y, z in rows]
    atoms += [(name, e, k, x + 8, v) for name, e, k, x, v in Truth(["chiral"]).atoms()]
    found = read(tmp_path, xyz(atoms, np.diag([20.0] * 3)), "a.xyz", ["spce", "chiral"])
    assert found.species.tolist() == [0, 0, 1]


def rod(*labels: str, length=1.3) -> Molecule:
    """A straight chain of atoms."""
    masses = {"C": 12.011, "N": 14.007, "O": 15.999, "H": 1.008}
    sites = [
        Site(name=f"{e}{k}", element=e, mass_u=masses[e], position_A=(length * k, 0.0, 0.0))
        for k, e in enumerate(labels, 1)
    ]
    return molecule("rod", tuple(sites), residue_names=("ROD",))


#: Unit cells that are shorter than half of their molecules: upright, and with edges that tilt on
#: each other.
SHORT_CELLS = {
    "upright": [[7.0, 0, 0], [0, 5.0, 0], [0, 0, 6.0]],
    "leaning": [[5.0, 0, 0], [3.0, 6.0, 0], [-4.0, 5.0, 7.0]],
}


@pytest.mark.parametrize("cell", SHORT_CELLS)
@pytest.mark.parametrize("ending", ["xyz", "gro", "gro without residues", "cif"])
@pytest.mark.parametrize("shuffled", [False, True])
def test_molecules_longer_than_the_cell(cell, ending, shuffled, tmp_path):
    """They pass through faces more than once; no two of their atoms are nearest images but
    neighbours."""
    rng, cell = np.random.default_rng(3), np.array(SHORT_CELLS[cell])
    kind = rod("N", "C", "C", "C", "C", "O")
    for seed in range(
        100
    ):  # an orientation in which its atoms keep a distance from those of its images
        truth = Truth([kind], seed, cell=cell)
        at = np.array([x for *_, x, _ in truth.atoms()])
        images = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3), -1).reshape(-1, 3)
        images = images[(images != 0).any(axis=1)] @ cell
        if np.linalg.norm(at[:, None, None] - at[None, :, None] + images, axis=-1).min() > 2.2:
            break
    assert np.linalg.norm(at[-1] - at[0]) > np.linalg.norm(cell, axis=1).min()
    atoms = wrapped(truth.atoms(), cell)
    if shuffled:
        rng.shuffle(atoms)
    text, error = xyz(atoms, cell), 1e-6
    if ending == "cif":
        plain = ase.Atoms([a[1] for a in atoms], [a[3] for a in atoms], cell=cell, pbc=True)
        ase.io.write(tmp_path / "b.cif", plain)
        text, error = (tmp_path / "b.cif").read_text(), 1e-4
    elif ending.startswith("gro"):
        (a, _, _), (bx, by, _), (cx, cy, cz) = cell / 10
        box = " ".join(f"{x:.9f}" for x in (a, by, cz, 0, 0, bx, 0, cx, cy))
        text = gro(atoms, box, 9, residues="without" not in ending, residue_names={0: "ROD"})
    found = read(tmp_path, text, f"a.{ending.split()[0]}", [kind], repeat=(3, 3, 3))
    assert len(found.species) == 27
    assert found.residual_max < error
    one = read(tmp_path, text, f"a.{ending.split()[0]}", [kind], periodic=False)
    same_molecules(one, truth, 10 * error, [kind])


@pytest.mark.parametrize("elements", ["CC", "CCO"])
def test_polymers_are_not_molecules(elements, tmp_path):
    """A chain of which the cell has one repeat unit, whose atoms fit a template."""
    kind = rod(*elements)
    cell = np.diag([1.3 * len(elements), 8.0, 9.0])
    rows = [("", e, 0, np.array([1.3 * k + 0.4, 2.0, 3.0]), None) for k, e in enumerate(elements)]
    unreadable(
        r"molecule 1 .*\(C2( O)?\) is bonded to its own image .* a polymer",
        tmp_path,
        xyz(rows, cell),
        "a.xyz",
        [kind],
    )
    cell[0, 0] += 2.0  # molecules in a row
    assert len(read(tmp_path, xyz(rows, cell), "a.xyz", [kind]).species) == 1


@pytest.mark.parametrize("there", ["H", "D"])
@pytest.mark.parametrize("wanted", ["H", "D"])
@pytest.mark.parametrize("ending", ["gro", "pdb", "xyz"])
def test_heavy_water_starts_like_light(there, wanted, ending, tmp_path):
    truth = Truth(["spce"] * 3, 20)
    atoms = [(name, e.replace("H", there), k, x, v) for name, e, k, x, v in truth.atoms()]
    text = {
        "gro": truth.gro(atoms),
        "pdb": truth.pdb(atoms),
        "xyz": truth.xyz(atoms),
    }
    sites = [
        Site(**site | {"element": site["element"].replace("H", wanted)})
        for site in SPECIES["spce"].sites()
    ]
    water = molecule("spce", tuple(sites), residue_names=("SOL", "HOH"))
    found = read(tmp_path, text[ending], f"a.{ending}", [water])
    assert found.residual_max < 0.02


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("SOD", "na_spce"),
        ("POT", "k_spce"),
        ("CES", "cs_spce"),
        ("CLA", "cl_spce"),
        ("LIT", "li_spce"),
    ],
)
@pytest.mark.parametrize("named", [False, True])
def test_ions_by_the_names_of_charmm(name, model, named, tmp_path):
    ion = load_model(model)
    truth = Truth(["spce", ion, "spce", ion], 30)
    if named:
        ion = dataclasses.replace(ion, residue_names=("ION",))
    rows = [(name if k % 2 else n, e, k, x, v) for n, e, k, x, v in truth.atoms()]
    text = truth.gro(
        rows, 6, residue_names={1: "ION" if named else name, 3: "ION" if named else name}
    )
    same_molecules(
        read(tmp_path, text, "a.gro", ["spce", ion]), truth, 1e-4, [SPECIES["spce"], ion]
    )
    lines = truth.pdb(rows, element_column=False, residue=name).splitlines()
    lines = [
        line if name in line[12:16] else line.replace(f" {name} A", " SOL A") for line in lines
    ]
    same_molecules(
        read(tmp_path, "\n".join(lines), "a.pdb", ["spce", ion]),
        truth,
        2e-3,
        [SPECIES["spce"], ion],
    )


def test_an_atom_of_any_name_in_the_residue_of_a_point(tmp_path):
    bead = molecule(
        "bead", (Site(name="B1", mass_u=72.0, position_A=(0.0, 0.0, 0.0)),), residue_names=("W",)
    )
    truth = Truth([bead] * 3 + ["argon"], 31)
    rows = [("SC5" if k < 3 else n, e, k, x, v) for n, e, k, x, v in truth.atoms()]
    text = truth.gro(rows, 6, residue_names={0: "W", 1: "W", 2: "W", 3: "AR"})
    found = read(tmp_path, text, "a.gro", [bead, "argon"])
    assert found.species.tolist() == [0, 0, 0, 1]


def test_species_that_the_scene_lacks(tmp_path):
    truth = Truth(["spce", "nitrogen", "spce", "argon"], 17)
    unreadable(
        r"atoms named Ar, N, which are in no molecule of the scene: spce \(O H2\)",
        tmp_path,
        truth.xyz(),
        "a.xyz",
    )
    text = truth.gro(residue_names={1: "N2", 3: "AR"})
    unreadable(
        r"molecule 2 \(atoms 4 to 5, residue 'N2'\) has atoms N2, expected spce",
        tmp_path,
        text,
        "a.gro",
    )


@pytest.mark.parametrize("file_model", ["spce", "tip4p2005"])
def test_of_two_species_the_one_that_fits_is_taken(file_model, tmp_path):
    """Both fit within the tolerance; the massless site is not in the file."""
    truth = Truth([file_model] * 3, 18)
    text = truth.xyz(truth.atoms(massless=False))
    found = read(tmp_path, text, "a.xyz", ["spce", "tip4p2005"])
    same_molecules(found, truth, 1e-6, ["spce", "tip4p2005"])
    other = {"spce": "tip4p2005", "tip4p2005": "spce"}[file_model]
    assert (
        f"3 molecules taken for {file_model} and not {other}, which fits less well" in found.notes
    )


@pytest.mark.parametrize("stretch", [1.0, 1.03])
def test_like_species_need_residue_names(stretch, tmp_path):
    """Two models of one geometry, and a geometry between those of two models."""
    other = dataclasses.replace(SPECIES["tip4p2005"], name="tip4p_ice", residue_names=())
    species = (
        [SPECIES["tip4p2005"], other] if stretch == 1.0 else [SPECIES["spce"], SPECIES["tip4p2005"]]
    )
    truth = Truth(["tip4p2005"] * 3, 18)
    atoms = truth.atoms(massless=False)
    if stretch != 1.0:
        means = [
            0.5 * (a + b) for a, b in zip(*(m.positions_body[:3] for m in species), strict=True)
        ]
        atoms = [
            (n, e, k, truth.centre[k] + truth.rotation[k] @ means[i % 3], v)
            for i, (n, e, k, _, v) in enumerate(atoms)
        ]
    unreadable(
        r"molecule 1 .atoms 1 to 3, .* may be .* or .*: give them residue_names",
        tmp_path,
        truth.xyz(atoms),
        "a.xyz",
        species,
    )


def test_molecules_by_order_and_by_geometry(tmp_path):
    """An .xyz has no residues: waters atom by atom, and one with all oxygens first, split across
    the boundary."""
    species = ["spce", "nitrogen"]
    truth = Truth(["spce", "nitrogen", "spce"], edges=(10.0, 10.0, 10.0))
    truth.centre = np.array([[0.1, 0.2, 9.9], [5.0, 5.0, 0.1], [9.95, 5.0, 5.0]])
    atoms = truth.wrapped()
    for listed in (atoms, sorted(atoms, key=lambda atom: -ord(atom[1][0]))):
        found = read(tmp_path, truth.xyz(listed), "a.xyz", species)
        same_molecules(found, truth, 1e-6, species)
        assert found.residual_max < 1e-6
