"""A start from a structure file: atoms read by ASE, recognised as the scene's molecules, fitted by rigid templates."""

import itertools
import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.errors import StructureError
from rigidmd.mechanics.rotation import align, orthogonality_error
from rigidmd.molecules import Molecule

# ASE's velocity unit (Å sqrt(u/eV)) in Å/ps.
ASE_VELOCITY = 98.22694788464063
MOST_PERMUTATIONS = 720
NOT_A_ROTATION = 1e-6  # largest |Q^T Q - 1| of a state that is read; runs end near 1e-13
MOST_NAMED = 5  # how many molecules a message names before it only counts


class Arrangement(NamedTuple):
    """Where molecules are and how they move, as a file says."""

    species: np.ndarray  # (n,) index into the scene's molecules
    position: np.ndarray  # (n, 3) Å
    rotation: np.ndarray  # (n, 3, 3)
    velocity: np.ndarray | None  # (n, 3) Å/ps
    angular_momentum_body: np.ndarray | None  # (n, 3) u Å²/ps
    edges: tuple[float, float, float] | None  # Å
    residual_rms: float  # Å, of all atoms against their templates
    residual_max: float  # Å


class _Atoms(NamedTuple):
    """What a file says, in our units."""

    elements: list[str]
    names: list[str]
    residue: list[tuple]  # (number, name) or () where the format has none
    position: np.ndarray
    velocity: np.ndarray | None
    edges: np.ndarray | None


def read_structure(path: Path, species: list[Molecule], edges, periodic: bool, tolerance: float) -> Arrangement:
    """The molecules of a structure file. Raises StructureError.

    edges: those the scene asks for, or None to take the file's. tolerance: see Scene.structure.
    """
    if path.suffix == ".npz":
        state = _read_state(path, species)
        return state._replace(edges=_edges(path, state.edges, edges, periodic))
    atoms = _read_atoms(path)
    edges = _edges(path, atoms.edges, edges, periodic)
    groups = _recognise(path, atoms, species, edges, tolerance)
    return _fit_all(path, atoms, groups, species, edges, tolerance)


def _edges(path: Path, found, wanted, periodic: bool) -> tuple[float, float, float] | None:
    """The box: what the scene says, else what the file says, or none."""
    if not periodic:
        return None
    if wanted is None and found is None:
        raise StructureError(str(path), ["has no box: give [box] lengths_A, or periodic = false"])
    return tuple(float(x) for x in (found if wanted is None else wanted))


def read_geometry(path: Path) -> tuple[list[str], list[str], np.ndarray, np.ndarray]:
    """Names, elements, masses (s,) and positions (s, 3) of the atoms of a file that holds one molecule."""
    atoms = _read(path)
    names = [str(x) for x in atoms.arrays.get("atomtypes", atoms.get_chemical_symbols())]
    return names, atoms.get_chemical_symbols(), atoms.get_masses(), atoms.get_positions()


def _read(path: Path):
    import ase.io

    if not path.is_file():
        raise StructureError(str(path), ["there is no such file"])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            frames = ase.io.read(path, index=":")
    except Exception as error:  # ASE's readers raise whatever their parsing trips over, ImportError to IndexError
        raise StructureError(str(path), [f"ASE cannot read it: {type(error).__name__}: {error}"]) from None
    if len(frames) > 1:
        raise StructureError(
            str(path), [f"holds {len(frames)} structures one after another; keep the one to start from"]
        )
    atoms = frames[0] if frames else ()
    if len(atoms) == 0:
        raise StructureError(str(path), ["holds no atoms"])
    if not np.isfinite(atoms.positions).all():
        bad = int(np.argmin(np.isfinite(atoms.positions).all(axis=1)))
        raise StructureError(str(path), [f"atom {bad + 1} has a position that is not a finite number"])
    if atoms.has("momenta") and not np.isfinite(atoms.get_momenta()).all():
        bad = int(np.argmin(np.isfinite(atoms.get_momenta()).all(axis=1)))
        raise StructureError(str(path), [f"atom {bad + 1} has a velocity that is not a finite number"])
    if path.suffix == ".gro":
        promised = path.read_text().splitlines()[1].strip()
        if not promised.isdigit() or int(promised) != len(atoms):
            raise StructureError(str(path), [f"line 2 promises {promised} atoms, {len(atoms)} are there: truncated?"])
    return atoms


