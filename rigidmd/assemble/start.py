"""The start of a scene of molecules: positions, orientations and momenta. Overlaps of molecules."""

from collections.abc import Callable
from math import inf
from pathlib import Path

import numpy as np

from rigidmd.assemble.memory_check import check_memory_of_molecules
from rigidmd.assemble.structure import Configuration, read_structure, with_reduced_cell
from rigidmd.core.state import State
from rigidmd.dynamics.model import Model, draw_momenta, mobile, remove_momentum
from rigidmd.dynamics.noise import LATTICE, MOMENTA
from rigidmd.engines.system import System
from rigidmd.errors import SceneError, StructureError
from rigidmd.features import modules
from rigidmd.forces.ewald.direct_sum import SAME_BASIS
from rigidmd.forces.fields.walls import range_of_centres
from rigidmd.forces.parts import gather_per_molecule
from rigidmd.formats import format_of
from rigidmd.formats.cells import cell_error, pairs_within, standard_rotation
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.scene import MolecularScene
from rigidmd.scene.fields import AXES
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import not_none
from rigidmd.units import GRAM_PER_CM3


def starting_configuration(scene: MolecularScene, species: list[Molecule]) -> Configuration:
    """Positions and orientations from the structure file, or on a lattice, with the vacuum of the
    scene. Raises SceneError, StructureError."""
    configuration = _without_vacuum(scene, species)
    if (length := scene.box.vacuum_A) is None or configuration.cell is None:
        return configuration
    if not np.array_equal(configuration.basis, SAME_BASIS):
        raise SceneError(
            scene.source,
            ["box.vacuum_A: the cell has a large tilt. Give an equivalent cell without"],
        )
    k = "xyz".index(scene.box.vacuum_axis)
    cell = configuration.cell.copy()
    added = length / np.linalg.norm(cell[k]) * cell[k]
    images = np.floor(configuration.position @ np.linalg.inv(cell)[:, k])
    position = configuration.position - images[:, None] * cell[k] + 0.5 * added
    cell[k] += added
    return configuration._replace(position=position, cell=cell)


def _without_vacuum(scene: MolecularScene, species: list[Molecule]) -> Configuration:
    cell = scene.box.cell
    counts = [entry.count or 0 for entry in scene.molecules]
    framework = next((k for k, m in enumerate(species) if m.cell is not None), None)
    if framework is not None:
        return _about_framework(scene, species, framework, counts)
    if cell is None and scene.structure is None:
        mass = sum(count * m.mass for count, m in zip(counts, species, strict=True))
        cell = np.eye(3) * np.cbrt(mass / (not_none(scene.box.density_g_cm3) * GRAM_PER_CM3))
    if cell is not None and (fault := cell_error(cell)):
        raise SceneError(scene.source, [f"box: {fault}"])
    if scene.structure is not None:
        start = scene.structure
        content = scene.embedded_files.get("structure.file")
        path = scene.path(start.file) if content is None else Path(start.file)
        try:
            configuration = read_structure(
                path,
                species,
                cell,
                scene.box.periodic,
                start.tolerance,
                start.frame,
                start.repeat,
                start.atom_types,
                None if scene.topology is None else scene.path(scene.topology),
                content,
            )
        except StructureError as error:
            raise StructureError(scene.structure_source, error.errors) from None
        errors = []
        present = np.bincount(configuration.species, minlength=len(species))
        for k, (entry, present_count) in enumerate(zip(scene.molecules, present, strict=True)):
            if entry.count is not None and entry.count != present_count:
                errors.append(
                    f"has {present_count} molecules of {species[k].name}, molecules.{k}.count is"
                    f" {entry.count}"
                )
        if scene.structure.velocities and configuration.velocity is None:
            why = "".join(f"; {note}" for note in configuration.notes if "velocit" in note)
            errors.append(f"lacks velocities for some atoms{why}. Omit structure.velocities = true")
        if errors:
            raise StructureError(scene.structure_source, errors)
        return configuration
    n = sum(counts)
    sites = sum(count * len(m.masses) for count, m in zip(counts, species, strict=True))
    check_memory_of_molecules(scene.source, n, sites)
    cell = not_none(cell)
    rng = np.random.default_rng([scene.seed, LATTICE])
    configuration = Configuration(
        species=np.repeat(np.arange(len(species)), counts),
        position=_start_lattice(scene, species, n, np.diag(cell), rng),
        rotation=random_rotations(rng, n),
        velocity=None,
        angular_momentum_body=None,
        cell=cell if scene.box.periodic else None,
    )
    return with_reduced_cell(configuration, "its", may_rotate=False)


