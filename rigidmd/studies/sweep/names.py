"""Names of the points of a sweep: folders that a person can read and every file system can hold."""

import hashlib
import re
from collections.abc import Iterable, Mapping
from typing import Any

#: Letters of a name.
LONGEST = 120


def short_keys(keys: Iterable[str]) -> dict[str, str]:
    """Key -> as much of its end as tells it from the others: temperature_K of stages.0.temperature_K."""
    keys = list(keys)
    found = {}
    for key in keys:
        parts = key.split(".")
        ends = (".".join(parts[-n:]) for n in range(1, len(parts) + 1))
        alone = (end for end in ends if not any(other != key and f".{other}".endswith(f".{end}") for other in keys))
        found[key] = re.sub(r"[^\w.+\-]", "-", next(alone, key))
    return found


def value_name(value: Any) -> str:
    """A value in the name of a folder: letters, digits and . + - only; equal values have equal names."""
    match value:
        case bool():
            return str(value).lower()
        case float() if value.is_integer() and abs(value) < 1e15:
            return str(int(value))
        case int() | float():
            return repr(value)
        case list() | tuple() if all(isinstance(one, int | float) for one in value):
            return "x".join(map(value_name, value))
    plain = re.sub(r"[^\w.+\-]", "-", str(value)).lstrip(".")
    if plain == value and len(plain) <= LONGEST // 3:
        return plain
    return f"{plain[: LONGEST // 3]}-{hashlib.sha256(repr(value).encode()).hexdigest()[:6]}"


def point_name(values: Mapping[str, Any], short: Mapping[str, str]) -> str:
    """The name of a point's folder: temperature_K=280_seed=1."""
    name = "_".join(f"{short[key]}={value_name(value)}" for key, value in values.items())
    if len(name) <= LONGEST:
        return name
    return f"{name[:LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def in_words(values: Mapping[str, Any], short: Mapping[str, str]) -> str:
    """Values for people: temperature_K = 280, seed = 1."""
    return ", ".join(f"{short[key]} = {value_name(value)}" for key, value in values.items())
