"""The axes of a sweep: keys of a scene with lists of values, from `--set` or from Python."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

from rigidmd.core.toml import parse_whole_number, plain_values, shorten_repr
from rigidmd.errors import SceneError
from rigidmd.scene import parse_override
from rigidmd.studies.sweep.folder import value_name

#: Largest number of points of a sweep.
MOST_POINTS = 100_000
OPTION = "--set"


class Axis(NamedTuple):
    """Keys that are set together, to one value after another. An axis that is not `swept` has one value."""

    keys: tuple[str, ...]
    values: tuple[Any, ...]
    swept: bool = True


def parse_axis(text: str) -> Axis:
    """KEY=A,B,... of the command line; KEY=1..8 for whole numbers; KEY,KEY=A,B for keys that vary together.

    `parse_override` reads the values. Commas in brackets or quotes do not separate values. Raises SceneError.
    """
    name, equals, listed = text.partition("=")
    keys = tuple(key.strip() for key in name.split(","))
    if not equals or not all(keys):
        raise SceneError(OPTION, [f"{text!r} is not KEY=VALUE, for example stages.0.temperature_K=280,290,300"])
    pieces = _split_at_commas(listed, text)
    if len(pieces) == 1 and (not pieces[0] or (span := _parse_range(pieces[0], text)) is None):
        return Axis(keys, (parse_override(f"{keys[0]}={listed}")[1],), swept=False)
    if not all(pieces):
        raise SceneError(OPTION, [f"{shorten_repr(text)} has an empty value between its commas"])
    values: list[Any] = []
    for piece in pieces:
        span = _parse_range(piece, text)
        values += [parse_override(f"{keys[0]}={piece}")[1]] if span is None else span
    return Axis(keys, tuple(values))


def parse_axes(texts: Sequence[str]) -> list[Axis]:
    """`parse_axis` of each. Raises SceneError with all errors."""
    found, errors = [], []
    for text in texts:
        try:
            found.append(parse_axis(text))
        except SceneError as error:
            errors += error.errors
    if errors:
        raise SceneError(OPTION, errors)
    return found


def _parse_range(piece: str, text: str) -> range | None:
    """The whole numbers of 1..8, both ends included; None for another text. Raises SceneError."""
    if not (ends := re.fullmatch(r"(-?\d+(?:\.\d+)?)\s*\.\.\s*(-?\d+(?:\.\d+)?)", piece)):
        return None
    if any(parse_whole_number(end.removeprefix("-")) is None for end in ends.groups()):
        error = f"{shorten_repr(text)}: {piece} is not a range of whole numbers; list the values: 0.1,0.2"
        raise SceneError(OPTION, [error])
    first, last = int(ends[1]), int(ends[2])
    if last < first:
        raise SceneError(OPTION, [f"{shorten_repr(text)}: the range {piece} is empty; begin with the smaller number"])
    if last - first >= MOST_POINTS:
        raise SceneError(OPTION, [f"{shorten_repr(text)}: the range {piece} has more than {MOST_POINTS} values"])
    return range(first, last + 1)


def _split_at_commas(listed: str, text: str) -> list[str]:
    """The parts between commas that are not in brackets or quotes. Raises SceneError."""
    parts, depth, quote, begin = [], [], "", 0
    closing = {"[": "]", "{": "}"}
    for k, letter in enumerate(listed):
        if quote:
            quote = "" if letter == quote and (letter == "'" or listed[k - 1] != "\\") else quote
        elif letter in "\"'":
            quote = letter
        elif letter in closing:
            depth.append(closing[letter])
        elif letter in "]}":
            if not depth or depth.pop() != letter:
                raise SceneError(OPTION, [f"{shorten_repr(text)}: {letter} closes nothing"])
        elif letter == "," and not depth:
            parts.append(listed[begin:k])
            begin = k + 1
    if depth or quote:
        raise SceneError(OPTION, [f"{shorten_repr(text)}: {depth[-1] if depth else quote} is missing"])
    return [part.strip() for part in [*parts, listed[begin:]]]


def check_axes(axes: Sequence[Axis]) -> list[Axis]:
    """The axes, if they make a sweep. Raises SceneError with all errors."""
    errors = []
    for key, times in Counter(key for axis in axes for key in axis.keys).items():
        if times > 1:
            errors.append(f"{key} is set {times} times; give its values in one list: {key}=A,B")
    for axis in axes:
        names = Counter(value_name(value) for value in axis.values)
        errors += [f"{axis.keys[0]}: {name} is listed {times} times" for name, times in names.items() if times > 1]
    swept = [axis for axis in axes if axis.swept]
    if not swept:
        errors.append(
            "no key has several values: give it a list or a range, such as --set stages.0.temperature_K=280,290 or "
            "--set seed=1..8"
        )
    count = 1
    for axis in swept:
        count *= len(axis.values)
    if count > MOST_POINTS:
        errors.append(f"these are {count} points; a sweep has {MOST_POINTS} at most")
    if errors:
        raise SceneError(OPTION, errors)
    return list(axes)


def axes_of(sets: Mapping[str, Any]) -> list[Axis]:
    """Axes from Python: key -> a list, tuple, array or range of values, or one value for all points.

    Keys that vary together are one text with commas. A list that is one value is put into a list:
    {"box.lengths_A": [[30, 30, 30]]}.
    """
    found = []
    for name, given in sets.items():
        keys = tuple(key.strip() for key in name.split(","))
        given = plain_values(given)
        swept = isinstance(given, Iterable) and not isinstance(given, str | bytes | Mapping)
        found.append(Axis(keys, tuple(map(plain_values, given if swept else (given,))), swept))
    return found


def settings(axes: Sequence[Axis]) -> list[dict[str, Any]]:
    """The values of the swept keys at each point, the last axis fastest; only the first of keys that vary together."""
    swept = [axis for axis in axes if axis.swept]
    return [
        dict(zip((axis.keys[0] for axis in swept), values, strict=True))
        for values in product(*(axis.values for axis in swept))
    ]
