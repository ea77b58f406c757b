"""A scene becomes what runs: species, space, start, terms. Everything that can be wrong with that is said at once."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any, NamedTuple

import numpy as np

from rigidmd.assemble.electrostatics import Charged, Electrostatics, electrostatic_faults, electrostatics
from rigidmd.assemble.fields import Parts, between_walls, field_notes, field_terms, fields_left_out, start_lattice
from rigidmd.assemble.momenta import Freedom, draw_momenta, freedom_of, kept_momentum, mobile, remove_momentum
from rigidmd.assemble.overlaps import overlaps
from rigidmd.assemble.structure import Arrangement, leaning_less, read_structure
from rigidmd.assemble.structure_files import read_geometry
from rigidmd.core.state import State, state_of
from rigidmd.core.state_file import Saved
from rigidmd.dynamics.advance import Model
from rigidmd.dynamics.noise import LATTICE, MOMENTA
from rigidmd.engines.cpu import Engine
from rigidmd.errors import Faults, SceneError, StructureError
from rigidmd.forces.laws.lennard_jones import Tail, lennard_jones, tail
from rigidmd.forces.pairs.loop import pair_forces
from rigidmd.forces.pairs.sites import BodySites, CentralSites, sites_of
from rigidmd.forces.pairs.space import Space, Triclinic, space_of, wrap
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.mechanics.rotor import NoRotor, split_rotor
from rigidmd.molecules import (
    Molecule,
    Site,
    find_site,
    load_model,
    molecule,
    read_molecule,
    read_parameters,
    with_masses,
    with_parameters,
)
from rigidmd.scene import MolecularScene
from rigidmd.scene.species import Molecules
from rigidmd.units import GRAM_PER_CM3, KJ_PER_MOL

DEFAULT_CUTOFF = 9.0  # Å


class Sites(NamedTuple):
    """Every site of every molecule, for the edges: output and analysis."""

    molecule: np.ndarray  # (s,)
    offset_body: np.ndarray  # (s, 3)
    name: np.ndarray  # (s,) text
    element: np.ndarray  # (s,) text
    mass: np.ndarray  # (s,)


@dataclass(frozen=True)
class System:
    """What a scene becomes. `state` is the start; nothing here changes during a run."""

    scene: MolecularScene
    species: list[Molecule]
    model: Model
    space: Space
    state: State
    terms: dict[str, NamedTuple]
    freedom: Freedom
    constants: dict[str, float]  # energies (u Å²/ps²) that no motion changes
    constant_pressure: float  # u/(Å ps²), that no motion changes
    tail: Tail | None  # what is missing beyond the cut-off, where it is asked for
    decided: dict[str, Any]  # keys of forces that the scene left open, with what they became
    sites: Sites
    residue_number: np.ndarray  # (n,) by which a scene may pick molecules: see Molecules.frozen
    from_lattice: bool
    cutoff: float  # Å
    left_out: list[str]
    force_error: float | None = None  # estimated rms error of the Coulomb force on a site, u Å/ps²; with Ewald sums
    notes: list[str] = field(default_factory=list)

    @property
    def density(self) -> float:
        """g/cm³; 0 without a box."""
        return float(self.model.mass[self.model.species].sum()) / self.space.volume / GRAM_PER_CM3

    @property
    def external(self) -> list[str]:
        """Names of the terms that act from outside, and so may change the total momentum."""
        return [name for name, term in self.terms.items() if hasattr(term, "changes_momentum")]

    @property
    def removes_momentum_every(self) -> float | None:
        """Time between removals of the total momentum, ps; None for never, or where nothing of it is conserved."""
        return self.scene.removes_momentum_every if self.model.keeps_momentum.any() else None

    @property
    def smallest_diameter(self) -> float:
        """Smallest Lennard-Jones diameter, or the smallest radius where there is none, Å."""
        sigma = [s for m in self.species for s, e in zip(m.sigma, m.epsilon, strict=True) if e > 0]
        return min(sigma or [m.radius for m in self.species if m.radius > 0] or [1.0])

    def saved(self, state: State) -> Saved:
        """A state with what a file of it says besides. Species that are there twice, frozen and free, are one there."""
        names = list(dict.fromkeys(m.name for m in self.species))
        index = np.array([names.index(m.name) for m in self.species])
        return Saved(state, names, index[self.model.species], self.residue_number)

    @property
    def residue_names(self) -> np.ndarray:
        """What each molecule (n,) is called in topology files."""
        return np.array([m.residue_names[0] for m in self.species], dtype=object)[self.model.species]

    def engine(self) -> Engine:
        """A new engine for it, in the precision of the scene."""
        return Engine(self.model, self.terms, self.scene.precision, self.scene.forces.skin_A)

    def of_sites(self, of: Callable[[Molecule], np.ndarray]) -> np.ndarray:
        """What `of` gives for the sites of a molecule, for all sites (s,)."""
        values = [of(m) for m in self.species]
        return np.concatenate([values[k] for k in self.model.species])

    def site_positions(self, state: State, wrapped: bool = False) -> np.ndarray:
        """Positions (s, 3) of all sites, lab frame, Å. Molecules are whole; wrapped: centres of mass inside the box."""
        centre = wrap(space_of(state.cell), state.position) if wrapped else state.position
        return centre[self.sites.molecule] + self._arms(state)

    def site_velocities(self, state: State) -> np.ndarray:
        """Velocities (s, 3) of all sites, lab frame, Å/ps."""
        velocity = state.velocity[self.sites.molecule]
        if len(state.rotation) == 0:
            return velocity
        omega = state.angular_momentum_body * self.model.inverse_inertia[self.model.species]
        lab = np.einsum("nij,nj->ni", state.rotation, omega)
        return velocity + np.cross(lab[self.sites.molecule], self._arms(state))

    def _arms(self, state: State) -> np.ndarray:
        if len(state.rotation) == 0:
            return np.zeros_like(self.sites.offset_body)
        return np.einsum("sij,sj->si", state.rotation[self.sites.molecule], self.sites.offset_body)


def build(scene: MolecularScene) -> System:
    """The system of a scene. Raises SceneError, StructureError or MoleculeError, each with every fault it found."""
    species = species_of(scene)
    arrangement = _arrange(scene, species)
    space = space_of(arrangement.cell)
    cutoff = _cutoff(scene, space, species)
    number = _numbers(arrangement)
    species, index, frozen = _frozen(scene, species, arrangement.species, number)
    if frozen[index].all():
        raise SceneError(scene.source, ["molecules: all are frozen; nothing would move"])
    model = _model(species, index, frozen)
    turning = any(m.inertia.any() for m in species)
    state = state_of(
        position=between_walls(scene, space, arrangement.position),
        rotation=arrangement.rotation if turning else None,
        cell=arrangement.cell,
    )
    terms, constants, pressure, beyond, decided, charges = _terms(
        scene, species, model, space, cutoff, state, arrangement.basis
    )
    terms |= field_terms(scene, Parts(species, model, space, cutoff, state, number))
    model = model._replace(keeps_momentum=kept_momentum(model, terms))
    system = System(
        scene=scene,
        species=species,
        model=model,
        space=space,
        state=state,
        terms=terms,
        freedom=freedom_of(model),
        constants=constants,
        constant_pressure=pressure,
        tail=beyond,
        decided=decided,
        sites=_sites(species, index),
        residue_number=number,
        from_lattice=scene.structure is None,
        cutoff=cutoff,
        left_out=_left_out(scene, terms, model, space),
        force_error=charges.force_error if charges else None,
        notes=[*(charges.notes if charges else []), *field_notes(scene)],
    )
    _set_momenta(system, arrangement)
    system.notes.extend(
        f"{m.name} was made with {m.mixing} mixing, forces.mixing is {scene.forces.mixing}"
        for m in {m.name: m for m in species}.values()
        if m.mixing not in (None, scene.forces.mixing)
    )
    if scene.structure is not None:
        system.notes.append(
            f"{len(index)} molecules read from {scene.structure.file}; atoms against rigid templates: "
            f"rms {arrangement.residual_rms:.4f} Å, largest {arrangement.residual_max:.4f} Å"
        )
        system.notes.extend(f"{scene.structure.file}: {note}" for note in arrangement.notes)
        if faults := overlaps(system):
            raise StructureError(str(scene.path(scene.structure.file)), faults)
    else:
        system.notes.extend(f"box: {note}" for note in arrangement.notes)
    return system


def species_of(scene: MolecularScene) -> list[Molecule]:
    """The molecules that a scene names, in its order. Raises SceneError with every fault."""
    found, faults = [], []
    for k, entry in enumerate(scene.molecules):
        try:
            found.append(_one_species(scene, entry))
        except Faults as error:
            faults += [f"molecules.{k}: {error.where}: {fault}" for fault in error.faults]
    names = [m.name for m in found]
    faults += [
        f"molecules: {name} stands there twice; name them apart" for name in sorted(set(names)) if names.count(name) > 1
    ]
    if faults:
        raise SceneError(scene.source, faults)
    return found


def _one_species(scene: MolecularScene, entry: Molecules) -> Molecule:
    if entry.model is not None:
        found = load_model(entry.model)
    elif entry.file is not None and entry.file.endswith(".toml"):
        found = read_molecule(scene.path(entry.file))
    else:
        table = () if entry.parameters is None else read_parameters(scene.path(entry.parameters))
        sites = entry.sites if entry.file is None else _sites_from_file(scene, entry, table)
        found = molecule(entry.name or scene.path(entry.file).stem, with_parameters(sites, table))
    if entry.masses_u is not None:
        found = with_masses(found, entry.masses_u)
    changed = {"name": entry.name or found.name, "residue_names": entry.residue_names or found.residue_names}
    return Molecule(**{**vars(found), **changed})


def _sites_from_file(scene: MolecularScene, entry: Molecules, table: tuple[Site, ...]) -> tuple[Site, ...]:
    """Geometry from the file, everything else from the scene's sites and the table, by atom name or else by element."""
    path = scene.path(entry.file)
    own = entry.sites or ()
    faults = []
    sites = []
    used = set()
    for name, element, mass, position in zip(*read_geometry(path), strict=True):
        match, shared = find_site(own, name, element), find_site(table, name, element)
        if match is None and shared is None:
            where = " or of parameters" if entry.parameters is not None else ""
            faults.append(f"atom {name}: no entry of sites{where} has this name or is called {element}")
            continue
        used.add(match.name if match else "")
        entries = [s for s in (match, shared) if s is not None]
        given = next((s.mass_u for s in entries if s.mass_u is not None), float(mass))
        element = next((s.element for s in entries if s.element != "X"), element)
        known = {"name": name[:5], "element": element, "mass_u": given, "position_A": tuple(map(float, position))}
        sites.append(match.model_copy(update=known) if match else Site(**known))
    faults += [f"sites: {s.name} is no atom of it" for s in own if s.name not in used]
    if faults:
        raise StructureError(str(path), faults)
    return tuple(sites)


