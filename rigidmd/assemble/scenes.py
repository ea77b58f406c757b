"""What a scene becomes: with every default filled in, and its start as an `ase.Atoms`."""

from typing import TYPE_CHECKING, TypeVar

from rigidmd.assemble.body import build_body
from rigidmd.assemble.build import build
from rigidmd.io.ase_atoms import atoms_of_system
from rigidmd.scene import BodyScene, MolecularScene

if TYPE_CHECKING:
    import ase

AnyScene = TypeVar("AnyScene", MolecularScene, BodyScene)


def resolve(scene: AnyScene) -> AnyScene:
    """The same scene with every number that a run of it uses; it runs to the same bits.

    An integrator that is "auto" stays so until a run has chosen one. Raises SceneError, and for molecules
    StructureError and MoleculeError.
    """
    return build_body(scene).scene if isinstance(scene, BodyScene) else build(scene).scene


def atoms_of(scene: MolecularScene) -> "ase.Atoms":
    """The start of a run as an `ase.Atoms`, before overlaps are removed: see `Results.atoms`. Raises as `resolve`."""
    system = build(scene)
    return atoms_of_system(system, system.state)
