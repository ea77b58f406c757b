"""The value of a run: `Scene.read(path)` gives the scene of molecules or of a single body."""

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, JsonSchemaValue, models_json_schema

from rigidmd.molecules import available_models
from rigidmd.scene.base import Scene, parse_override
from rigidmd.scene.body import BodyScene
from rigidmd.scene.molecules import MolecularScene

__all__ = ["BodyScene", "MolecularScene", "Scene", "parse_override", "schema"]


def schema() -> dict[str, Any]:
    """The JSON schema of scene files: with a table [body] of a single body, without one of molecules.

    By the condition an editor holds a file against the kind of scene that it is, and says what is wrong there.
    """
    scenes: list[tuple[type[BaseModel], JsonSchemaMode]] = [
        (kind, "validation") for kind in (BodyScene, MolecularScene)
    ]
    _, found = models_json_schema(scenes, schema_generator=_TomlSchema)
    found["$defs"]["Molecules"]["properties"]["model"]["enum"] = available_models()
    return {
        "$schema": GenerateJsonSchema.schema_dialect,
        "title": "A scene of rigidmd",
        "description": "Molecules that move, or a single body: what `rigidmd run` takes.",
        "type": "object",
        "if": {"required": ["body"]},
        "then": {"$ref": "#/$defs/BodyScene"},
        "else": {"$ref": "#/$defs/MolecularScene"},
        **found,
    }


class _TomlSchema(GenerateJsonSchema):
    """JSON schema of what TOML can hold: no null. Defaults are those that JSON can hold, and of keys, not tables."""

    def nullable_schema(self, schema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema) -> JsonSchemaValue:
        found = super().default_schema(schema)
        default = found.get("default")
        if default is None or default == float("inf") or isinstance(default, dict):
            found.pop("default", None)
        return found

    def field_title_should_be_set(self, schema) -> bool:
        return False  # "Timestep Fs" says nothing that timestep_fs does not
