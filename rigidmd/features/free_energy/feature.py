"""What [coupling] adds to a system: scaled charges, soft cores, the energies at other values of
lambda."""

from collections.abc import Callable

from rigidmd.engines.system import System
from rigidmd.feature import Feature
from rigidmd.features.free_energy import soft_core
from rigidmd.features.free_energy.coupling import coupled, with_coupling, with_other_lambdas
from rigidmd.forces.parts import Interactions, SystemParts
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import not_none


class FreeEnergy(Feature):
    def resolve(
        self, scene: MolecularScene, species: list[Molecule]
    ) -> tuple[MolecularScene, list[str]]:
        return with_coupling(scene, species)

    def acting(self, parts: SystemParts) -> SystemParts:
        return coupled(parts)

    def potentials(self, scene: MolecularScene) -> dict[str, Callable[[SystemParts], Interactions]]:
        is_soft = not_none(scene.coupling).lennard_jones < 1
        return {"lennard_jones": soft_core.interactions} if is_soft else {}

    def extend(self, system: System, parts: SystemParts, *, user_code: bool) -> System:
        return with_other_lambdas(system, parts)


FEATURE = FreeEnergy()
