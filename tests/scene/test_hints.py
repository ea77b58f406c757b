"""Hints of messages: keys of other programs, of other tables, in other units."""

import json
import re
import tomllib

import pytest
from support.common import ROOT, small_scene

from rigidmd.errors import SceneError
from rigidmd.scene import Scene, schema
from rigidmd.scene.stage import Stage

FOREIGN = tomllib.loads((ROOT / "rigidmd/scene/foreign_keys.toml").read_text(encoding="utf-8"))


def hint_on(name, table, section):
    """The message for an unknown key of a table."""
    unknown = {name: 1}
    wheels = table == "wheels"
    with pytest.raises(SceneError) as raised:
        Scene.from_dict({"body": {}, "wheels": [unknown]} if wheels else {section: unknown})
    begin = f"{'wheels.0' if wheels else section}.{name}: unknown key"
    (found,) = [line for line in raised.value.errors if line.startswith(begin)]
    return found


def test_the_strength_of_gravity_becomes_a_vector():
    assert hint_on("g", "", "gravity").endswith("write acceleration_m_s2 = [0, 0, -1]")
    assert "write" not in hint_on("seed", "", "gravity")


def test_a_list_of_known_keys_does_not_hide_that_some_are_missing():
    with pytest.raises(SceneError) as raised:
        Scene.from_dict({"body": {"mass_kg": 1.0, "inertia_kg_m2": [1, 1, 1]}, "run": {"zzz": 1}})
    assert raised.value.errors[:2] == ["run.duration_s: is missing", "run.timestep_s: is missing"]


def test_a_setting_of_another_program_names_the_key_of_a_scene():
    wrong = []
    entries = [(table, *item) for table in FOREIGN for item in FOREIGN[table].items()]
    for table, key, text in entries:
        section = "body" if key.endswith("_s") or table == "body" else "forces"
        names, _, note = text.partition(": ")
        named = "" if table == "none" else f"In rigidmd this is {key}"
        for name in names.split():
            for asked in (name, name.upper().replace("_", "-")):
                found = hint_on(asked, table, section)
                if note not in found or named not in found:
                    wrong.append((asked, found))
    assert not wrong


def test_what_stands_for_a_setting_of_another_program_is_a_key():
    tables = json.dumps(schema()["$defs"])
    names = [name for table in FOREIGN if table != "none" for name in FOREIGN[table]]
    assert [name for name in names if f'"{name}": ' not in tables] == []


def test_a_hint_names_the_table_and_the_unit():
    with pytest.raises(
        SceneError,
        match=r"forces.rcut: unknown key. In rigidmd this is cutoff_A in \[forces\] \(in Å\)",
    ):
        small_scene({"spce": 20}, 20.0, forces={"rcut": 9.0})
    with pytest.raises(
        SceneError, match=r"stages.0.timestep: unknown key; did you mean timestep_fs\?"
    ):
        small_scene({"spce": 20}, 20.0, stages=[{"timestep": 1.0}])


LIQUID = {
    "box": {"lengths_A": 20.0},
    "molecules": [{"model": "spce", "count": 20}],
    "stages": [{"ensemble": "nvt", "duration_ps": 1.0, "temperature_K": 300.0}],
}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ("stages = [{tau_t_ps = 1.0}]", "this is thermostat_time_ps in [[stages]] (in ps)"),
        ("stages = [{tdamp_ps = 1.0}]", "this is thermostat_time_ps in [[stages]]"),
        ("stages = [{duration_ns = 1.5}]", "duration_ns: unknown key; write duration_ps = 1500"),
        (
            "stages = [{temperature_C = 25}]",
            "temperature_C: unknown key; write temperature_K = 298.15",
        ),
        ("forces.cutoff_nm = 0.9", "cutoff_nm: unknown key; write cutoff_A = 9"),
        ("nonbonded = {}", "nonbonded: unknown key; did you mean forces?"),
        ("initial = {}", "initial: unknown key; did you mean start?"),
        ("electrostatics.method = 'pme'", "electrostatics is a key of [forces]"),
        ("run.seed = 3", "run.seed: unknown key; seed is a key of the top level"),
        ("stages = [{cutoff_A = 9.0}]", "cutoff_A is a key of [forces]"),
        ("forces.integrator = 'baoab'", "integrator is a key of [[stages]]"),
        ("forces.coulomb = 'pme'", "In rigidmd this is electrostatics in [forces]"),
        ("gravity = {}", "gravity: unknown key; only a scene of a single body has it"),
        ("molecules = [{model = 'N2'}]", "did you mean nitrogen or nitrogen_2cljq or"),
    ],
)
def test_a_hint_on_units_tables_and_keys_of_other_tables(changes, expected):
    changes = tomllib.loads(changes)
    with pytest.raises(SceneError) as raised:
        Scene.from_dict(LIQUID | changes)
    assert expected in str(raised.value)


def test_a_single_body_has_no_engine(printed):
    for command in ("check", "run", "verify"):
        assert (
            "engine: unknown key; only a scene of molecules has it"
            in printed(command, ROOT / "systems/t_handle.toml", "--engine", "lammps", code=2).err
        )


def test_a_long_list_of_keys_has_the_most_similar_ones():
    with pytest.raises(SceneError) as raised:
        Scene.from_dict(LIQUID | {"stages": [{"xyzzy": 1.0, "duration_ps": 1.0}]})
    (line,) = (line for line in raised.value.errors if "xyzzy" in line)
    assert re.search(r"there are (\w+, ){7}\w+ and \d+ others$", line)
    listed = re.findall(r"\w+", line.partition("there are ")[2].partition(" and ")[0])
    assert listed == [key for key in Stage.model_fields if key in listed]


def test_american_spelling_is_accepted():
    stage = {"ensemble": "minimize"}
    assert Scene.from_dict(LIQUID | {"stages": [stage]}).stages[0].ensemble == "minimise"
    top = {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 1.0, 0.5], "center_of_mass_m": [0, 0, 0.1]}
    run = {"duration_s": 1.0, "timestep_s": 0.01}
    scene = Scene.from_dict({"body": top | {"pinned": True}, "run": run})
    assert scene.body.centre_of_mass_m == (0, 0, 0.1)