def _arrange(scene: MolecularScene, species: list[Molecule]) -> Arrangement:
    if scene.structure is not None:
        path = scene.path(scene.structure.file)
        start = scene.structure
        found = read_structure(
            path,
            species,
            scene.box.cell,
            scene.box.periodic,
            start.tolerance,
            start.frame,
            start.repeat,
            start.atom_types,
        )
        faults = []
        for k, entry in enumerate(scene.molecules):
            present = int((found.species == k).sum())
            if entry.count is not None and entry.count != present:
                faults.append(f"holds {present} molecules of {species[k].name}, molecules.{k}.count is {entry.count}")
        if scene.structure.velocities and found.velocity is None:
            told = "".join(f"; {note}" for note in found.notes if "velocit" in note)
            faults.append(f"holds no velocities for all atoms{told}. Leave out structure.velocities = true")
        if faults:
            raise StructureError(str(path), faults)
        return found
    counts = [entry.count for entry in scene.molecules]
    mass = sum(count * m.mass for count, m in zip(counts, species, strict=True))
    cell = scene.box.cell
    if cell is None:
        cell = np.eye(3) * np.cbrt(mass / (scene.box.density_g_cm3 * GRAM_PER_CM3))
    rng = np.random.default_rng([scene.seed, LATTICE])
    n = sum(counts)
    found = Arrangement(
        species=np.repeat(np.arange(len(species)), counts),
        position=start_lattice(scene, species, n, np.diag(cell), rng),
        rotation=random_rotations(rng, n),
        velocity=None,
        angular_momentum_body=None,
        cell=cell if scene.box.periodic else None,
        residual_rms=0.0,
        residual_max=0.0,
    )
    return leaning_less(found, "its", may_turn=False)


