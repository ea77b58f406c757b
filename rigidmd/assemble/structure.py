"""The starting configuration from a structure file: atoms become molecules of the scene, in its
box."""

from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.assignment import massive_sites
from rigidmd.assemble.atom_kinds import NO_MASS, labels_of
from rigidmd.assemble.matching import MatchedMolecules, match
from rigidmd.assemble.memory_check import check_memory_of_molecules
from rigidmd.core.state import edges_and_angles
from rigidmd.core.state_file import read_state
from rigidmd.errors import StructureError
from rigidmd.forces.ewald.direct_sum import SAME_BASIS
from rigidmd.formats import has_types
from rigidmd.formats.atoms import SAME_MASS, Atoms, with_elements
from rigidmd.formats.cells import (
    basis_of,
    cell_error,
    describe_basis,
    describe_cell,
    least_skewed_cell,
    reduced_cell,
    right_angled,
    same_lattice,
    standard_rotation,
)
from rigidmd.io.structure_file import read_atoms
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import OTHER_UNITS, did_you_mean, not_none

MOST_NAMED = 5  # molecules named in a message; further ones are counted
ROUNDING = 1e-12  # of a rotated cell, relative to its longest edge
SAME_BOX = (
    1e-4  # relative difference between the boxes of file and scene that rounding in files explains
)
#: Masses, moments and numbers of sites of one model agree to this fraction.
SAME_MODEL = 1e-6
CLOSE = 1.2  # factor by which nearest distances may differ from the bonds of the templates


class Configuration(NamedTuple):
    """Positions, orientations and momenta of molecules at the start."""

    species: np.ndarray  # (n,) index into the scene's molecules
    position: np.ndarray  # (n, 3) Å
    rotation: np.ndarray  # (n, 3, 3)
    velocity: np.ndarray | None  # (n, 3) Å/ps
    angular_momentum_body: np.ndarray | None  # (n, 3) u Å²/ps
    cell: np.ndarray | None  # (3, 3), rows a along x, b in xy, c; Å
    residual_rms: float = 0.0  # Å, distances of atoms from their templates
    residual_max: float = 0.0  # Å
    number: np.ndarray | None = None  # (n,) residue numbers, if residues are molecules and numbered
    notes: tuple[str, ...] = ()  # how the file was interpreted
    basis: np.ndarray = SAME_BASIS  # (3, 3) integers: edges of the cell in terms of the given cell


def read_structure(
    path: Path,
    species: list[Molecule],
    cell_of_scene: np.ndarray | None,
    periodic: bool,
    tolerance: float,
    frame: int | None = None,
    repeat: tuple[int, int, int] = (1, 1, 1),
    atom_types: dict[str, str] | None = None,
    topology: Path | None = None,
    content: bytes | None = None,
) -> Configuration:
    """The molecules of a structure file. Raises StructureError.

    cell_of_scene : (3, 3), or None to use the cell of the file. tolerance, frame,
        repeat, atom_types,
    topology : see Scene.structure. content : of a file that is not on disk, see
        `Scene.embedded_files`
    """
    if path.suffix == ".npz":
        if needless := [
            f"structure.{key}"
            for key, value in (("frame", frame), ("atom_types", atom_types))
            if value
        ]:
            raise StructureError(
                str(path), [f"holds one state with its names: leave out {' and '.join(needless)}"]
            )
        configuration = _read_state(path, species)
        if periodic and cell_of_scene is None:
            _check_box(path, configuration.cell, [])
    else:
        configuration = _read_molecules(
            path,
            species,
            cell_of_scene,
            periodic=periodic,
            tolerance=tolerance,
            frame=frame,
            atom_types=atom_types,
            topology=topology,
            content=content,
        )
    cell = None if not periodic else configuration.cell if cell_of_scene is None else cell_of_scene
    if (
        cell is not None
        and configuration.cell is not None
        and not same_lattice(configuration.cell, cell, SAME_BOX)
    ):
        configuration = configuration._replace(
            notes=(*configuration.notes, "the box of the scene is used, not the box of the file")
        )
    if cell is not None and (error := cell_error(cell)):
        raise StructureError(str(path), [f"its box: {error}"])
    configuration = configuration._replace(cell=cell)
    if repeat != (1, 1, 1):
        count = prod(repeat) * np.bincount(configuration.species, minlength=len(species)).astype(
            object
        )
        sites = sum(n * len(m.masses) for n, m in zip(count, species, strict=True))
        check_memory_of_molecules(str(path), sum(count), sites)
        configuration = _repeated(configuration, repeat)
    return with_reduced_cell(
        configuration,
        "its" if cell_of_scene is None else "the scene's box: its",
        may_rotate=cell_of_scene is None,
    )