def _read_atoms(path: Path) -> _Atoms:
    atoms = _read(path)
    elements = atoms.get_chemical_symbols()
    names = [str(x) for x in atoms.arrays.get("atomtypes", elements)]
    if "residuenumbers" in atoms.arrays:
        residue_names = atoms.arrays.get("residuenames", [""] * len(atoms))
        residue = [(int(n), str(r)) for n, r in zip(atoms.arrays["residuenumbers"], residue_names, strict=True)]
    else:
        residue = [()] * len(atoms)
    velocity = atoms.get_velocities() * ASE_VELOCITY if atoms.has("momenta") else None
    edges = None
    if atoms.cell.rank == 3 and atoms.pbc.any():
        if not np.allclose(atoms.cell.angles(), 90, atol=1e-3) or not atoms.pbc.all():
            angles = ", ".join(f"{a:g}" for a in atoms.cell.angles())
            raise StructureError(
                str(path),
                [
                    f"its cell has angles {angles}° and periodicity {atoms.pbc}; "
                    "only boxes with right angles, periodic in all directions, are handled"
                ],
            )
        edges = atoms.cell.lengths()
    return _Atoms(elements, names, residue, atoms.get_positions(), velocity, edges)


class _Group(NamedTuple):
    species: int
    atoms: list[int]  # in the order of the template's massive sites


def _massive(molecule: Molecule) -> np.ndarray:
    return np.flatnonzero(molecule.masses > 0)


def _recognise(path: Path, atoms: _Atoms, species: list[Molecule], edges, tolerance: float) -> list[_Group]:
    """Which atoms are which molecule: by residues, else by order, else by geometry."""
    by_residue = [list(run) for _, run in itertools.groupby(range(len(atoms.names)), key=lambda i: atoms.residue[i])]
    if len(by_residue) > 1 or (len(species) == 1 and len(by_residue[0]) <= len(species[0].masses)):
        groups, faults = _match(atoms, by_residue, species)
        if not faults:
            return groups
        if atoms.residue[0]:  # the file says what its molecules are: believe it
            more = [f"and {len(faults) - MOST_NAMED} more"] if len(faults) > MOST_NAMED else []
            raise StructureError(str(path), faults[:MOST_NAMED] + more)
    groups = _by_order(atoms, species, edges, tolerance)
    if groups is not None:
        return groups
    groups, faults = _match(atoms, _connected(atoms, edges), species)
    if faults:
        more = [f"and {len(faults) - MOST_NAMED} more"] if len(faults) > MOST_NAMED else []
        raise StructureError(str(path), faults[:MOST_NAMED] + more)
    return groups


def _match(atoms: _Atoms, runs: list[list[int]], species: list[Molecule]) -> tuple[list[_Group], list[str]]:
    """Each run of atoms as a species: by residue name where that is known, else by its elements."""
    groups, faults = [], []
    for number, run in enumerate(runs, 1):
        residue = atoms.residue[run[0]]
        label = f"molecule {number} (atoms {run[0] + 1} to {run[-1] + 1}" + (
            f", residue {residue[1]!r})" if residue else ")"
        )
        named = [k for k, s in enumerate(species) if residue and residue[1] in s.residue_names]
        fitting = [(k, order) for k in named or range(len(species)) if (order := _assign(atoms, run, species[k]))]
        if len(fitting) == 1:
            groups.append(_Group(*fitting[0]))
            continue
        found = _formula(atoms.elements[i] for i in run)
        if len(fitting) > 1:
            names = " or ".join(species[k].name for k, _ in fitting)
            faults.append(f"{label} may be {names}: give them residue_names in the scene")
        else:
            wanted = " or ".join(
                f"{species[k].name} ({_formula(species[k].elements[i] for i in _massive(species[k]))})"
                for k in named or range(len(species))
            )
            faults.append(f"{label} has atoms {found}, expected {wanted}")
    return groups, faults


def _formula(elements) -> str:
    return " ".join(f"{element}{count if count > 1 else ''}" for element, count in Counter(elements).items())