def _numbers(arrangement: Arrangement) -> np.ndarray:
    """Numbers (n,) of residues, or else 1, 2, ... among the molecules of each species."""
    if arrangement.number is not None:
        return arrangement.number
    found = np.zeros(len(arrangement.species), int)
    for k in np.unique(arrangement.species):
        own = arrangement.species == k
        found[own] = np.arange(1, own.sum() + 1)
    return found


def _frozen(
    scene: MolecularScene, species: list[Molecule], index: np.ndarray, number: np.ndarray
) -> tuple[list[Molecule], np.ndarray, np.ndarray]:
    """Species, index (n,) into them, and which are frozen; one of which some molecules are frozen becomes two."""
    species, index, faults = list(species), index.copy(), []
    frozen = [entry.frozen is True for entry in scene.molecules]
    for k, entry in enumerate(scene.molecules):
        own = index == k
        chosen = np.zeros(len(index), bool)
        for first, last in entry.frozen_spans:
            here = own & (first <= number) & (number <= last)
            if not here.any() or last > number[own].max():
                there = f"they have {number[own].min()} to {number[own].max()}" if own.any() else "there are none"
                asked = f"{first}" if first == last else f"{first}-{last}"
                faults.append(f"molecules.{k}.frozen: no {species[k].name} has the number {asked}; {there}")
            chosen |= here
        if chosen.any() and (chosen == own).all():
            frozen[k] = True
        elif chosen.any():
            index[chosen] = len(species)
            species.append(species[k])
            frozen.append(True)
    if faults:
        raise SceneError(scene.source, faults)
    return species, index, np.array(frozen)