def with_reduced_cell(
    configuration: Configuration, whose: str, *, may_rotate: bool
) -> Configuration:
    """The same configuration in a cell with small tilts. Rotated, if this allows a longer cutoff.
    `whose` is the owner of the lattice, for the note."""
    if configuration.cell is None:
        return configuration
    given_cell, velocity = configuration.cell, configuration.velocity
    if may_rotate:
        cell, rotation = least_skewed_cell(given_cell)
    else:
        cell = reduced_cell(given_cell)
        rotation = np.eye(3)
    if np.array_equal(cell, given_cell):
        return configuration
    basis = basis_of(cell @ rotation, given_cell)
    used = f"{describe_cell(cell)}, {describe_basis(basis)}"
    note = (
        f"{whose} lattice is given by the cell with {used}, in place of {describe_cell(given_cell)}"
    )
    if not np.array_equal(rotation, np.eye(3)):
        note += ". Rotated, contents included"
        configuration = configuration._replace(
            position=configuration.position @ rotation.T,
            rotation=rotation @ configuration.rotation,
            velocity=None if velocity is None else velocity @ rotation.T,
        )
    return configuration._replace(cell=cell, notes=(*configuration.notes, note), basis=basis)


def _repeated(configuration: Configuration, repeat: tuple[int, int, int]) -> Configuration:
    """The cell and its molecules, repeated along each edge."""
    cell = not_none(configuration.cell)
    shifts = np.indices(repeat).reshape(3, -1).T @ cell

    def tiled(values):
        return None if values is None else np.tile(values, (len(shifts), *[1] * (values.ndim - 1)))

    times = " x ".join(map(str, repeat))
    note = f"its {len(configuration.species)} molecules are repeated {times} times"

    return configuration._replace(
        species=tiled(configuration.species),
        number=tiled(configuration.number),
        position=(configuration.position + shifts[:, None]).reshape(-1, 3),
        rotation=tiled(configuration.rotation),
        velocity=tiled(configuration.velocity),
        angular_momentum_body=tiled(configuration.angular_momentum_body),
        cell=cell * np.array(repeat)[:, None],
        notes=(*configuration.notes, note),
    )


def _read_molecules(
    path: Path,
    species: list[Molecule],
    scene_cell,
    *,
    periodic: bool,
    tolerance: float,
    frame,
    atom_types,
    topology,
    content,
) -> Configuration:
    known = list(dict.fromkeys(name for m in species for name in (*m.site_names, *m.elements)))
    hint = f"is not a site or element of the scene's molecules; there are {', '.join(known)}"
    if unknown := [
        (number, name) for number, name in (atom_types or {}).items() if name not in (*known, "X")
    ]:
        errors = [
            f"structure.atom_types.{k} = {name!r} {hint}{did_you_mean(name, known)}"
            for k, name in unknown
        ]
        raise StructureError(str(path), errors)
    atoms = read_atoms(path, frame, atom_types, topology, content)
    atoms = with_elements(atoms, frozenset(label for m in species for label in labels_of(m)))
    notes = list(atoms.notes)
    if atoms.cell is not None:
        orientation = np.linalg.det(atoms.cell)
        cell, rotation = standard_rotation(atoms.cell)
        if not np.array_equal(rotation, np.eye(3)):
            velocity = None if atoms.velocity is None else atoms.velocity @ rotation.T
            atoms = atoms._replace(position=atoms.position @ rotation.T, velocity=velocity)
            notes.append(
                "its cell was rotated, contents included, so that a is along x and b in the xy"
                " plane"
            )
        if orientation < 0:
            notes.append(
                "its cell is left-handed: -c replaces c, which does not change the lattice"
            )
        if right_angled(cell):
            upright = np.diag(np.linalg.norm(cell, axis=1))
            if np.abs(upright - cell).max() > ROUNDING * cell.max():
                angles = ", ".join(f"{x:.7g}" for x in edges_and_angles(cell)[3:])
                notes.append(f"its angles of {angles}° were set to right angles")
            cell = upright
        atoms = atoms._replace(cell=cell)
    if periodic and scene_cell is None:
        _check_box(path, atoms.cell, notes)
    if atoms.cell is not None and periodic and (error := cell_error(atoms.cell)):
        raise StructureError(str(path), [f"its box: {error}"])
    matched = match(
        atoms,
        species,
        atoms.cell if atoms.cell is not None or not periodic else scene_cell,
        tolerance,
    )
    if isinstance(matched, list):
        others = [f"and {len(matched) - MOST_NAMED} more"] if len(matched) > MOST_NAMED else []
        if atom_types is None and has_types(path) and matched[0].startswith("has atoms named"):
            matched[0] += ". If these are types, structure.atom_types gives them names"
        errors = (
            _unknown_masses(atoms, species)
            + matched[:MOST_NAMED]
            + others
            + _other_units(atoms, species)
        )
        errors += [f"as read: {note}" for note in atoms.notes]
        raise StructureError(str(path), errors)
    if len(matched.species) == 0:
        raise StructureError(str(path), ["has no atoms with mass"])
    notes += [*matched.notes, *_notes(atoms, matched, species)]
    velocity, angular = _momenta(atoms, matched, species, notes)
    sizes = np.array([len(massive_sites(molecule)) for molecule in species])[matched.species]
    return Configuration(
        species=matched.species,
        position=matched.fit.centre,
        rotation=matched.fit.rotation,
        velocity=velocity,
        angular_momentum_body=angular,
        cell=atoms.cell,
        residual_rms=float(np.sqrt(matched.fit.square @ sizes / sizes.sum())),
        residual_max=float(matched.fit.deviation.max()),
        number=matched.number,
        notes=tuple(notes),
    )


