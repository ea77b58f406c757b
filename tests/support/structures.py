"""Molecules whose positions are known, and the text of structure files that hold them."""

from collections.abc import Sequence
from pathlib import Path

import ase
import numpy as np
import pytest

from rigidmd.assemble.structure import read_structure
from rigidmd.errors import StructureError
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.scene.models import Molecule, Site, load_model, molecule

TOLERANCE = 0.15


def chiral() -> Molecule:
    """CHFClBr, left-handed; its mirror image must not be taken for it."""
    corners = {"H": (1, 1, 1), "F": (1, -1, -1), "Cl": (-1, 1, -1), "Br": (-1, -1, 1)}
    lengths, masses = (
        {"H": 1.09, "F": 1.36, "Cl": 1.76, "Br": 1.94},
        {"H": 1.0, "F": 19.0, "Cl": 35.4, "Br": 79.9},
    )
    sites = [Site(name="C", element="C", mass_u=12.0, position_A=(0.0, 0.0, 0.0))]
    for e, corner in corners.items():
        place = tuple(float(lengths[e] * x / np.sqrt(3)) for x in corner)
        sites.append(Site(name=e.upper(), element=e, mass_u=masses[e], position_A=place))
    return molecule("halothane", tuple(sites), residue_names=("HAL",))


def tetrachloromethane() -> Molecule:
    """Half of the orders of its chlorines have all distances right and are mirror images."""
    corners = 1.766 / np.sqrt(3) * np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    sites = [
        Site(name=f"CL{k}", element="Cl", mass_u=35.45, position_A=tuple(map(float, x)))
        for k, x in enumerate(corners)
    ]
    carbon = Site(name="C", element="C", mass_u=12.011, position_A=(0.0, 0.0, 0.0))
    return molecule("tetrachloromethane", (carbon, *sites), residue_names=("CCL4",))


def benzene() -> Molecule:
    """Twelve atoms of two kinds: 518,400 orders, 12 of which fit."""
    sites = []
    for e, radius, mass in (("C", 1.397, 12.011), ("H", 2.483, 1.008)):
        for k in range(6):
            place = (
                radius * float(np.cos(k * np.pi / 3)),
                radius * float(np.sin(k * np.pi / 3)),
                0.0,
            )
            sites.append(Site(name=f"{e}{k + 1}", element=e, mass_u=mass, position_A=place))
    return molecule("benzene", tuple(sites), residue_names=("BNZ",))


def ion(element: str, mass: float) -> Molecule:
    return molecule(
        element, (Site(name=element, element=element, mass_u=mass, position_A=(0.0, 0.0, 0.0)),)
    )


SPECIES = {
    "sodium": ion("Na", 22.99),
    "chloride": ion("Cl", 35.45),
    "spce": load_model("spce"),
    "tip4p2005": load_model("tip4p2005"),
    "nitrogen": load_model("nitrogen"),
    "argon": load_model("argon"),
    "chiral": chiral(),
    "benzene": benzene(),
    "tetrachloromethane": tetrachloromethane(),
}


class Truth:
    """Molecules that are known: on a lattice so wide that none touch, rotated at random."""

    def __init__(
        self, kinds: Sequence[str | Molecule], seed: int = 0, edges=(14.0, 15.0, 16.0), cell=None
    ):
        rng = np.random.default_rng(seed)
        self.species = [SPECIES[kind] if isinstance(kind, str) else kind for kind in kinds]
        self.cell = np.diag(edges) if cell is None else np.array(cell)
        side = int(np.ceil(np.cbrt(len(kinds))))
        grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)[
            : len(kinds)
        ]
        self.centre = ((grid + 0.1 * rng.random(grid.shape)) / side) @ self.cell
        self.rotation = random_rotations(rng, len(kinds))
        self.velocity = rng.standard_normal((len(kinds), 3))
        self.omega = 5 * rng.standard_normal((len(kinds), 3))  # lab
        for k, m in enumerate(
            self.species
        ):  # a linear body does not rotate about its axis, a point not at all
            body = self.rotation[k].T @ self.omega[k]
            self.omega[k] = self.rotation[k] @ (body * (m.inertia > 0))

    def atoms(self, massless=True):
        """(name, element, molecule, position, velocity) of every site, molecules whole."""
        return [
            (
                m.site_names[s],
                m.elements[s],
                k,
                self.centre[k] + (arm := self.rotation[k] @ m.positions_body[s]),
                self.velocity[k] + np.cross(self.omega[k], arm),
            )
            for k, m in enumerate(self.species)
            for s in range(len(m.masses))
            if massless or m.masses[s] > 0
        ]

    def gro(self, atoms=None, *rest, **options) -> str:
        return gro(atoms or self.atoms(), box_of(self.cell), *rest, **options)

    def pdb(self, atoms=None, *rest, **options) -> str:
        return pdb(atoms or self.atoms(), cryst1(self.cell), *rest, **options)

    def xyz(self, atoms=None, *rest, **options) -> str:
        return xyz(atoms or self.atoms(), self.cell, *rest, **options)

    def ase(self, atoms=None) -> ase.Atoms:
        _, elements, _, positions, _ = zip(*(atoms or self.atoms()), strict=True)
        return ase.Atoms(elements, positions, cell=self.cell, pbc=True)

    def wrapped(self):
        return wrapped(self.atoms(), self.cell)

    def angular_momentum_body(self):
        return np.array(
            [
                m.inertia * (q.T @ w)
                for m, q, w in zip(self.species, self.rotation, self.omega, strict=True)
            ]
        )