def _about_framework(
    scene: MolecularScene, species: list[Molecule], framework: int, counts: list[int]
) -> Configuration:
    """A framework at its position in its cell, and molecules on a lattice, also inside its
    walls."""
    counts = [0 if k == framework else count for k, count in enumerate(counts)]
    body = species[framework]
    n = sum(counts)
    first = sum(counts[:framework])
    cell, rotation = standard_rotation(not_none(body.cell))
    if error := cell_error(cell):
        raise SceneError(scene.source, [f"the cell of {body.name}: {error}"])
    rng = np.random.default_rng([scene.seed, LATTICE])
    lattice = _start_lattice(scene, species, n, np.diag(cell), rng) if n else np.zeros((0, 3))
    configuration = Configuration(
        species=np.insert(np.repeat(np.arange(len(species)), counts), first, framework),
        position=np.insert(lattice, first, rotation @ body.centre, axis=0),
        rotation=np.insert(random_rotations(rng, n), first, rotation @ body.axes, axis=0),
        velocity=None,
        angular_momentum_body=None,
        cell=cell,
    )
    return with_reduced_cell(configuration, "its", may_rotate=True)


def rest_errors(system: System) -> list[str]:
    """A message if no molecule can move."""
    if not len(system.model.species) or mobile(system.model).any():
        return []
    why = "molecules: all are frozen. Nothing would move."
    advice = [
        f"{name.title()} needs no run: `rigidmd analyse {system.scene.source} {name} model=NAME`"
        for name, _ in modules("scene_analyses")
    ]
    return [" ".join([why, *advice])]


def output_errors(system: System) -> list[str]:
    """Messages on files of a run that cannot hold the positions at its start."""
    output = system.scene.output
    if not output.trajectory:
        return []
    positions = system.site_positions(system.state, output.positions == "wrapped")
    limits = {
        name: not_none(format_of(name)).exceeded(positions)
        for name in (output.topology, output.trajectory)
    }
    reach = np.abs(positions).max()
    advice = "name a file of another format, or set output.trajectory = false"
    return [
        f"output: {name} cannot hold the position {reach:.3g} Å of the start, its limit is"
        f" {limit:g} Å: {advice}"
        for name, limit in limits.items()
        if limit is not None
    ]


def residue_numbers(configuration: Configuration) -> np.ndarray:
    """Residue numbers (n,) of the file, else 1, 2, ... within each species."""
    if configuration.number is not None:
        return configuration.number
    numbers = np.zeros(len(configuration.species), np.int32)
    for k in np.unique(configuration.species):
        members = configuration.species == k
        numbers[members] = np.arange(1, members.sum() + 1)
    return numbers


def set_momenta(
    scene: MolecularScene, model: Model, state: State, start: Configuration
) -> list[str]:
    """Set the momenta of a state, in place: from the structure file, or drawn at a temperature.
    Returns notes."""
    if scene.structure is not None and scene.structure.velocities:
        state.velocity[:] = start.velocity
        state.angular_momentum_body[:] = not_none(start.angular_momentum_body)[
            : len(state.angular_momentum_body)
        ]
        frozen = ~mobile(model)
        state.velocity[frozen] = 0.0
        state.angular_momentum_body[frozen[: len(state.rotation)]] = 0.0
        removed = remove_momentum(model, state.velocity)
        return ["the total momentum of the velocities in the file was removed"] if removed else []
    draw_momenta(
        model,
        state,
        not_none(scene.start.temperature_K),
        np.random.default_rng([scene.seed, MOMENTA]),
    )
    return []


