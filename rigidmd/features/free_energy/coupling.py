"""[coupling] of a scene: its defaults, the species with scaled charges, and the energies at other
values of lambda."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from rigidmd.assemble.build import acting_in
from rigidmd.core.quantities import Quantity
from rigidmd.engines.observables import Observation
from rigidmd.engines.system import Extra, System
from rigidmd.forces.parts import Interactions, SystemParts
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import not_none

NAME = "free_energy"
CHARGES_FROM = 0.5
TITLES = {"soft_core": "the soft core of [coupling]"}


def with_coupling(
    scene: MolecularScene, species: list[Molecule]
) -> tuple[MolecularScene, list[str]]:
    """A scene with the defaults of [coupling], and error messages."""
    if (coupling := scene.coupling) is None:
        return scene, []
    named = [m for m in species if m.name == coupling.species]
    entries = [k for k, m in enumerate(species[: len(scene.molecules)]) if m in named]
    reasons = {
        f"{coupling.species} is not among the species, {', '.join({m.name: 0 for m in species})}": (
            not named
        ),
        "its molecules are frozen": any(scene.molecules[k].frozen for k in entries),
        "only Lennard-Jones forces and charges are scaled: leave out other forces": (
            scene.forces.added or scene.user_code.forces
        ),
        "a sum of dispersion has no soft core: use forces.dispersion = 'cutoff'": (
            scene.forces.dispersion != "cutoff"
        ),
    }
    errors = [f"coupling: {reason}" for reason, applies in reasons.items() if applies]
    if coupling.charges_from is None:
        begin = CHARGES_FROM if any(m.charges.any() for m in named) else 1.0
        coupling = coupling.model_copy(update={"charges_from": begin})
    return scene.model_copy(update={"coupling": coupling}), errors


def coupled(parts: SystemParts) -> SystemParts:
    """The parts of a system in which one species has scaled charges."""
    coupling = not_none(parts.scene.coupling)
    species = [
        replace(m, charges=coupling.charges * m.charges) if m.name == coupling.species else m
        for m in parts.species
    ]
    return parts._replace(species=species)


def with_other_lambdas(system: System, parts: SystemParts) -> System:
    """The system with the energies at coupling.lambdas, and a note. Raises SceneError.

    parts : with whole charges
    """
    coupling = not_none(parts.scene.coupling)
    rows = []
    for value in coupling.lambdas:
        scene = parts.scene.model_copy(update={"coupling": coupling.at(value)})
        at = acting_in(coupled(parts._replace(scene=scene)))
        rows.append(energy_to_lambda(value, partial(_change, value, at)))
    system.notes.append(coupling.in_short)
    extra = Extra(titles=TITLES, quantities=tuple(rows))
    return replace(system, extras=system.extras | {NAME: extra})


def energy_to_lambda(
    value: float, change: Callable[[Observation], float] | None = None
) -> Quantity:
    """The energy at one of coupling.lambdas."""
    about = f"potential energy at lambda = {value:g} less the present one, of the same state"
    title = f"Energy to lambda {value:g}"
    return Quantity(f"energy_to_lambda_{value:g}", title, "kJ/mol", about, change)


def _change(value: float, at: Interactions, observation: Observation) -> float:
    """The energy with the interactions at a lambda less the present one."""
    system, state = observation.system, observation.state
    if value == not_none(system.scene.coupling).value:
        return 0.0
    engine = system.cache.setdefault(NAME, {}).get(value)
    if engine is None:
        engine = system.cache[NAME][value] = system.engine_of(at.terms, system.precision)
    engine.renew_lists()  # so that the bits do not depend on earlier states
    energy = sum(tally.energy for tally in engine.evaluate(state)[1].values())
    energy += 0.0 if at.tail is None else at.tail.energy(state.volume)
    energy = energy + sum(at.constants.values()) - sum(observation.energies.values())
    return energy / observation.energy_unit