def _cutoff(scene: MolecularScene, space: Space, species: list[Molecule]) -> float:
    forces = scene.forces
    cutoff = forces.cutoff_A or (DEFAULT_CUTOFF if space.volume < inf else inf)
    faults = []
    half = min(space.edges) / 2
    least = "the smallest of a_x, b_y, c_z" if isinstance(space, Triclinic) else "the shortest edge"
    if cutoff > half:
        given = "" if forces.cutoff_A else " (the default)"
        faults.append(
            f"forces.cutoff_A = {cutoff:g}{given} is longer than half {least} of the box, {half:.3f} Å: "
            "a site would meet two images of another. Take a larger box or a shorter cut-off"
        )
    for m in species:
        extent = np.linalg.norm(m.positions_body[:, None] - m.positions_body, axis=2).max()
        if extent > half:
            faults.append(
                f"a molecule of {m.name} is {extent:.2f} Å long, more than half {least} of the box, {half:.3f} Å"
            )
    start = forces.switch_start_A
    if start is not None and start >= cutoff:
        faults.append(f"forces.switch_start_A = {start:g} is not below the cut-off of {cutoff:g} Å")
    if forces.tail_correction and space.volume == inf:
        faults.append("forces.tail_correction needs a periodic box: without one there is no liquid beyond the cut-off")
    faults += electrostatic_faults(scene, space, cutoff)
    if faults:
        raise SceneError(scene.source, faults)
    return cutoff


