"""Hints on unknown keys of a scene: settings of other programs, other units, other tables."""

import difflib
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel

from rigidmd.core.plain_text import did_you_mean, plain_letters, suggestion
from rigidmd.scene.table_in_file import TableInFile

FOREIGN_KEYS = Path(__file__).with_name("foreign_keys.toml")
#: Names that readers give to tables -> the table of a scene.
TABLES = {
    "forces": ("interactions", "nonbonded", "potential", "pair", "forcefield"),
    "start": ("initial", "init", "initialization", "initialisation"),
    "stages": ("simulation", "md", "dynamics", "protocol"),
    "structure": ("input", "coordinates", "configuration"),
    "output": ("files", "reporters", "dump"),
}
#: Functions that return the classes of scenes, which are validated with these hints. They are in
#: `scene.kinds`.
KINDS: list[Callable[[], list]] = []
MOST_LISTED = 8  # known keys in a message
#: Names of the strength of gravity.
GRAVITY = ("g", "acceleration", "gravity", "strength", "value")
BOHR = 0.529177210903  # Å
CELSIUS = ("C", "degC", "celsius")
ICE_POINT = 273.15
#: By the unit of a key, the sizes of other units in it.
OTHER_UNITS = {
    "ps": {"fs": 1e-3, "ps": 1.0, "ns": 1e3, "us": 1e6, "µs": 1e6, "s": 1e12},
    "fs": {"as": 1e-3, "fs": 1.0, "ps": 1e3, "ns": 1e6, "s": 1e15},
    "A": {"pm": 1e-2, "A": 1.0, "Å": 1.0, "bohr": BOHR, "nm": 10.0},
    "K": {"K": 1.0},
    "bar": {
        "Pa": 1e-5,
        "kPa": 1e-2,
        "MPa": 10.0,
        "GPa": 1e4,
        "bar": 1.0,
        "kbar": 1e3,
        "atm": 1.01325,
    },
    "kJ_mol": {"J/mol": 1e-3, "kJ/mol": 1.0, "kcal/mol": 4.184},
    "deg": {"deg": 1.0, "°": 1.0},
    "s": {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0},
    "m": {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3},
    "kg": {"mg": 1e-6, "g": 1e-3, "kg": 1.0},
}
#: A key whose unit is one of these, and not a product or quotient of units.
KEY_WITH_UNIT = re.compile(rf"(?:.*_)?[a-z]{{4,}}_({'|'.join(OTHER_UNITS)})")
#: The unit at the end of a key.
UNIT = re.compile(
    r"_(?:per_)?(?:as|fs|ps|ns|us|s|pm|A|nm|m|K|bar|atm|Pa|MPa|GPa|g_cm3|kJ_mol(?:_A2?)?|kcal_mol|"
    r"deg|rad|kg|g|e|u)$"
)


def hint_on_key(name: str, keys: list, value: object, model: type[BaseModel]) -> str:
    """What a scene has instead of an unknown key.

    Parameters
    ----------
    name
        The unknown key
    keys
        The path of its table
    value
        Its value
    model
        The scene
    """
    known = known_keys(model, keys)
    bare = UNIT.sub("", name)
    is_start = any(re.fullmatch(f"{re.escape(name)}_[a-zA-Z0-9_]+", key) for key in known)
    if converted := _other_unit(name, value, known):
        return converted
    if bare in GRAVITY and known == ["acceleration_m_s2"] and isinstance(value, int | float):
        return f"; write acceleration_m_s2 = [0, 0, {-abs(value):.12g}]"
    if longer := _with_its_words(name, known):
        return suggestion(longer)
    if not is_start and (foreign := _foreign(name, model) or _foreign(bare, model)):
        return foreign
    if not keys and (table := _table_of(name, known)):
        return f"; did you mean {table}?"
    if not keys and (subject := _only_subject(name)):
        return f"; only a scene of {subject} has it"
    if not is_start and (elsewhere := _elsewhere(name, keys, model)):
        return elsewhere
    return did_you_mean(name, known) or _listed(name, known)


def _only_subject(name: str) -> str:
    """What moves in the only kind of scenes that have a key at the top level. Empty if several or
    none have it."""
    subjects = [
        scene.subject for scenes in KINDS for scene in scenes() if name in scene.model_fields
    ]
    return subjects[0] if len(subjects) == 1 else ""