def _unknown_masses(atoms: Atoms, species: list[Molecule]) -> list[str]:
    """Messages on atoms of the file whose mass no site of the scene has."""
    if atoms.masses is None:
        return []
    masses = np.unique([mass for m in species for mass in m.masses[massive_sites(m)]])
    unknown = [
        f"{name} ({mass:g} u)"
        for name, mass in sorted(set(zip(atoms.names, atoms.masses.tolist(), strict=True)))
        if mass >= NO_MASS and np.abs(masses - mass).min() > SAME_MASS * mass
    ]
    expected = f"the scene's molecules ({', '.join(f'{mass:g}' for mass in masses)} u)"
    advice = "set structure.atom_types, or these masses by masses_u"
    if unknown:
        return [
            f"its atom types {', '.join(unknown)} have masses that match no site of {expected}:"
            f" {advice}"
        ]
    return []


def _notes(atoms: Atoms, matched: MatchedMolecules, species: list[Molecule]) -> Iterator[str]:
    """Notes on massless sites, whose positions follow from the template and not from the file, and
    on masses in the file that differ from the masses of the scene."""
    lacking = [len(molecule.masses) - len(massive_sites(molecule)) for molecule in species]
    massless_count = sum(matched.massless.values())
    expected = int(np.array(lacking)[matched.species].sum())
    if massless_count > expected:
        yield (
            f"{massless_count - expected} sites without mass ({', '.join(matched.massless)}) are"
            " in no model: left out"
        )
    elif massless_count < expected:
        names = ", ".join(
            molecule.name for molecule, count in zip(species, lacking, strict=True) if count
        )
        what = f"{expected - massless_count} sites without mass are missing in the file ({names})"
        yield f"{what}: built from the rigid template"
    others = {}
    masses = atoms.masses
    for k, molecule in enumerate(species if masses is not None else ()):
        assert masses is not None
        for s, site in enumerate(massive_sites(molecule)):
            members = np.array(
                [matched.atoms[m][s] for m in np.flatnonzero(matched.species == k)], int
            )
            mass = float(molecule.masses[site])
            for i in members[np.abs(masses[members] - mass) > SAME_MASS * mass]:
                others[
                    f"{atoms.names[i]} {masses[i]:g} and {molecule.site_names[site]} {mass:g} u"
                ] = None
    if listed := "; ".join(others):
        yield (
            f"the masses of the scene are used, not the masses in the file ({listed}): masses_u"
            " changes them"
        )


def _check_box(path: Path, cell: np.ndarray | None, notes: list[str]) -> None:
    """Raise StructureError for a start without a box."""
    if cell is None:
        why = f" ({'; '.join(notes)})" if notes else ""
        raise StructureError(
            str(path), [f"has no box{why}: give [box] lengths_A, or periodic = false"]
        )