def _assign(atoms: _Atoms, run: list[int], molecule: Molecule) -> list[int] | None:
    """The run's atoms in the order of the template's massive sites, by name or else by element; or None."""
    sites = _massive(molecule)
    massless = {molecule.site_names[i] for i in range(len(molecule.masses)) if molecule.masses[i] == 0}
    left = [i for i in run if atoms.names[i] not in massless]
    if len(left) != len(sites):
        return None
    names = [atoms.names[i] for i in left]
    if len(set(names)) == len(names) and set(names) == {molecule.site_names[s] for s in sites}:
        return [left[names.index(molecule.site_names[s])] for s in sites]
    order = []
    for s in sites:
        match = next((i for i in left if atoms.elements[i] == molecule.elements[s]), None)
        if match is None:
            return None
        left.remove(match)
        order.append(match)
    return order


def _by_order(atoms: _Atoms, species: list[Molecule], edges, tolerance: float) -> list[_Group] | None:
    """Molecules as consecutive atoms; None unless every run has the elements AND the shape of a species."""
    groups = []
    i = 0
    while i < len(atoms.names):
        for k, molecule in enumerate(species):
            run = list(range(i, i + len(_massive(molecule))))
            if run[-1] < len(atoms.names) and (order := _assign(atoms, run, molecule)):
                fit = _fit(atoms, [order], molecule, edges)
                if fit.deviation.max() <= tolerance * molecule.radius:
                    groups.append(_Group(k, order))
                    i = run[-1] + 1
                    break
        else:
            return None
    return groups


def _connected(atoms: _Atoms, edges) -> list[list[int]]:
    """Atoms within bonding distance (sum of covalent radii, plus a quarter), as connected sets in file order."""
    from ase import Atoms
    from ase.neighborlist import natural_cutoffs, neighbor_list
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(atoms.names)
    plain = Atoms(atoms.elements, atoms.position, cell=edges, pbc=edges is not None)
    i, j = neighbor_list("ij", plain, natural_cutoffs(plain, mult=1.25))
    count, label = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)
    runs = [[] for _ in range(count)]
    for atom, component in enumerate(label):
        runs[component].append(atom)
    return sorted(runs)


class _Fit(NamedTuple):
    centre: np.ndarray  # (n, 3)
    rotation: np.ndarray  # (n, 3, 3)
    deviation: np.ndarray  # (n, s)
    order: np.ndarray  # (n, s)


def _fit(atoms: _Atoms, orders: list[list[int]], molecule: Molecule, edges) -> _Fit:
    """Best rigid fit of a template to molecules given by their atoms; made whole across the boundary first."""
    sites = _massive(molecule)
    masses = molecule.masses[sites]
    template = molecule.positions_body[sites]
    order = np.array(orders)
    points = atoms.position[order]
    if edges is not None:
        step = points - points[:, :1]
        points = points - np.asarray(edges) * np.round(step / edges)
    centre = np.einsum("s,nsk->nk", masses, points) / masses.sum()
    relative = points - centre[:, None]
    best = None
    for permutation in _permutations([molecule.elements[s] for s in sites]):
        moved = relative[:, permutation]
        rotation = align(template, moved, masses)
        deviation = np.linalg.norm(moved - np.einsum("nij,sj->nsi", rotation, template), axis=2)
        if len(sites) == 1:
            deviation[:] = 0.0  # a point fits wherever it is; what is left is the rounding of its centre
        if best is None:
            best = _Fit(centre, rotation, deviation, order)
        else:
            better = deviation.max(axis=1) < 0.5 * best.deviation.max(axis=1)
            best.rotation[better], best.deviation[better] = rotation[better], deviation[better]
            best.order[better] = order[better][:, permutation]
    return best


def _permutations(elements: list[str]) -> list[tuple[int, ...]]:
    """Orders in which like elements are exchanged, the given one first; only that where there are too many."""
    places = {e: [i for i, x in enumerate(elements) if x == e] for e in elements}
    if np.prod([float(np.prod(np.arange(1, len(p) + 1))) for p in places.values()]) > MOST_PERMUTATIONS:
        return [tuple(range(len(elements)))]
    orders = []
    for choice in itertools.product(*(itertools.permutations(p) for p in places.values())):
        order = list(range(len(elements)))
        for where, to in zip(places.values(), choice, strict=True):
            for a, b in zip(where, to, strict=True):
                order[a] = b
        orders.append(tuple(order))
    return orders


