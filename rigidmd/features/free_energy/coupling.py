"""[coupling] of a scene: its defaults, the species with scaled charges."""

from collections.abc import Sequence
from dataclasses import replace

from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule

CHARGES_FROM = 0.5


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
    faults = [f"coupling: {reason}" for reason, applies in reasons.items() if applies]
    if coupling.charges_from is None:
        begin = CHARGES_FROM if any(m.charges.any() for m in named) else 1.0
        coupling = coupling.model_copy(update={"charges_from": begin})
    return scene.model_copy(update={"coupling": coupling}), faults


def coupled(scene: MolecularScene, species: Sequence[Molecule]) -> list[Molecule]:
    """The species, one of them with scaled charges."""
    if (coupling := scene.coupling) is None:
        return list(species)
    return [
        replace(m, charges=coupling.charges * m.charges) if m.name == coupling.species else m
        for m in species
    ]


def at_lambda(scene: MolecularScene, value: float) -> MolecularScene:
    """A scene with another lambda."""
    assert scene.coupling is not None
    return scene.model_copy(update={"coupling": scene.coupling.at(value)})
