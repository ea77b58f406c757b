"""Scenes: `Scene.read(path)` returns the scene of molecules, or of a kind that a feature adds."""

from typing import TYPE_CHECKING, TypeGuard

from rigidmd.scene.base import Scene, parse_override

if TYPE_CHECKING:
    from rigidmd.features.bodies.keys.body import BodyScene
    from rigidmd.scene.json_schema import schema
    from rigidmd.scene.molecules import MolecularScene

    OneScene = MolecularScene | BodyScene

__all__ = ["BodyScene", "MolecularScene", "Scene", "is_molecular", "parse_override", "schema"]


def is_molecular(scene: Scene) -> "TypeGuard[MolecularScene]":
    """Whether a scene is of molecules."""
    return scene.kind == "molecules"


def __getattr__(name: str) -> object:
    """What not every scene needs. A run loads its kind of scene only."""
    from rigidmd.scene.kinds import scene_class

    if name == "MolecularScene":
        return scene_class("molecules")
    if name == "BodyScene":
        return scene_class("body")
    if name == "schema":
        from rigidmd.scene.json_schema import schema

        return schema
    raise AttributeError(f"module {__name__} has no attribute {name}")