def _other_unit(name: str, value: object, known: list[str]) -> str:
    """Advice on a key in another unit, such as duration_ns."""
    number = value if isinstance(value, int | float) and not isinstance(value, bool) else None
    for key in known:
        if not (match := KEY_WITH_UNIT.fullmatch(key)):
            continue
        stem = key.removesuffix(match[1])
        if match[1] == "K" and name in [stem + unit for unit in CELSIUS]:
            new = "" if number is None else f" = {number + ICE_POINT:.12g}"
            return f"; write {key}{new}"
        size = OTHER_UNITS[match[1]].get(name.removeprefix(stem)) if name.startswith(stem) else None
        if size is not None:
            new = "" if number is None else f" = {number * size:.12g}"
            return f"; write {key}{new}"
    return ""


def _with_its_words(name: str, known: list[str]) -> list[str]:
    """Longer keys with all words of a key: angular_velocity_lab_rad_s of angular_velocity_rad_s."""
    words = set(name.split("_"))
    return [key for key in known if len(words) > 2 and words < set(key.split("_"))]


def _table_of(name: str, known: list[str]) -> str:
    """The table that an unknown table stands for."""
    plain = plain_letters(name)
    tables = [table for table, others in TABLES.items() if plain in others and table in known]
    return tables[0] if tables else ""


def _elsewhere(name: str, keys: list, model: type[BaseModel]) -> str:
    """Where else a scene has this key: at its top level, or in one of its tables."""
    if keys and name in model.model_fields:
        return f"; {name} is a key of the top level"
    here = [key for key in keys if isinstance(key, str)]
    for table, field in model.model_fields.items():
        if models_in(field.annotation) and [table] != here and name in known_keys(model, [table]):
            is_list = "tuple" in str(field.annotation)
            return f"; {name} is a key of {f'[[{table}]]' if is_list else f'[{table}]'}"
    return ""


def _listed(name: str, known: list[str]) -> str:
    """The known keys, or the most similar of them."""
    if not known:
        return ""
    if len(known) == 1:
        return f"; the only key is {known[0]}"
    if len(known) <= MOST_LISTED + 1:
        return f"; there are {', '.join(known)}"
    nearest = sorted(known, key=lambda key: -_similarity(name, key))[:MOST_LISTED]
    listed = ", ".join(key for key in known if key in nearest)
    return f"; there are {listed} and {len(known) - MOST_LISTED} others"


def _similarity(name: str, key: str) -> float:
    return difflib.SequenceMatcher(None, plain_letters(name), plain_letters(key)).ratio()


def _foreign(name: str, model: type[BaseModel]) -> str:
    """What a scene has for a setting of another program. Empty for other names."""
    for table, entries in tomllib.loads(FOREIGN_KEYS.read_text(encoding="utf-8")).items():
        section = model.model_fields.get(table)
        path = [] if table == "scene" else [table]
        for key, text in entries.items():
            names, _, note = text.partition(": ")
            if plain_letters(name) not in map(plain_letters, names.split()):
                continue
            if table == "none" and "stages" in model.model_fields:
                return f". Not needed: {note}"
            if (section or not path) and key in known_keys(model, path):
                if "tuple" in str(section):
                    where = f" in [[{table}]]"
                elif path:
                    where = f" in [{table}]"
                else:
                    where = ""
                return f". In rigidmd this is {key}{where}{note and f' ({note})'}"
    return ""


def known_keys(model: type[BaseModel], keys: list) -> list[str]:
    """Keys of the section at a path of keys."""
    for key in keys:
        if isinstance(key, int):
            continue
        inner = models_in(model.model_fields[key].rebuild_annotation())
        if not inner:
            return []
        model = inner[0]
    return list(model.model_fields)


def models_in(annotation: object) -> list[type[BaseModel]]:
    """The models in the type of a key."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if isinstance(annotation, TableInFile):
        return [annotation.model]
    parts = (*getattr(annotation, "__args__", ()), *getattr(annotation, "__metadata__", ()))
    return [model for part in parts for model in models_in(part)]


def in_british(name: str) -> str:
    """A name in British spelling: centre for center, minimise for minimize."""
    return re.sub("iz(?=e|a)", "is", name.replace("center", "centre"))
