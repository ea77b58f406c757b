"""Energies of a trial molecule in a system, by the forces of the system: for second virial
coefficients and insertion."""

from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from rigidmd.assemble.build import field_terms, interactions
from rigidmd.assemble.resolve import model_of
from rigidmd.core.state import State, state_of
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.features.free_energy.guest_pairs import (
    POTENTIALS,
    PairOfKinds,
    add_guest_energies,
    pairs_of_kinds,
)
from rigidmd.features.potentials.extra import body_pairs_of
from rigidmd.features.potentials.user_code.binding import with_user_code
from rigidmd.forces.ewald.direct_sum import SAME_BASIS
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.parts import SystemParts
from rigidmd.forces.terms import trait
from rigidmd.scene.models import Molecule, load_model, read_molecule
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

if TYPE_CHECKING:
    from rigidmd.features.potentials.poses.pairs import BodyPairs

#: Two molecules overlap where the energy of two of their sites, without charges, is at least the
#: larger of these: u Å²/ps², and a multiple of kT.
CORE = 1000 * KJ_PER_MOL
CORE_IN_KT = 100.0
#: Sites lack a repulsive core between them where the energy of a trial molecule is below minus the
#: larger of these: u Å²/ps², times the square of its charge if that is above 1 e, and a multiple of
#: kT. The energy of a monovalent ion in water is -300 to -500 kJ/mol.
DEEPEST = 1250 * KJ_PER_MOL
DEEPEST_IN_KT = 500.0


def model_named(name: str, known: list[Molecule] | None = None) -> Molecule:
    """A molecule by its name among known ones, or else a shipped model or a .toml file. Raises
    MoleculeError."""
    for molecule in known or []:
        if molecule.name == name:
            return molecule
    return read_molecule(Path(name)) if name.endswith(".toml") else load_model(name)