def same_molecules(found, truth: Truth, error: float, species=("spce",)):
    """Every molecule is found once, all sites of all kinds in place modulo the lattice. Returns the
    pairing."""
    species = models(species)

    def apart(a, b):
        step = (a - b) @ np.linalg.inv(truth.cell)
        return np.linalg.norm((step - np.round(step)) @ truth.cell, axis=-1)

    assert len(found.species) == len(truth.species)
    distance = apart(found.position[:, None], truth.centre)
    partner = distance.argmin(axis=1)
    assert sorted(partner) == list(range(len(truth.species)))
    for n, k in enumerate(partner):
        model, true = species[found.species[n]], truth.species[k]
        assert model.name == true.name
        sites = found.position[n] + model.positions_body @ found.rotation[n].T
        there = truth.centre[k] + true.positions_body @ truth.rotation[k].T
        for s, element in enumerate(model.elements):
            like = [i for i, e in enumerate(true.elements) if e == element]
            assert apart(sites[s], there[like]).min() <= error, (model.name, model.site_names[s])
    return partner


def gro(
    atoms, box, digits=3, velocities=False, names=None, residues=True, residue_names=None
) -> str:
    """A .gro of (name, element, molecule, position in Å, velocity in Å/ps); box as its last line,
    nm."""
    width = digits + 5
    lines = ["t", str(len(atoms))]
    for i, (name, _, k, x, v) in enumerate(atoms):
        called = (names or {}).get(name, name)
        number = (k + 1) % 100000 if residues else 1
        residue = (residue_names or {}).get(k, "SOL" if residues else "")
        line = f"{number:5d}{residue:<5}{called:>5}{(i + 1) % 100000:5d}" + "".join(
            f"{c / 10:{width}.{digits}f}" for c in x
        )
        if velocities:
            line += "".join(f"{c / 10:{width}.{digits + 1}f}" for c in v)
        lines.append(line)
    return "\n".join([*lines, box]) + "\n"


def box_of(cell) -> str:
    return " ".join(f"{x / 10:.6f}" for x in np.diag(cell))


def pdb(atoms, cryst, names=None, element_column=True, number=None, residue="HOH") -> str:
    lines = [cryst] if cryst else []
    for i, (name, element, k, x, _) in enumerate(atoms):
        called = (names or {}).get(name, name)
        label = f" {called:<3}" if len(called) < 4 else called
        serial = number(k) if number else f"{(k + 1) % 10000:4d}"
        tail = f"          {element.upper() if element != 'X' else '':>2}" if element_column else ""
        lines.append(
            f"HETATM{(i + 1) % 100000:5d} {label} {residue:>3} A{serial}    {x[0]:8.3f}{x[1]:8.3f}{x[2]:8.3f}"
            f"  1.00  0.00{tail}"
        )
    return "\n".join([*lines, "END"]) + "\n"


def cryst1(cell) -> str:
    return (
        "CRYST1"
        + "".join(f"{x:9.3f}" for x in np.diag(cell))
        + "".join(f"{a:7.2f}" for a in (90, 90, 90))
        + " P 1"
    )


def xyz(atoms, cell, names=None) -> str:
    """Extended .xyz, a name or else the element in the first column."""
    lattice = (
        f'Lattice="{" ".join(f"{x:.12f}" for x in np.ravel(cell))}"' if cell is not None else ""
    )
    rows = [
        f"{names[name] if names else element} {x[0]:.10f} {x[1]:.10f} {x[2]:.10f}"
        for name, element, _, x, _ in atoms
    ]
    return "\n".join([str(len(rows)), lattice, *rows]) + "\n"


