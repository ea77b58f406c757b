"""A scene becomes what runs: species, space, start, terms. Everything that can be wrong with that is said at once."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any, NamedTuple

import numpy as np

from rigidmd.assemble.electrostatics import electrostatic_faults
from rigidmd.assemble.momenta import Freedom, freedom_of
from rigidmd.assemble.overlaps import overlaps
from rigidmd.assemble.species import frozen_apart, species_of
from rigidmd.assemble.start import arrange, residue_numbers, set_momenta
from rigidmd.assemble.terms import left_out, terms_of
from rigidmd.core.state import State, state_of
from rigidmd.core.state_file import Saved
from rigidmd.dynamics.advance import Model
from rigidmd.engines.cpu import Engine
from rigidmd.errors import SceneError, StructureError
from rigidmd.forces.laws.lennard_jones import Tail
from rigidmd.forces.pairs.space import Space, Triclinic, space_of, wrap
from rigidmd.mechanics.rotor import NoRotor, split_rotor
from rigidmd.molecules import Molecule
from rigidmd.scene import MolecularScene
from rigidmd.units import GRAM_PER_CM3

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
    arrangement = arrange(scene, species)
    space = space_of(arrangement.cell)
    cutoff = _cutoff(scene, space, species)
    number = residue_numbers(arrangement)
    species, index, frozen = frozen_apart(scene, species, arrangement.species, number)
    if frozen[index].all():
        raise SceneError(scene.source, ["molecules: all are frozen; nothing would move"])
    model = _model(species, index, frozen)
    turning = any(m.inertia.any() for m in species)
    state = state_of(
        position=arrangement.position, rotation=arrangement.rotation if turning else None, cell=arrangement.cell
    )
    terms, constants, pressure, beyond, decided, charges = terms_of(
        scene, species, model, space, cutoff, state, arrangement.basis
    )
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
        left_out=left_out(scene, terms, model, space),
        force_error=charges.force_error if charges else None,
        notes=list(charges.notes) if charges else [],
    )
    system.notes.extend(set_momenta(scene, model, state, arrangement))
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
