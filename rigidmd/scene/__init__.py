"""Scenes: `Scene.read(path)` returns the scene of molecules or of a single body."""

from typing import TYPE_CHECKING, TypeGuard

from rigidmd.features.bodies.keys.body import BodyScene
from rigidmd.scene.base import Scene, parse_override

if TYPE_CHECKING:
    from rigidmd.scene.json_schema import schema
    from rigidmd.scene.molecules import MolecularScene

__all__ = ["BodyScene", "MolecularScene", "Scene", "is_molecular", "parse_override", "schema"]


def is_molecular(scene: Scene) -> "TypeGuard[MolecularScene]":
    """Whether a scene is of molecules."""
    return not isinstance(scene, BodyScene)


def __getattr__(name: str) -> object:
    """What only molecules need, which a run of a single body does not load."""
    if name == "MolecularScene":
        from rigidmd.scene.molecules import MolecularScene

        return MolecularScene
    if name == "schema":
        from rigidmd.scene.json_schema import schema

        return schema
    raise AttributeError(f"module {__name__} has no attribute {name}")
