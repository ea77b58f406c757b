"""Reading untrusted TOML within limits of size and depth, and finding the line of a key."""

import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from tomllib import TOMLDecodeError
from typing import Any

from rigidmd.core.files import unreadable_reason
from rigidmd.errors import UNPRINTABLE, InputError

#: Largest TOML file in bytes. Reading takes a second per megabyte; a molecule of 10,000 sites has
#: one megabyte.
LARGEST = 4_000_000
DEEPEST = 32  # levels of nested tables and lists; scenes need six
LEAST_WHOLE, LARGEST_WHOLE = -(2**63), 2**63 - 1  # whole numbers in TOML have 64 bits

#: A table of TOML or JSON: texts, numbers, lists and tables by their keys.
Json = dict[str, Any]

_LONG_KEY = re.compile(rf"(?<![\w\"'.-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){{{DEEPEST}}}")


def read_toml(path: Path, error_class: type[InputError]) -> tuple[Json, str]:
    """The tables of a file, and its text. Raises `error_class`."""
    try:
        if reason := unreadable_reason(path, LARGEST):
            raise error_class(str(path), [reason])
        text = path.read_text(encoding="utf-8-sig")  # editors on Windows write a byte order mark
        return parse_toml(text), text
    except OSError as error:
        raise error_class(str(path), [f"cannot be read: {error.strerror}"]) from None
    except UnicodeDecodeError as error:
        raise error_class(str(path), [f"is not TOML: {error}"]) from None
    except TOMLDecodeError as error:
        raise error_class(str(path), [describe_toml_error(error, text)]) from None


def parse_toml(text: str) -> Json:
    """The tables of a text. Raises TOMLDecodeError, also for depths and numbers that `tomllib`
    cannot read."""
    if long := _LONG_KEY.search(text):
        line = text.count("\n", 0, long.start()) + 1
        raise TOMLDecodeError(f"a key of more than {DEEPEST} parts (at line {line}, column 1)")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise TOMLDecodeError(f"lists or tables more than {DEEPEST} deep") from None
    except TOMLDecodeError:
        raise
    except ValueError as error:  # from int(), which accepts 4300 digits
        number = re.search(r"\d{4301}", text)
        line = text.count("\n", 0, number.start()) + 1 if number else 1
        why = "a whole number of more than 64 bits" if number else str(error)
        raise TOMLDecodeError(f"{why} (at line {line}, column 1)") from None


def plain_values(data: object, depth: int = 0) -> Any:
    """Tables from Python with the types of a file: str for paths and integer keys, numbers and
    lists for arrays."""
    match data:
        case _ if depth > DEEPEST + 1:  # reported by `impossible_values`
            return data
        case Mapping():
            return {
                str(key) if isinstance(key, int) else key: plain_values(value, depth + 1)
                for key, value in zip(map(plain_values, data), data.values(), strict=True)
            }
        case list() | tuple():
            return [plain_values(value, depth + 1) for value in data]
        case os.PathLike():
            return os.fspath(data)
    to_list = getattr(data, "tolist", None)  # of NumPy types, without importing NumPy
    return data if to_list is None else to_list()


def values_in(data: object) -> Iterator[tuple[list, object]]:
    """All values in nested tables and lists in their order, each with its path of keys, before the
    values in it."""
    pending: list[tuple[list, object]] = [([], data)]
    while pending:
        keys, value = pending.pop()
        yield keys, value
        if isinstance(value, dict | list | tuple):
            inner = list(value.items() if isinstance(value, dict) else enumerate(value))
            pending += [([*keys, key], part) for key, part in reversed(inner)]


def impossible_values(data: object) -> list[tuple[list, str]]:
    """Values that are not allowed in any table, each with its path of keys and what is wrong with
    it. These are tables deeper than `DEEPEST`, whole numbers of more than 64 bits and texts with
    unprintable characters."""
    errors: list[tuple[list, str]] = []
    for keys, value in values_in(data):
        match value:
            case dict() | list() | tuple() if len(keys) > DEEPEST:
                return [(keys[:DEEPEST], f"has lists or tables more than {DEEPEST} deep")]
            case dict():
                odd = [key for key in value if isinstance(key, str) and UNPRINTABLE.search(key)]
                errors += [([*keys, key], "has a control character in its name") for key in odd]
            case int() if not LEAST_WHOLE <= value <= LARGEST_WHOLE:
                errors.append((keys, "is a whole number of more than 64 bits"))
            case str() if UNPRINTABLE.search(value):
                errors.append(
                    (keys, f"is {shorten_repr(value)}: control characters are not allowed")
                )
    return errors