def _model(species: list[Molecule], index: np.ndarray, frozen: np.ndarray) -> Model:
    inertia = np.where(frozen[:, None], 0.0, [m.inertia for m in species])
    rotor = split_rotor(inertia)
    mass = np.array([m.mass for m in species])
    return Model(
        index.astype(np.int32),
        mass,
        np.where(frozen, 0.0, 1 / mass),
        inertia,
        rotor.inverse_inertia,
        rotor if inertia.any() else NoRotor(),
    )


def _sites(species: list[Molecule], index: np.ndarray) -> Sites:
    counts = np.array([len(m.masses) for m in species])[index]

    def each(values) -> np.ndarray:
        return np.concatenate([values[k] for k in index])

    return Sites(
        np.repeat(np.arange(len(index)), counts),
        each([m.positions_body for m in species]),
        each([np.array(m.site_names, dtype=object) for m in species]),
        each([np.array(m.elements, dtype=object) for m in species]),
        each([m.masses for m in species]),
    )


def _taking_part(species: list[Molecule], index: np.ndarray, chosen: list[np.ndarray]):
    """Sites of a law: chosen[k] lists the sites of species k that take part."""
    return sites_of(index, [m.positions_body[c] for m, c in zip(species, chosen, strict=True)])


def _groups(sites: BodySites | CentralSites, frozen: np.ndarray) -> np.ndarray:
    """Sites (s,) by what they do not act on: their own molecule, and frozen ones on all that is frozen."""
    if not frozen.any():
        return sites.molecule
    return np.where(frozen[sites.molecule], len(frozen), sites.molecule).astype(np.int32)


def _named_pairs(scene: MolecularScene, species: list[Molecule]) -> list[np.ndarray]:
    """For each species (pairs, 2, sites): whether an entry of forces.pairs means the site by its first, second name.

    Raises SceneError.
    """
    found = [np.zeros((len(scene.forces.pairs), 2, len(m.site_names)), bool) for m in species]
    faults = []
    for n, entry in enumerate(scene.forces.pairs):
        for side, text in enumerate(entry.sites):
            owner, _, name = text.rpartition(".")
            of = [k for k, m in enumerate(species) if owner in ("", m.name)]
            for names in ("site_names", "elements"):
                for k in of:
                    found[k][n, side] = [own == name for own in getattr(species[k], names)]
                if any(found[k][n, side].any() for k in of):
                    break
            else:
                known = dict.fromkeys(f"{m.name}.{own}" for m in species for own in m.site_names)
                faults.append(f"forces.pairs.{n}.sites: no site is {text!r}; there are {', '.join(known)}")
    if faults:
        raise SceneError(scene.source, faults)
    return found