class Guest:
    """A trial molecule in a system.

    Where its energy with the sites of the system is low, terms that are not of pairs are evaluated
    by the engine, with the trial molecule and without it: sums over k-vectors, fields, forces of
    users.

    molecule : the trial molecule
    temperature : K, the highest one of use; it sets the energy of cores
    host : (n,) whether each molecule of the system acts on it; default: all
    """

    def __init__(
        self,
        system: System,
        molecule: Molecule,
        temperature: float,
        host: np.ndarray | None = None,
    ):
        count = len(system.model.species)
        self.molecule, self._thermal = molecule, BOLTZMANN * temperature
        self._host = np.arange(count) if host is None else np.flatnonzero(host)
        self._with = _reassembled(system, self._host, [molecule])
        self._without = _reassembled(system, self._host, [])
        core = max(CORE, CORE_IN_KT * self._thermal)
        self._pairs: list[tuple[PairForces, list[PairOfKinds]]] = []
        #: Terms that the engine evaluates
        self.engine_terms: list[str] = []
        of_poses = body_pairs_of(self._with)
        self._poses = [cast("BodyPairs", self._with.terms[name]) for name in of_poses]
        for name, term in self._with.terms.items():
            if name in of_poses:
                continue
            if isinstance(term, PairForces) and isinstance(term.potential, POTENTIALS):
                is_guest = term.sites.molecule == len(self._host)
                sites = np.flatnonzero(is_guest), np.flatnonzero(~is_guest)
                if all(map(len, sites)):
                    self._pairs.append((term, pairs_of_kinds(term.potential, *sites, core)))
            elif molecule.charges.any() or not trait(term, "acts_on_charges"):
                self.engine_terms.append(name)
        # cores end the sums early
        self._pairs.sort(key=lambda pair: max((p.core for p in pair[1]), default=0.0), reverse=True)
        self._engines = (
            [_engine_of(one, self.engine_terms) for one in (self._with, self._without)]
            if self.engine_terms
            else []
        )

    @property
    def interacts(self) -> bool:
        """Whether a force acts on it."""
        return bool(self._pairs or self._poses or self._engines)

    @property
    def has_tail(self) -> bool:
        return self._with.tail is not None

    def constant(self, volume: float) -> float:
        """The part of its energy that does not depend on where it is, u Å²/ps²: the change of the
        tail correction and of constant energies."""
        energies = []
        for one in (self._with, self._without):
            tail = 0.0 if one.tail is None or volume == inf else one.tail.energy(volume)
            energies.append(tail + sum(one.constants.values()))
        return energies[0] - energies[1]

    def energies(self, state: State, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Energies (m,) of trial molecules in a state of the system, u Å²/ps²; inf where it
        overlaps.

        position (m, 3) centres of mass, Å; rotation (m, 3, 3). Raises SceneError where sites that
        attract each other have no core.
        """
        host = _selected(state, self._host)
        energy = np.zeros(len(position))
        for term, pairs in self._pairs:
            self._add_pairs(energy, term, pairs, host, position, rotation)
        if self._poses:
            from rigidmd.features.free_energy.pose_trials import (
                add_trial_energies,  # for such systems only
            )

            for term in self._poses:
                add_trial_energies(term, host, position, rotation, energy)
        constant = self.constant(state.volume)
        if self._engines:
            alone = _total(self._engines[1], host)
            limit = CORE_IN_KT * self._thermal + abs(constant)
            energy[energy > limit] = inf
            rotates = len(self._with.state.rotation) > 0
            for k in np.flatnonzero(energy < inf):
                trial = _with_trial(host, position[k], rotation[k], rotates=rotates)
                energy[k] += _total(self._engines[0], trial) - alone
        energy += constant
        deepest = DEEPEST * max(1.0, self.molecule.charge**2)
        if (energy < -max(deepest, DEEPEST_IN_KT * self._thermal)).any():
            lowest = energy.min() / KJ_PER_MOL
            raise SceneError(
                self._with.scene.source,
                [
                    f"the energy of {self.molecule.name} falls to {lowest:.3g} kJ/mol: sites that"
                    " attract each other, such as opposite charges, meet without a repulsive core"
                    " between them"
                ],
            )
        return energy

    def _add_pairs(
        self,
        energy: np.ndarray,
        term: PairForces,
        pairs: list[PairOfKinds],
        host: State,
        position: np.ndarray,
        rotation: np.ndarray,
    ) -> None:
        """Add the energies of a pair term to the trial energies."""
        offset = term.sites.offsets()
        owner = term.sites.molecule
        is_guest = owner == len(self._host)
        fixed = self._without.positions_of(host, owner[~is_guest], offset[~is_guest])
        at = np.flatnonzero(energy < inf)
        first = int(is_guest.argmax())
        arms = rotation[at].reshape(-1, 3) @ offset[is_guest].T
        sites = position[at, None] + arms.reshape(len(at), 3, is_guest.sum()).transpose(0, 2, 1)
        for pair in pairs:
            add_guest_energies(
                pair.potential,
                pair.core,
                sites[:, pair.guest - first],
                fixed[pair.host],
                pair.guest_strength,
                pair.host_strength,
                host.cell,
                found := np.zeros(len(at)),
            )
            energy[at] += found


def _reassembled(system: System, host: np.ndarray, added: list[Molecule]) -> System:
    """The system of some of its molecules, with added ones at the end, which move."""
    species = [*system.species, *added]
    new = np.arange(len(system.species), len(species))
    frozen = np.append(system.model.inverse_mass == 0, np.zeros(len(added), bool))
    model = model_of(species, np.append(system.model.species[host], new), frozen)
    state = _selected(system.state, host)
    # also of frozen molecules
    rotates = len(system.state.rotation) > 0 or bool(model.inertia.any())
    for _ in added:
        state = _with_trial(state, np.zeros(3), np.eye(3), rotates=rotates)
    scene = system.scene
    if scene.forces.electrostatics is None:  # only the trial molecule has charges
        forces = scene.forces.model_copy(update={"electrostatics": "none"})
        scene = scene.model_copy(update={"forces": forces})
    number = np.append(system.residue_number[host], np.ones(len(added), int))
    reciprocal = system.terms.get("coulomb_reciprocal")
    grid, k_vectors = (getattr(reciprocal, name, None) for name in ("grid", "k_vectors"))
    parts = SystemParts(scene, species, model, system.space, state, number, SAME_BASIS, grid)
    acting = interactions(parts)
    if k_vectors is not None and "coulomb_reciprocal" in acting.terms:
        term = acting.terms["coulomb_reciprocal"]._replace(k_vectors=k_vectors)  # type: ignore[attr-defined]
        acting.terms["coulomb_reciprocal"] = term
    acting.terms.update(field_terms(scene, parts))
    made = replace(
        system,
        scene=scene,
        species=species,
        model=model,
        state=state,
        terms=acting.terms,
        constants=acting.constants,
        tail=acting.tail,
        residue_number=number,
        extras={},
    )
    if scene.forces.added or scene.from_python:
        return with_user_code(made, is_start=False)
    return made


def _engine_of(system: System, names: list[str]) -> CpuEngine:
    terms = {name: system.terms[name] for name in names if name in system.terms}
    functions = {name: f for name, f in system.python_forces.items() if name in terms}
    return CpuEngine(
        system.model, terms, "double", system.scene.forces.skin_A, functions, system.scene.threads
    )


def _total(engine: CpuEngine, state: State) -> float:
    """The energy of all terms of an engine, u Å²/ps²."""
    return (
        sum(tally.energy for tally in engine.evaluate(state)[1].values()) if engine.terms else 0.0
    )


def _selected(state: State, members: np.ndarray) -> State:
    rotation = state.rotation[members] if len(state.rotation) else None
    return state_of(position=state.position[members], rotation=rotation, cell=state.cell)


def _with_trial(
    state: State, position: np.ndarray, rotation: np.ndarray, *, rotates: bool
) -> State:
    """A state with one more molecule at the end."""
    before = (
        state.rotation if len(state.rotation) else np.tile(np.eye(3), (len(state.position), 1, 1))
    )
    return state_of(
        position=np.vstack([state.position, position]),
        rotation=np.concatenate([before, rotation[None]]) if rotates else None,
        cell=state.cell,
    )