def _start_lattice(
    scene: MolecularScene,
    species: list[Molecule],
    n: int,
    edges: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """n random points (n, 3) of a nearly cubic lattice in a box with edges (3,), off the walls.
    Raises SceneError."""
    low = np.zeros(3)
    high = edges.copy()
    errors = []
    for axis, name in enumerate(AXES):
        across = [walls for walls in scene.fields.walls if walls.direction == axis]
        if not across:
            continue
        ends = [range_of_centres(walls, species) for walls in across]
        low[axis], high[axis] = max(end[0] for end in ends), min(end[1] for end in ends)
        if low[axis] == -inf:
            low[axis] = high[axis] - edges[axis]
        elif high[axis] == inf:
            high[axis] = low[axis] + edges[axis]
        if not low[axis] < high[axis]:
            errors.append(
                f"fields.walls: the walls across {name} leave no space for molecules between them"
            )
    if errors:
        raise SceneError(scene.source, errors)
    edges = high - low
    shape = _lattice_shape(edges, n)
    points = np.indices(shape.tolist()).reshape(3, -1).T
    return low + (points[rng.permutation(len(points))[:n]] + 0.5) * edges / shape


def _lattice_shape(edges: np.ndarray, n: int) -> np.ndarray:
    """Numbers of points (3,) along edges (3,), for a nearly cubic lattice with at least n points.

    An edge shorter than half the spacing has one point, and the other edges set the spacing.
    """
    long = np.ones(3, dtype=bool)
    while True:
        spacing = (edges[long].prod() / n) ** (1 / long.sum())
        thin = long & (edges < 0.5 * spacing)
        if not thin.any():
            break
        long &= ~thin
    shape = np.where(long, np.maximum(1, np.round(edges / spacing)), 1).astype(int)
    while shape.prod() < n:
        shape[np.argmax(edges / shape)] += 1
    return shape


#: Lennard-Jones sites of different molecules closer than this fraction of their diameter overlap:
#: the repulsion there is 1750 epsilon, which does not occur in liquids.
OVERLAP = 0.6
#: Sites of different molecules closer than this fraction of the smallest molecular radius overlap
#: too.
INSIDE = 0.2


def overlaps(system: System) -> list[str]:
    """Messages on overlapping molecules, at most five of them."""
    inside = INSIDE * min([m.radius for m in system.species if m.radius > 0], default=0.0)
    cores = [np.where(m.epsilon > 0, m.sigma, 0.0) for m in system.species]
    widest = max((sigma.max() for sigma in cores), default=0.0)
    ranges = (inside, every_site), (OVERLAP * widest, lambda m: np.flatnonzero(m.epsilon > 0))
    sigma = gather_per_molecule(cores, system.model.species)
    errors = []
    for i, j, distance in close_pairs(system, system.state, *ranges):
        if distance <= max(
            inside, OVERLAP * (sigma[i] + sigma[j]) / 2 if sigma[i] > 0 and sigma[j] > 0 else 0.0
        ):
            a, b = system.sites.molecule[[i, j]]
            names = " and ".join(str(system.sites.name[k]) for k in (i, j))
            errors.append(
                f"molecules {a + 1} and {b + 1} overlap: {names} have a distance of"
                f" {distance:.3f} Å"
            )
    return errors[:5] + ([f"and {len(errors) - 5} more"] if len(errors) > 5 else [])


def every_site(molecule: Molecule) -> np.ndarray:
    """Indices of all sites of a molecule."""
    return np.arange(len(molecule.masses))


def close_pairs(
    system: System, state: State, *ranges: tuple[float, Callable[[Molecule], np.ndarray]]
) -> list[tuple[int, int, float]]:
    """Sites (i, j) of different molecules, not both frozen, within a radius, and their distances,
    Å. `ranges` are radii, and functions for the indices of the sites of a molecule to which they
    apply."""
    cell = state.cell if state.volume < inf else None
    position = system.site_positions(state)
    owner = system.sites.molecule
    free = mobile(system.model)
    near: dict[tuple[int, int], float] = {}
    for radius, sites_of in ranges:
        chosen = system.of_sites(
            lambda m, sites_of=sites_of: np.isin(every_site(m), sites_of(m))
        ).nonzero()[0]
        i, j, step = pairs_within(position[chosen], cell, radius)
        i, j, distance = chosen[i], chosen[j], np.linalg.norm(step, axis=1)
        is_allowed = (owner[i] != owner[j]) & (free[owner[i]] | free[owner[j]])
        for *pair, length in zip(
            i[is_allowed].tolist(),
            j[is_allowed].tolist(),
            distance[is_allowed].tolist(),
            strict=True,
        ):
            near[min(pair), max(pair)] = min(length, near.get((min(pair), max(pair)), inf))
    return [(*pair, near[pair]) for pair in sorted(near)]