def wrapped(atoms, cell):
    """Every atom inside the cell, molecules split."""

    def wrap(x):
        f = x @ np.linalg.inv(cell)
        return (f - np.floor(f)) @ cell

    return [(name, e, k, wrap(x), v) for name, e, k, x, v in atoms]


def models(species) -> list[Molecule]:
    return [SPECIES[kind] if isinstance(kind, str) else kind for kind in species]


def read(
    folder: Path,
    content: str | bytes,
    name: str,
    species=("spce",),
    cell=None,
    periodic=True,
    **options,
):
    """The start in a file with this content."""
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return read_structure(folder / name, models(species), cell, periodic, TOLERANCE, **options)


def unreadable(message: str, *file, **options) -> None:
    """The file, given as for `read`, is refused with this message."""
    with pytest.raises(StructureError, match=message):
        read(*file, **options)


NAMES = [
    {"OW": "OW", "HW1": "HW1", "HW2": "HW2", "MW": "MW"},
    {"OW": "O", "HW1": "H1", "HW2": "H2", "MW": "M"},
    {"OW": "OH2", "HW1": "H1", "HW2": "H2", "MW": "EPW"},
    {"OW": "O", "HW1": "H", "HW2": "H", "MW": "EP"},
    {"OW": "Ow", "HW1": "1HW", "HW2": "2HW", "MW": "LP1"},
    {"OW": "OT", "HW1": "HT", "HW2": "HT", "MW": "X"},
    {"OW": "O1", "HW1": "HO1", "HW2": "HO2", "MW": "DUM"},
    {"OW": "OH2", "HW1": "H1", "HW2": "H2", "MW": "OM"},
]


ROOTS = np.sqrt([0.5, 0.75, 1 / 12, 2 / 3, 8 / 9, 2 / 9])
#: Cells of rhombic dodecahedra and truncated octahedra, as programs write them, of edge 1.
ROUND_CELLS = {
    "dodecahedron, xy-square": [[1, 0, 0], [0, 1, 0], [0.5, 0.5, ROOTS[0]]],
    "dodecahedron, xy-hexagon": [[1, 0, 0], [0.5, ROOTS[1], 0], [0.5, ROOTS[2], ROOTS[3]]],
    "octahedron": [[1, 0, 0], [1 / 3, ROOTS[4], 0], [-1 / 3, ROOTS[5], ROOTS[3]]],
    "octahedron of Amber": [[1, 0, 0], [-1 / 3, ROOTS[4], 0], [-1 / 3, -ROOTS[5], ROOTS[3]]],
}


def lammps(truth, first_line, velocity_unit, molecule_ids=True) -> str:
    """A data file; velocity_unit in Å/ps."""
    atoms = truth.atoms()
    edges = np.diag(truth.cell)
    lines = [first_line, "", f"{len(atoms)} atoms", "3 atom types", ""]
    lines += [f"0 {x:.9f} {axis}lo {axis}hi" for x, axis in zip(edges, "xyz", strict=True)]
    lines += ["", "Masses", "", "1 15.9994", "2 1.008", "3 39.948", "", "Atoms # full", ""]
    types = {"O": 1, "H": 2, "Ar": 3, "X": 3}
    lines += [
        f"{i} {k + 1 if molecule_ids else 0} {types[e]} 0.0 {x[0]:.10f} {x[1]:.10f} {x[2]:.10f}"
        for i, (_, e, k, x, _) in enumerate(atoms, 1)
    ]
    lines += ["", "Velocities", ""]
    lines += [
        f"{i} " + " ".join(f"{c / velocity_unit:.12f}" for c in v)
        for i, (*_, v) in enumerate(atoms, 1)
    ]
    return "\n".join(lines) + "\n"


def cif(occupancy=1.0) -> str:
    return f"""data_x
_cell_length_a 5.0
_cell_length_b 6.0
_cell_length_c 7.0
_cell_angle_alpha 90
_cell_angle_beta 90
_cell_angle_gamma 90
_symmetry_space_group_name_H-M 'P 1'
loop_
_atom_site_label
_atom_site_type_symbol
_atom_site_fract_x
_atom_site_fract_y
_atom_site_fract_z
_atom_site_occupancy
O1 O 0.9 0.5 0.5 1.0
H1 H 0.0633 0.5962 0.5 {occupancy}
H2 H 0.7367 0.5962 0.5 1.0
"""


