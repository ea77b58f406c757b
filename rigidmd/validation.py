"""Input data: strict value types for pydantic, and its errors as sentences with key and line."""

import difflib
import re
import tomllib
from collections.abc import Iterable, Iterator
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError
from pydantic_core import ErrorDetails

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Strict(), Field(gt=0)]
Flag = Annotated[bool, Strict()]
Vector = tuple[Number, Number, Number]

T = TypeVar("T")

#: With more similar names than this, no suggestion is made from a common beginning or end.
MOST_MEANT = 8


class Section(BaseModel):
    """A frozen table of a TOML file; unknown keys are faults."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


def settled(value: T | None) -> T:
    """A value that may be left out of a scene, but is there where it is used: in a validated and resolved one."""
    assert value is not None, "the scene is not validated or not resolved"
    return value


def faults_of(
    error: ValidationError, model: type[BaseModel], text: str = "", overridden: Iterable[str] = ()
) -> list[str]:
    """One sentence for each error of pydantic: line (if the TOML text is given), key, what was expected.

    overridden : dotted keys whose values come from the command line, so that they have no line
    """
    faults = {}
    for detail in error.errors():
        keys = [key for key in detail["loc"] if not _is_union_branch(key)]
        if detail["type"] == "missing" and keys and isinstance(keys[-1], int):
            keys = keys[:-1]  # a list lacks an entry: the fault is the list's
        path = ".".join(str(key) for key in keys)
        faults.setdefault((place(keys, text, overridden), path), []).append(_sentence(detail, keys, model))
    # pydantic reports one error for each type that a value may have: join them. An error inside a value is more
    # specific than one about the whole value.
    return [
        f"{where}: {_either(list(dict.fromkeys(sentences)))}"
        for (where, path), sentences in faults.items()
        if not any(other.startswith(path + ".") for _, other in faults)
    ]


def _either(sentences: list[str]) -> str:
    """Join sentences: "is 1, must be a list" and "is 1, must be a table" state only once that it is 1."""
    begin, must, _ = sentences[0].partition(", must be ")
    return " or ".join([sentences[0], *(sentence.removeprefix(begin + must) for sentence in sentences[1:])])


def place(keys: list, text: str, overridden: Iterable[str] = ()) -> str:
    """Where a key of a scene was given: its line, or the command line."""
    path = ".".join(map(str, keys))
    if any(f"{path}.".startswith(f"{key}.") for key in overridden):
        return f"--set {path}"
    line = line_of(keys, text)
    return (f"line {line}: " if line else "") + (path or "scene")


def _is_union_branch(key: Any) -> bool:
    """Whether pydantic put this into a location to name the branch of a union."""
    return isinstance(key, str) and bool(re.search(r"[\[(]|^(constrained-)?(float|int|bool|str)$", key))


def _sentence(detail: ErrorDetails, keys: list, model: type[BaseModel]) -> str:
    value = detail["input"]
    shown = repr(value) if not isinstance(value, dict | list) else f"a {'table' if isinstance(value, dict) else 'list'}"
    context = detail.get("ctx", {})
    match detail["type"]:
        case "extra_forbidden":
            known = _known_keys(model, keys[:-1])
            listed = f"; known here: {', '.join(known)}" if known else ""
            return "unknown key" + (meant(str(keys[-1]), known) or listed)
        case "missing" if isinstance(detail["loc"][-1], int) and isinstance(value, list | tuple):
            return f"has {len(value)} entries, needs more"
        case "missing":
            return "is missing"
        case "too_long":
            return f"has {context['actual_length']} entries, must not have more than {context['max_length']}"
        case "greater_than":
            return f"is {shown}, must be greater than {context['gt']:g}"
        case "greater_than_equal":
            return f"is {shown}, must not be less than {context['ge']:g}"
        case "finite_number":
            return f"is {shown}, must be a finite number"
        case "float_type":
            return f"is {shown}, must be a number"
        case "int_type" | "int_from_float":
            return f"is {shown}, must be a whole number"
        case "bool_type":
            return f"is {shown}, must be true or false"
        case "string_type":
            return f"is {shown}, must be a text in quotes"
        case "literal_error":
            wanted = context["expected"]
            return f"is {shown}, must be {wanted}" + meant(str(value), re.findall(r"'([^']*)'", wanted))
        case "too_short":
            least = context["min_length"]
            return f"has {context['actual_length']} entries, needs at least {least}"
        case "tuple_type" | "list_type" if isinstance(value, dict):
            return f"is a table, must be a list of tables: write [[{'.'.join(map(str, keys))}]]"
        case "tuple_type" | "list_type":
            return f"is {shown}, must be a list"
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"is {shown}, must be a table"
        case "less_than_equal":
            return f"is {shown}, must not be more than {context['le']:g}"
        case "string_pattern_mismatch" if "!-~" in context["pattern"]:
            return f"is {shown}, must be one to five visible ASCII characters without spaces"
        case "value_error":
            return str(context["error"])
    return f"is {shown}: {detail['msg']}"


def meant(name: str, known: Iterable[str]) -> str:
    """'; did you mean ...?' for an unknown name; empty if no known name is similar."""
    return perhaps(nearest(name, known))


def perhaps(names: list[str]) -> str:
    """'; did you mean ...?' for these names; empty for none."""
    return f"; did you mean {' or '.join(names)}?" if names else ""


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """Known names that an unknown one may stand for.

    These are the names that differ only in case and punctuation; else those that begin with it, as when a unit is
    forgotten, or end with it; else the one with the most similar spelling.
    """
    plain = {key: _plain(key) for key in known}
    asked = _plain(name)
    near = [key for key, letters in plain.items() if letters == asked]
    near = near or [key for key, letters in plain.items() if asked and letters.startswith(asked)]
    near = near or [key for key, letters in plain.items() if asked and letters.endswith(asked)]
    if not near or len(near) > MOST_MEANT:
        alike = difflib.get_close_matches(asked, plain.values(), 1, 0.6)
        near = [key for key, letters in plain.items() if letters in alike]
    return near


def _plain(name: str) -> str:
    return re.sub(r"[\W_]", "", name).lower()


def toml_fault(error: tomllib.TOMLDecodeError, text: str) -> str:
    """What is wrong with a text that is not TOML. For a value without quotes the line and key are named."""
    place = re.search(r"at line (\d+), column (\d+)", str(error))
    number, column = map(int, place.groups()) if place else (0, 0)
    line = text.splitlines()[number - 1] if place else ""
    # tomllib stops at the word, or within it: after the inf of "infinite"
    bare = next((w[1] for w in re.finditer(r"[=\[,]\s*([A-Za-z][\w./-]*)", line) if w.start(1) < column <= w.end()), "")
    if not bare or re.fullmatch(r"\s*\[[^=]*\]\s*", line):  # a table header after a list that is not closed
        return f"is not TOML: {error}"
    keys = [[*table, *entry] for at, table, entry in _lines(text) if entry and at <= number][-1]
    where = f"line {number}: {'.'.join(map(str, keys))}: "
    match bare:
        case "True" | "False":
            return f"{where}is {bare}, must be written {bare.lower()}"
        case "None" | "null":
            return f"{where}is {bare}, which TOML does not have: omit the key"
    return f'{where}is {bare} without quotes; a text needs them: "{bare}"'


def _known_keys(model: type[BaseModel], keys: list) -> list[str]:
    """Keys of the section at a path of keys."""
    for key in keys:
        if isinstance(key, int):
            continue
        inner = _models_in(model.model_fields[key].annotation)
        if not inner:
            return []
        model = inner[0]
    return list(model.model_fields)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for part in getattr(annotation, "__args__", ()) for m in _models_in(part)]


def line_of(keys: list, text: str) -> int | None:
    """Line (from 1) where a TOML text sets a path of keys, or opens the nearest table around it; else None."""
    found = None
    for number, table, entry in _lines(text):
        if entry:
            if keys[: len(table) + len(entry)] == [*table, *entry]:
                return number
        elif keys[: len(table)] == table:
            found = number
    return found


def _lines(text: str) -> Iterator[tuple[int, list, list[str]]]:
    """Lines (from 1) of a TOML text that open a table or set a key: the table's path, and the key's in it or []."""
    table: list = []
    counts: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*\[\[\s*([\w.\"-]+)\s*\]\]", line):
            name = header[1]
            counts[name] = counts.get(name, -1) + 1
            for inner in [key for key in counts if key.startswith(name + ".")]:
                del counts[inner]
        elif header := re.match(r"\s*\[\s*([\w.\"-]+)\s*\]", line):
            name = header[1]
        else:
            if entry := re.match(r"\s*([\w.\"-]+)\s*=", line):
                yield number, table, entry[1].split(".")
            continue
        table = []
        parts = name.split(".")
        for depth, part in enumerate(parts, 1):
            table.append(part)
            if (index := counts.get(".".join(parts[:depth]))) is not None:
                table.append(index)
        yield number, table, []