def _momenta(atoms: Atoms, matched: MatchedMolecules, species: list[Molecule], notes: list[str]):
    """Velocities (n, 3) and body angular momenta (n, 3) with the momenta of the atoms, or None.
    About axes without inertia (linear bodies, points) the angular momentum is 0."""
    if atoms.velocity is None:
        return None, None
    without = np.array(np.isnan(atoms.velocity).any(axis=1))
    if lost := sorted(i for run in matched.atoms for i in run[without[run]]):
        which = f"{len(lost)} of its atoms have no velocity (the first is atom {lost[0] + 1})"
        notes.append(f"{which}: no velocity is used")
        return None, None
    n = len(matched.species)
    velocity, angular = np.zeros((n, 3)), np.zeros((n, 3))
    for k in np.unique(matched.species):
        members = np.flatnonzero(matched.species == k)
        molecule = species[k]
        sites = massive_sites(molecule)
        masses = molecule.masses[sites]
        v = atoms.velocity[np.array([matched.atoms[m] for m in members])]
        velocity[members] = np.einsum("s,nsk->nk", masses, v) / masses.sum()
        rotation = matched.fit.rotation[members]
        arm = np.einsum("nij,sj->nsi", rotation, molecule.positions_body[sites])
        lab = np.einsum("s,nsk->nk", masses, np.cross(arm, v - velocity[members][:, None]))
        angular[members] = np.einsum("nij,ni->nj", rotation, lab) * (molecule.inertia > 0)
    return velocity, angular


def _other_units(atoms: Atoms, species: list[Molecule]) -> list[str]:
    """A message if the nearest distances match the bonds of the molecules in another unit than
    Å."""
    from scipy.spatial import KDTree
    from scipy.spatial.distance import pdist

    bonds = [
        pdist(m.positions_body[massive_sites(m)]).min()
        for m in species
        if len(massive_sites(m)) > 1
    ]
    if not bonds or len(atoms.position) < 2:
        return []
    nearest = float(np.median(KDTree(atoms.position).query(atoms.position, 2)[0][:, 1]))
    low, high = min(bonds) / CLOSE, max(bonds) * CLOSE
    fitting = [unit for unit, size in OTHER_UNITS["A"].items() if low <= nearest * size <= high]
    return [
        f"the coordinates seem to be in {unit}, not in Å as in this format: the nearest distance is"
        f" {nearest:.3g}"
        for unit in fitting
        if "Å" not in fitting
    ]


def _other_model(molecule: Molecule, saved: np.ndarray) -> str:
    """The difference between a molecule and a saved one with this `Molecule.fingerprint`. Empty if
    there is none."""
    fingerprint = np.array(molecule.fingerprint)
    names = ("mass, u", "moment of inertia 1, u Å²", "moment 2", "moment 3", "number of sites")
    size = np.array([fingerprint[0], *[max(fingerprint[1:4].max(), saved[1:4].max())] * 3, 1.0])
    differs = [
        f"{name}: {saved_value:.6g}, here {value:.6g}"
        for name, saved_value, value, scale in zip(names, saved, fingerprint, size, strict=True)
        if abs(saved_value - value) > SAME_MODEL * scale
    ]
    return f"holds another {molecule.name} than the scene ({'; '.join(differs)})" if differs else ""


def _read_state(path: Path, species: list[Molecule]) -> Configuration:
    """The final state of an earlier run, bit for bit."""
    saved = read_state(path)
    known = [molecule.name for molecule in species]
    if missing := [name for name in saved.names if name not in known]:
        raise StructureError(
            str(path), [f"holds {', '.join(missing)}. The scene has {', '.join(known)}"]
        )
    of_name = {molecule.name: molecule for molecule in species}
    models = () if saved.models is None else zip(saved.names, saved.models, strict=True)
    errors = [error for name, model in models if (error := _other_model(of_name[name], model))]
    state = saved.state
    n = len(saved.species)
    has_rotations = len(saved.state.rotation) > 0
    rotating = [name for name in saved.names if of_name[name].inertia.any()]
    if rotating and not has_rotations:
        errors.append(f"has no rotations, but {', '.join(rotating)} can rotate")
    if errors:
        raise StructureError(str(path), errors)
    return Configuration(
        species=np.array([known.index(name) for name in saved.names])[saved.species],
        position=state.position,
        rotation=state.rotation if has_rotations else np.tile(np.eye(3), (n, 1, 1)),
        velocity=state.velocity,
        angular_momentum_body=state.angular_momentum_body if has_rotations else np.zeros((n, 3)),
        cell=state.cell if np.isfinite(state.cell).all() else None,
        number=saved.residue_number,
    )