def data_of(
    truth,
    style="full",
    masses="1 15.9994\n2 1.008",
    types=("1", "2"),
    header="Atoms # STYLE\n",
    head="",
) -> str:
    """LAMMPS data of waters with these columns."""
    order = {
        "molecular": "{i} {m} {t} {x}",
        "charge": "{i} {t} {q} {x}",
        "atomic": "{i} {t} {x}",
        "full": "{i} {m} {t} {q} {x}",
        "hybrid full": "{i} {t} {x} {m} {q}",
        "sphere": "{i} {t} 1.0 1.0 {x}",
    }[style]
    rows = [
        order.format(
            i=i,
            m=k + 1,
            t=types[e == "H"],
            q=0.41 if e == "H" else -0.82,
            x=" ".join(f"{c:.10f}" for c in x),
        )
        for i, (_, e, k, x, _) in enumerate(truth.atoms(), 1)
    ]
    edges = "".join(
        f"0 {x:.9f} {axis}lo {axis}hi\n" for x, axis in zip(np.diag(truth.cell), "xyz", strict=True)
    )
    section = f"Masses\n\n{masses}\n\n" if masses else ""
    return (
        f"made by hand\n\n{head}{len(rows)} atoms\n2 atom types\n{edges}\n{section}{header.replace('STYLE', style)}"
        + "\n".join(rows)
        + "\n"
    )


def dump_of(truth, columns, flags="pp pp pp", units="") -> str:
    """A dump with these columns, atoms in another order."""
    cell, types, rows = truth.cell, {"O": 1, "H": 2, "X": 3}, []
    for i, (_, e, k, x, v) in enumerate(truth.atoms(), 1):
        scaled = (x - [1, 2, 3]) @ np.linalg.inv(cell)
        values = {
            "id": i,
            "mol": k + 1,
            "type": types[e],
            "element": e,
            "typelabel": {"O": "OW", "H": "HW", "X": "MW"}[e],
            "label": {"O": "OW", "H": "HW", "X": "MW"}[e],
            "mass": {"O": 15.9994, "H": 1.008, "X": 1e-8}[e],
        }
        values |= dict(zip(("x", "y", "z"), x, strict=True)) | dict(
            zip(("xs", "ys", "zs"), scaled, strict=True)
        )
        values |= dict(zip(("xu", "yu", "zu"), x, strict=True)) | dict(
            zip(("vx", "vy", "vz"), v / 1000, strict=True)
        )
        rows.append(
            " ".join(
                f"{values[c]:.12g}" if isinstance(values[c], float) else str(values[c])
                for c in columns.split()
            )
        )
    xy, xz, yz = cell[1, 0], cell[2, 0], cell[2, 1]
    low, high = np.array([1.0, 2, 3]), np.array([1.0, 2, 3]) + np.diag(cell)
    low += np.array([min(0, xy, xz, xy + xz), min(0, yz), 0])
    high += np.array([max(0, xy, xz, xy + xz), max(0, yz), 0])
    slanted = bool(xy or xz or yz)
    bounds = "\n".join(
        f"{a:.12f} {b:.12f}" + (f" {t:.12f}" if slanted else "")
        for a, b, t in zip(low, high, (xy, xz, yz), strict=True)
    )
    head = (
        f"ITEM: UNITS\n{units}\n" if units else ""
    ) + f"ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n{len(rows)}\n"
    box = f"ITEM: BOX BOUNDS {'xy xz yz ' if slanted else ''}{flags}\n{bounds}\n"
    return (
        head
        + box
        + f"ITEM: ATOMS {columns}\n"
        + "\n".join(rows[::-1] if "id" in columns else rows)
        + "\n"
    )


def as_gen(rows, cell) -> str:
    kinds = list(dict.fromkeys(name for name, _ in rows))
    lines = [
        f"{k} {kinds.index(name) + 1} {x} {y} {z}" for k, (name, (x, y, z)) in enumerate(rows, 1)
    ]
    edges = "\n".join(" ".join(map(str, edge)) for edge in cell)
    return "\n".join([f"{len(rows)} S", " ".join(kinds), *lines, "0 0 0", edges, ""])


def as_g96(rows, cell, velocity=None) -> str:
    def block(name, vectors):
        rows_of = [
            f"{1:5d} MIX   {atom:<5}{k + 1:7d}{''.join(f'{v:15.9f}' for v in vector)}"
            for k, ((atom, _), vector) in enumerate(zip(rows, vectors, strict=True))
        ]
        return "\n".join([name, *rows_of, "END"])

    parts = ["TITLE\nwater\nEND", block("POSITION", [np.array(x) / 10 for _, x in rows])]
    parts += [] if velocity is None else [block("VELOCITY", np.array(velocity) / 10)]
    return "\n".join([*parts, f"BOX\n{''.join(f'{x:15.9f}' for x in np.diag(cell) / 10)}\nEND\n"])


WATERS = Truth(["spce"] * 4)
GRO = WATERS.gro()