def _fit_all(
    path: Path, atoms: _Atoms, groups: list[_Group], species: list[Molecule], edges, tolerance: float
) -> Arrangement:
    n = len(groups)
    index = np.array([group.species for group in groups])
    position, rotation = np.zeros((n, 3)), np.zeros((n, 3, 3))
    velocity = None if atoms.velocity is None else np.zeros((n, 3))
    angular = None if atoms.velocity is None else np.zeros((n, 3))
    squares, worst, faults = [], 0.0, []
    for k, molecule in enumerate(species):
        members = np.flatnonzero(index == k)
        if len(members) == 0:
            continue
        fit = _fit(atoms, [groups[m].atoms for m in members], molecule, edges)
        position[members], rotation[members] = fit.centre, fit.rotation
        squares.append(fit.deviation.ravel() ** 2)
        worst = max(worst, float(fit.deviation.max()))
        limit = tolerance * molecule.radius
        for m, deviation, order in zip(members, fit.deviation.max(axis=1), fit.order, strict=True):
            if deviation > limit:
                faults.append(
                    f"molecule {m + 1} (atoms {order.min() + 1} to {order.max() + 1}) is no {molecule.name}: an atom "
                    f"is {deviation:.3f} Å from the rigid template, more than {limit:.3f} Å (structure.tolerance)"
                )
        if velocity is not None:
            masses = molecule.masses[_massive(molecule)]
            v = atoms.velocity[fit.order]
            velocity[members] = np.einsum("s,nsk->nk", masses, v) / masses.sum()
            arm = np.einsum("nij,sj->nsi", fit.rotation, molecule.positions_body[_massive(molecule)])
            lab = np.einsum("s,nsk->nk", masses, np.cross(arm, v - velocity[members][:, None]))
            angular[members] = np.einsum("nij,ni->nj", fit.rotation, lab) * (molecule.inertia > 0)
    if faults:
        more = [f"and {len(faults) - MOST_NAMED} more"] if len(faults) > MOST_NAMED else []
        raise StructureError(str(path), faults[:MOST_NAMED] + more)
    rms = float(np.sqrt(np.concatenate(squares).mean()))
    return Arrangement(index, position, rotation, velocity, angular, edges, rms, worst)


def _read_state(path: Path, species: list[Molecule]) -> Arrangement:
    """The final state of an earlier run (output.state); every bit of it."""
    try:
        with np.load(path, allow_pickle=False) as data:
            names = [str(name) for name in data["species_names"]]
            arrays = {
                key: data[key]
                for key in ("species", "position", "velocity", "rotation", "angular_momentum_body", "edges")
            }
    except FileNotFoundError:
        raise StructureError(str(path), ["there is no such file"]) from None
    except Exception as error:  # zipfile, numpy and pickle refusals all mean the same to the user
        raise StructureError(str(path), [f"is not a state that rigidmd wrote: {error}"]) from None
    known = [molecule.name for molecule in species]
    if missing := [name for name in names if name not in known]:
        raise StructureError(str(path), [f"holds {', '.join(missing)}; the scene has {', '.join(known)}"])
    n = len(arrays["species"])
    turning = len(arrays["rotation"]) > 0
    shapes = {"species": (n,), "position": (n, 3), "velocity": (n, 3), "edges": (3,)}
    shapes |= {"rotation": (n, 3, 3), "angular_momentum_body": (n, 3)} if turning else {}
    bad = [k for k, shape in shapes.items() if arrays[k].shape != shape or arrays[k].dtype.kind not in "fi"]
    bad += [k for k, a in arrays.items() if k not in (*bad, "edges") and not np.isfinite(a).all()]
    if not bad and (arrays["species"].dtype.kind != "i" or not np.isin(arrays["species"], np.arange(len(names))).all()):
        bad.append("species")
    if not bad and orthogonality_error(arrays["rotation"]) > NOT_A_ROTATION:
        bad.append("rotation")
    if bad:
        raise StructureError(str(path), [f"{', '.join(sorted(set(bad)))}: damaged (wrong shape or values)"])
    edges = tuple(float(x) for x in arrays["edges"])
    return Arrangement(
        species=np.array([known.index(name) for name in names])[arrays["species"]],
        position=arrays["position"],
        rotation=arrays["rotation"] if turning else np.tile(np.eye(3), (n, 1, 1)),
        velocity=arrays["velocity"],
        angular_momentum_body=arrays["angular_momentum_body"] if turning else np.zeros((n, 3)),
        edges=None if np.isinf(edges).all() else edges,
        residual_rms=0.0,
        residual_max=0.0,
    )
