"""The JSON schema of scenes, as an editor uses it: shipped scenes are valid, errors are given where
they are."""

import json
import tomllib

import pytest
from jsonschema import Draft202012Validator
from support.common import SYSTEMS

from rigidmd.commands.cli import main
from rigidmd.errors import SceneError
from rigidmd.scene import Scene, schema
from rigidmd.scene.models import available_models
from rigidmd.scene.validation import PATTERNS

VALIDATOR = Draft202012Validator(schema())
WATER = """
[box]
lengths_A = 20.0
[[molecules]]
model = "spce"
count = 20
[start]
temperature_K = 300
[[stages]]
duration_ps = 1
"""
TOP = """
[body]
mass_kg = 1.0
inertia_kg_m2 = [1.0, 1.0, 2.0]
[run]
duration_s = 1.0
timestep_s = 0.01
"""


def told(text):
    """Where an editor would put its marks, and what it would state."""
    return [
        (error.json_path, error.message) for error in VALIDATOR.iter_errors(tomllib.loads(text))
    ]


def test_it_is_a_schema_and_states_of_what(capsys):
    assert main(["schema"]) == 0
    printed = json.loads(
        capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON")
    )
    assert printed == schema()
    Draft202012Validator.check_schema(printed)
    assert printed["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert printed["title"]
    assert "anyOf" not in printed
    assert "null" not in json.dumps(printed)  # TOML has none


def test_shipped_scenes_are_valid():
    errors = {path.stem: told(path.read_text()) for path in SYSTEMS}
    assert not any(errors.values()), errors


@pytest.mark.parametrize(
    ("scene", "old", "new", "path", "message"),
    [
        (
            WATER,
            "lengths_A = 20.0",
            "lengths_A = 20.0\ndensity = 1",
            "$.box",
            "'density' was unexpected",
        ),
        (WATER, '"spce"', '"SPC/E"', "$.molecules[0].model", "'SPC/E' is not one of"),
        (
            WATER,
            "count = 20",
            "count = 2.5",
            "$.molecules[0].count",
            "2.5 is not of type 'integer'",
        ),
        (
            WATER,
            "duration_ps = 1",
            'duration_ps = "1"',
            "$.stages[0].duration_ps",
            "'1' is not of type 'number'",
        ),
        (TOP, "duration_s = 1.0", "", "$.run", "'duration_s' is a required property"),
        (WATER, "= 300", '= "warm"', "$.start.temperature_K", "'warm' is not of type 'number'"),
        (WATER, "[start]", "[strat]", "$", "'strat' was unexpected"),
        (WATER, "[[molecules]]", "[molecules]", "$.molecules", "is not of type 'array'"),
        (
            WATER,
            "[[stages]]",
            '[structure]\nfile = "a.data"\natom_types = { 1 = 8 }\n[[stages]]',
            "$.structure.atom_types['1']",
            "8 is not of type 'string'",
        ),
        (TOP, "timestep_s = 0.01", "timestep_fs = 0.01", "$.run", "'timestep_fs' was unexpected"),
        (TOP, "mass_kg = 1.0", "mass_kg = -1.0", "$.body.mass_kg", "-1.0 is less than or equal to"),
        (TOP, "[1.0, 1.0, 2.0]", "[1.0, 1.0]", "$.body.inertia_kg_m2", "[1.0, 1.0] is too short"),
        (
            TOP,
            "[run]",
            "[[stages]]\n[run]",
            "$",
            "'stages' was unexpected",
        ),  # a body has none: it is compared with its kind
        (
            TOP,
            "duration_s = 1.0",
            'duration_s = 1.0\nintegrator = "euler"',
            "$.run.integrator",
            "'euler' is not one of",
        ),
    ],
)
def test_errors_are_reported_where_they_are(scene, old, new, path, message):
    assert told(scene) == []
    assert old in scene
    found = told(scene.replace(old, new, 1))
    assert any(where == path and message in words for where, words in found), found
    assert len(found) <= 2  # not one for every kind of scene there might have been


def test_it_lists_the_models_that_there_are():
    assert schema()["$defs"]["Molecules"]["properties"]["model"]["enum"] == available_models()


def patterns_in(schema_part):
    if isinstance(schema_part, dict):
        yield from [schema_part["pattern"]] if isinstance(schema_part.get("pattern"), str) else []
        schema_part = schema_part.values()
    if not isinstance(schema_part, str | int | float | None):
        for part in schema_part:
            yield from patterns_in(part)


def test_each_pattern_of_a_text_is_described():
    assert {*patterns_in(schema())} == {*PATTERNS}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"forces.custom": [{"name": "1a", "energy": "1/r"}]}, "does not begin with a digit"),
        ({"forces.custom": [{"name": "", "energy": "1/r"}]}, "letters, digits and underscores"),
        ({"forces.custom": [{"name": "a" * 41, "energy": "1/r"}]}, "not have more than 40 char"),
        ({"forces.custom": [{"name": "a", "energy": ""}]}, "energy: is '', must not be empty"),
        ({"forces.bodies": [{"name": "a b", "energy": "1/r"}]}, "is 'a b', must be a name of"),
        ({"name": "-a"}, "in which points and hyphens may follow"),
        ({"integrators": [{"name": "ä", "kicks": [1.0], "drifts": [1.0]}]}, "letter from A to Z"),
        ({"structure.file": "a\nb"}, "must be one line without control characters"),
        ({"box.angles_deg": [90.0, 90.0, 180.0]}, "must be less than 180"),
    ],
)
def test_texts_and_numbers_are_refused_with_a_message(keys, message):
    with pytest.raises(SceneError) as refused:
        Scene.from_dict(tomllib.loads(WATER), overrides=keys)
    assert message in str(refused.value)
    assert "should" not in str(refused.value)