def shorten_text(text: str) -> str:
    """A text, without its middle if it is longer than 80 characters."""
    return text if len(text) <= 80 else f"{text[:40]}...{text[-20:]}"


def shorten_repr(value: object) -> str:
    """repr of a value, without its middle if it is long."""
    try:
        return shorten_text(repr(value))
    except (ValueError, RecursionError):  # thousands of digits; deeply nested lists
        return "too large to show"


def parse_whole_number(text: str) -> int | None:
    """The number in a text of up to 18 ASCII digits. None for any other text."""
    return int(text) if re.fullmatch(r"[0-9]{1,18}", text) else None


def describe_toml_error(error: TOMLDecodeError, text: str) -> str:
    """Message for a text that is not TOML. For a value without quotes it names the line and key."""
    position = re.search(r"at line (\d+), column (\d+)", str(error))
    number, column = map(int, position.groups()) if position else (0, 0)
    lines = text.split("\n")
    line = lines[number - 1] if 0 < number <= len(lines) else ""
    # tomllib stops at the word, or within it, for example after the "inf" of "infinite"
    bare = next(
        (
            w[1]
            for w in re.finditer(r"[=\[,]\s*([A-Za-z][\w./-]*)", line)
            if w.start(1) < column <= w.end()
        ),
        "",
    )
    keys = []
    if bare:
        before = [[*table, *entry] for at, table, entry in _lines(text) if entry and at <= number]
        keys = before[-1:]
    if not keys or re.fullmatch(r"\s*\[[^=]*\]\s*", line):  # a table header after an unclosed list
        return f"is not TOML: {error}"
    where = f"line {number}: {'.'.join(map(str, keys[0]))}: "
    match bare:
        case "True" | "False":
            return f"{where}is {bare}, must be written {bare.lower()}"
        case "None" | "null":
            return f"{where}is {bare}, which TOML does not have: omit the key"
    return f'{where}is {bare} without quotes. A text needs them: "{bare}"'


def line_of(keys: list, text: str) -> int | None:
    """Line (from 1) where a TOML text sets a path of keys, or opens the nearest table around it,
    else None."""
    entries, tables = _index(text)
    heads = [tuple(keys[:n]) for n in range(1, len(keys) + 1)]
    if set_at := [entries[head] for head in heads if head in entries]:
        return min(set_at)
    return max((tables[head] for head in heads if head in tables), default=None)


@lru_cache(maxsize=2)
def _index(text: str) -> tuple[dict[tuple, int], dict[tuple, int]]:
    """Lines (from 1) of a TOML text: the first that sets each path of keys, and the last that opens
    each table."""
    entries: dict[tuple, int] = {}
    tables: dict[tuple, int] = {}
    for number, table, entry in _lines(text):
        if entry:
            entries.setdefault((*table, *entry), number)
        else:
            tables[tuple(table)] = number
    return entries, tables


def _lines(text: str) -> Iterator[tuple[int, list, list[str]]]:
    """Lines (from 1) of a TOML text that open a table or set a key: the table's path, and the key's
    in it or []."""
    table: list = []
    counts: dict[tuple, int] = {}  # of tables in lists, by path with the list indices around them
    for number, line in enumerate(text.split("\n"), 1):
        if header := re.match(r"\s*(\[\[?)\s*([\w.\"'-]+)\s*\]", line):
            table = []
            parts = _parts(header[2])
            for depth, part in enumerate(parts, 1):
                table.append(part)
                here = tuple(table)
                if depth == len(parts) and header[1] == "[[":
                    counts[here] = counts.get(here, -1) + 1
                if here in counts:
                    table.append(counts[here])
            yield number, table, []
        elif entry := re.match(r"\s*([\w.\"'-]+)\s*=", line):
            yield number, table, _parts(entry[1])


def _parts(key: str) -> list[str]:
    """The parts of a dotted key, without quotes. A dot within quotes also divides. Such a key has
    no line."""
    return [part.strip("\"'") for part in key.split(".")]