def _terms(
    scene: MolecularScene,
    species: list[Molecule],
    model: Model,
    space: Space,
    cutoff: float,
    state: State,
    basis: np.ndarray,
) -> tuple[dict[str, NamedTuple], dict[str, float], float, Tail | None, dict[str, Any], Electrostatics | None]:
    """Terms and constant energies by name, constant pressure, what is beyond the cut-off, what was decided, charges."""
    forces = scene.forces
    index = model.species
    usual = 0.6 * cutoff if forces.truncation == "smooth_switch" else max(0.9 * cutoff, cutoff - 1.0)
    start = forces.switch_start_A or usual
    decided = {} if cutoff == inf else {"cutoff_A": cutoff}
    if cutoff < inf and "switch" in forces.truncation:
        decided["switch_start_A"] = start
    terms, constants, pressure, beyond = {}, {}, 0.0, None
    named = _named_pairs(scene, species)
    chosen = [np.flatnonzero((m.epsilon > 0) | named[k].any(axis=(0, 1))) for k, m in enumerate(species)]
    frozen = model.inverse_mass == 0
    if any(len(c) for c in chosen):
        pairs = [
            [(m.sigma[i], m.epsilon[i], tuple(named[k][:, :, i].ravel())) for i in c]
            for k, (m, c) in enumerate(zip(species, chosen, strict=True))
        ]
        kinds = sorted({pair for of_species in pairs for pair in of_species})
        of_species = [np.array([kinds.index(pair) for pair in own], np.int32) for own in pairs]
        kind = np.concatenate([of_species[k] for k in index])
        sigma, epsilon = np.array([pair[:2] for pair in kinds]).T
        special = {
            (i, j): (entry.sigma_A, entry.epsilon_kJ_mol * KJ_PER_MOL)
            for n, entry in enumerate(forces.pairs)
            for i, (_, _, one) in enumerate(kinds)
            for j, (_, _, other) in enumerate(kinds)
            if one[2 * n] and other[2 * n + 1]
        }
        law = lennard_jones(kind, sigma, epsilon, cutoff, forces.truncation, start, forces.mixing, special)
        if not (np.isfinite(law.c12).all() and np.isfinite(law.c6).all()):
            raise SceneError(scene.source, [f"sigma_A of {sigma.max():g} Å with epsilon overflows 4 epsilon sigma¹²"])
        sites = _taking_part(species, index, chosen)
        terms["lennard_jones"] = pair_forces(law, sites, _groups(sites, frozen[index]))
        if forces.tail_correction:
            beyond = tail(law)
    found = None
    chosen = [np.flatnonzero(m.charges != 0) for m in species]
    if forces.electrostatics != "none" and any(len(c) for c in chosen):
        sites = _taking_part(species, index, chosen)
        charged = Charged(species, index, frozen[index], chosen, sites, _groups(sites, frozen[index]))
        found = electrostatics(scene, charged, space, cutoff, start, state, basis)
        terms |= found.terms
        constants |= found.constants
        pressure += found.pressure
        decided |= found.decided or {}
    return terms, constants, pressure, beyond, decided, found


def _left_out(scene: MolecularScene, terms: dict, model: Model, space: Space) -> list[str]:
    """What is not compiled, and why."""
    out = []
    if "lennard_jones" not in terms:
        out.append("Lennard-Jones: no site has it")
    if not any(name.startswith("coulomb") for name in terms):
        out.append(
            "charges: " + ("electrostatics is none" if scene.forces.electrostatics == "none" else "no site has one")
        )
    elif "coulomb_reciprocal" not in terms:
        out.append(f"sums over periodic images, Fourier transforms: electrostatics is {scene.forces.electrostatics}")
    elif scene.forces.electrostatics == "ewald":
        out.append("Fourier transforms: electrostatics is ewald, wave by wave")
    if isinstance(model.rotor, NoRotor):
        out.append("rotation and torques: every molecule is a point")
    if space.volume == inf:
        out.append("periodic images: there is no box")
    if all(stage.ensemble == "nve" for stage in scene.stages):
        out.append("thermostat: every stage is nve")
    if scene.run.remove_momentum_interval_ps is False:
        out.append("removal of the total momentum: run.remove_momentum_interval_ps is false")
    if not scene.forces.tail_correction:
        out.append("tail correction: not asked for")
    return out + fields_left_out(terms)


def _set_momenta(system: System, arrangement: Arrangement) -> None:
    scene, state = system.scene, system.state
    if scene.structure is not None and scene.structure.velocities:
        state.velocity[:] = arrangement.velocity
        state.angular_momentum_body[:] = arrangement.angular_momentum_body[: len(state.angular_momentum_body)]
        held = ~mobile(system.model)
        state.velocity[held] = 0.0
        state.angular_momentum_body[held[: len(state.rotation)]] = 0.0
        if remove_momentum(system.model, state.velocity):
            system.notes.append("the total momentum of the file's velocities was taken out")
        return
    temperature = scene.start.temperature_K
    if temperature is None:
        temperature = scene.stages[0].temperature_K
    draw_momenta(system.model, state, temperature, np.random.default_rng([scene.seed, MOMENTA]))
