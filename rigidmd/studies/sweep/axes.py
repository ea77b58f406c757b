"""What a sweep varies: keys of a scene with lists of values, as `--set` tells them."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

from rigidmd.core.toml import plain_values, shortened, whole_number
from rigidmd.errors import SceneError
from rigidmd.scene import parse_override
from rigidmd.studies.sweep.names import value_name

#: Points of a sweep.
MOST_POINTS = 100_000
SEED = "seed"
#: Where faults of --set are.
WHERE = "--set"


class Axis(NamedTuple):
    """Keys that are set together, to one value after another. An axis that is not `swept` has one value for all."""

    keys: tuple[str, ...]
    values: tuple[Any, ...]
    swept: bool = True


def parse_axis(text: str) -> Axis:
    """KEY=A,B,... of the command line; KEY=1..8 for whole numbers; KEY,KEY=A,B for keys that go together.

    Values are read as those of `parse_override`. A comma in brackets or quotes divides nothing. Raises SceneError.
    """
    name, equals, told = text.partition("=")
    keys = tuple(key.strip() for key in name.split(","))
    if not equals or not all(keys):
        raise SceneError(WHERE, [f"{text!r} is not KEY=VALUE, for example stages.0.temperature_K=280,290,300"])
    pieces = _divided(told, text)
    if len(pieces) == 1 and (not pieces[0] or (span := _span(pieces[0], text)) is None):
        return Axis(keys, (parse_override(f"{keys[0]}={told}")[1],), swept=False)
    if not all(pieces):
        raise SceneError(WHERE, [f"{shortened(text)} has an empty value between its commas"])
    values: list[Any] = []
    for piece in pieces:
        span = _span(piece, text)
        values += [parse_override(f"{keys[0]}={piece}")[1]] if span is None else span
    return Axis(keys, tuple(values))


def parse_axes(texts: Sequence[str]) -> list[Axis]:
    """`parse_axis` of each. Raises SceneError with all faults."""
    found, faults = [], []
    for text in texts:
        try:
            found.append(parse_axis(text))
        except SceneError as error:
            faults += error.faults
    if faults:
        raise SceneError(WHERE, faults)
    return found


def _span(piece: str, text: str) -> range | None:
    """The whole numbers of 1..8, both ends included; None of another text. Raises SceneError."""
    if not (ends := re.fullmatch(r"(-?\d+(?:\.\d+)?)\s*\.\.\s*(-?\d+(?:\.\d+)?)", piece)):
        return None
    if any(whole_number(end.removeprefix("-")) is None for end in ends.groups()):
        raise SceneError(WHERE, [f"{shortened(text)}: {piece} is no range of whole numbers; list the values: 0.1,0.2"])
    first, last = int(ends[1]), int(ends[2])
    if last < first:
        raise SceneError(WHERE, [f"{shortened(text)}: the range {piece} is empty; begin with the smaller number"])
    if last - first >= MOST_POINTS:
        raise SceneError(WHERE, [f"{shortened(text)}: the range {piece} has more than {MOST_POINTS} values"])
    return range(first, last + 1)


def _divided(told: str, text: str) -> list[str]:
    """The parts between the commas that are in no brackets and no quotes. Raises SceneError."""
    parts, depth, quote, begin = [], [], "", 0
    closing = {"[": "]", "{": "}"}
    for k, letter in enumerate(told):
        if quote:
            quote = "" if letter == quote and (letter == "'" or told[k - 1] != "\\") else quote
        elif letter in "\"'":
            quote = letter
        elif letter in closing:
            depth.append(closing[letter])
        elif letter in "]}":
            if not depth or depth.pop() != letter:
                raise SceneError(WHERE, [f"{shortened(text)}: {letter} closes nothing"])
        elif letter == "," and not depth:
            parts.append(told[begin:k])
            begin = k + 1
    if depth or quote:
        raise SceneError(WHERE, [f"{shortened(text)}: {depth[-1] if depth else quote} is missing"])
    return [part.strip() for part in [*parts, told[begin:]]]


def checked(axes: Sequence[Axis]) -> list[Axis]:
    """The axes, if they make a sweep. Raises SceneError with every fault."""
    faults = []
    for key, times in Counter(key for axis in axes for key in axis.keys).items():
        if times > 1:
            faults.append(f"{key} is set {times} times; give its values in one list: {key}=A,B")
    for axis in axes:
        names = Counter(value_name(value) for value in axis.values)
        faults += [f"{axis.keys[0]}: {name} is there {times} times" for name, times in names.items() if times > 1]
    swept = [axis for axis in axes if axis.swept]
    if not swept:
        faults.append(
            "no key has several values: give it a list or a range, such as --set stages.0.temperature_K=280,290 or "
            "--set seed=1..8"
        )
    count = 1
    for axis in swept:
        count *= len(axis.values)
    if count > MOST_POINTS:
        faults.append(f"these are {count} points; a sweep has {MOST_POINTS} at most")
    if faults:
        raise SceneError(WHERE, faults)
    return list(axes)


def axes_of(sets: Mapping[str, Any]) -> list[Axis]:
    """Axes from Python: key -> a list, tuple, array or range of values, or one value for all points. Keys that go
    together are one text with commas. A list that is one value is put into a list: {"box.lengths_A": [[30, 30, 30]]}.
    """
    found = []
    for name, told in sets.items():
        keys = tuple(key.strip() for key in name.split(","))
        told = plain_values(told)
        swept = isinstance(told, Iterable) and not isinstance(told, str | bytes | Mapping)
        found.append(Axis(keys, tuple(map(plain_values, told if swept else (told,))), swept))
    return found


def settings(axes: Sequence[Axis]) -> list[dict[str, Any]]:
    """The values of the swept keys at each point, the last axis fastest; of keys that go together the first alone."""
    swept = [axis for axis in axes if axis.swept]
    return [
        dict(zip((axis.keys[0] for axis in swept), values, strict=True))
        for values in product(*(axis.values for axis in swept))
    ]
