"""The value of a run: `Scene.read(path)` gives the scene of molecules or of a single body."""

from typing import Any

from pydantic import TypeAdapter

from rigidmd.scene.base import Scene, parse_override
from rigidmd.scene.body import BodyScene
from rigidmd.scene.molecules import MolecularScene

__all__ = ["BodyScene", "MolecularScene", "Scene", "parse_override", "schema"]


def schema() -> dict[str, Any]:
    """The JSON schema of scene files, of both kinds."""
    return TypeAdapter(MolecularScene | BodyScene).json_schema()
