"""The JSON schema of scene files."""

from pydantic import BaseModel
from pydantic.json_schema import (
    GenerateJsonSchema,
    JsonSchemaMode,
    JsonSchemaValue,
    models_json_schema,
)

from rigidmd.core.toml import Json
from rigidmd.scene.base import Scene
from rigidmd.scene.kinds import scene_classes
from rigidmd.scene.models import available_models


def schema() -> Json:
    """The JSON schema of scene files, of the kind whose table a file has, else of molecules."""
    *others, molecules = kinds = scene_classes()
    models: list[tuple[type[BaseModel], JsonSchemaMode]] = [(kind, "validation") for kind in kinds]
    _, document = models_json_schema(models, schema_generator=_TomlSchema)
    definitions = document["$defs"]
    definitions["Molecules"]["properties"]["model"]["enum"] = available_models()
    for kind in kinds:
        _name_integrators(definitions, definitions[kind.__name__])
    chosen: Json = _reference(molecules)
    for kind in others:
        chosen = {"if": {"required": [kind.kind]}, "then": _reference(kind), "else": chosen}
    subjects = " or ".join(kind.subject for kind in (molecules, *others))
    return {
        "$schema": GenerateJsonSchema.schema_dialect,
        "title": "A scene of rigidmd",
        "description": f"Moving {subjects}, as `rigidmd run` takes them.",
        "type": "object",
        **chosen,
        **document,
    }


def _reference(kind: type[Scene]) -> Json:
    return {"$ref": f"#/$defs/{kind.__name__}"}


def _name_integrators(definitions: Json, scene: Json) -> None:
    """Require a known integrator in the section of a scene that has one, unless [[integrators]]
    adds others."""
    for key, section in scene["properties"].items():
        name = section.get("items", section).get("$ref", "").rpartition("/")[2]
        integrator = definitions.get(name, {}).get("properties", {}).get("integrator")
        if integrator is None or "enum" not in integrator:
            continue
        known = {"properties": {"integrator": {"enum": integrator.pop("enum")}}}
        one_or_all = {"items": known} if "items" in section else known
        scene |= {
            "if": {"required": ["integrators"]},
            "else": {"properties": {key: one_or_all}},
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
