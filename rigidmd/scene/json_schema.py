"""The JSON schema of scene files."""

from pydantic import BaseModel
from pydantic.json_schema import (
    GenerateJsonSchema,
    JsonSchemaMode,
    JsonSchemaValue,
    models_json_schema,
)

from rigidmd.core.toml import Json
from rigidmd.features.bodies.keys.body import BodyScene
from rigidmd.scene.models import available_models
from rigidmd.scene.molecules import MolecularScene


def schema() -> Json:
    """The JSON schema of scene files: `BodyScene` for a file with a table [body], else
    `MolecularScene`."""
    kinds: list[tuple[type[BaseModel], JsonSchemaMode]] = [
        (BodyScene, "validation"),
        (MolecularScene, "validation"),
    ]
    _, document = models_json_schema(kinds, schema_generator=_TomlSchema)
    document["$defs"]["Molecules"]["properties"]["model"]["enum"] = available_models()
    # other names need [[integrators]]
    for kind, section in (("MolecularScene", "Stage"), ("BodyScene", "Run")):
        enum = document["$defs"][section]["properties"]["integrator"].pop("enum")
        known = {"properties": {"integrator": {"enum": enum}}}
        sections = {"run": known} if section == "Run" else {"stages": {"items": known}}
        document["$defs"][kind] |= {
            "if": {"required": ["integrators"]},
            "else": {"properties": sections},
        }
    return {
        "$schema": GenerateJsonSchema.schema_dialect,
        "title": "A scene of rigidmd",
        "description": "Moving molecules or a single body, as `rigidmd run` takes them.",
        "type": "object",
        "if": {"required": ["body"]},
        "then": {"$ref": "#/$defs/BodyScene"},
        "else": {"$ref": "#/$defs/MolecularScene"},
        **document,
    }


class _TomlSchema(GenerateJsonSchema):
    """JSON schema for TOML, which has no null. Only keys have defaults, and only those that JSON
    can hold."""

    def nullable_schema(self, schema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema) -> JsonSchemaValue:
        entry = super().default_schema(schema)
        default = entry.get("default")
        if default is None or default == float("inf") or isinstance(default, dict):
            entry.pop("default", None)
        return entry

    def field_title_should_be_set(self, schema) -> bool:
        return False  # "Timestep Fs" adds nothing to timestep_fs
