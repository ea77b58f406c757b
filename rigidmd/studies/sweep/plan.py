"""The points of a sweep, from its axes: keys of a scene with lists of values, by `--set` or from
Python.

The scenes of all points are read and checked before the first one runs, then merged with the folder
of the sweep.
"""

import hashlib
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import chain, product
from math import inf, prod
from pathlib import Path
from typing import Any, NamedTuple

from rigidmd.assemble.scenes import resolve
from rigidmd.core.toml import parse_whole_number, plain_values, shorten_repr
from rigidmd.errors import InputError, OutputError, RigidMDError, SceneError, option
from rigidmd.io.folder import elsewhere
from rigidmd.run.resume import (
    NOT_COMPARED,
    differences,
    file_digest,
    input_digests,
    keys_of,
    plain,
    scene_digest,
)
from rigidmd.scene import BodyScene, MolecularScene, Scene, parse_override
from rigidmd.scene.validation import in_python, setting
from rigidmd.studies.sweep.folder import (
    SEED,
    Manifest,
    SweepPoint,
    clear_sweep,
    describe_values,
    is_sweep,
    point_name,
    read_manifest,
    short_keys,
    state_on_disk,
    value_name,
)

MOST_POINTS = 100_000  # largest number of points of a sweep
OPTION = "--set"
MOST_SHOWN = 8  # largest number of differences in a message


class Axis(NamedTuple):
    """Keys that are set together, to one value after another. An axis that is not `swept` has one
    value."""

    keys: tuple[str, ...]
    values: tuple[Any, ...]
    swept: bool = True


def parse_axis(text: str) -> Axis:
    """KEY=A,B,... of the command line; KEY=1..8 for whole numbers; KEY,KEY=A,B for keys that vary
    together. `parse_override` reads the values. Commas in brackets or quotes do not separate
    values. Raises SceneError."""
    name, equals, listed = text.partition("=")
    keys = tuple(key.strip() for key in name.split(","))
    if not equals or not all(keys):
        raise SceneError(
            OPTION, [f"{text!r} is not KEY=VALUE, for example stages.0.temperature_K=280,290,300"]
        )
    pieces = _split_at_commas(listed, text)
    spans = [_parse_range(piece, text) for piece in pieces]
    if spans == [None]:
        return Axis(keys, (parse_override(f"{keys[0]}={listed}")[1],), swept=False)
    if not all(pieces):
        raise SceneError(OPTION, [f"{shorten_repr(text)} has an empty value between its commas"])
    found = (
        span or [parse_override(f"{keys[0]}={piece}")[1]]
        for piece, span in zip(pieces, spans, strict=True)
    )
    return Axis(keys, tuple(chain.from_iterable(found)))


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
        error = (
            f"{shorten_repr(text)}: {piece} is not a range of whole numbers; list the values:"
            " 0.1,0.2"
        )
        raise SceneError(OPTION, [error])
    first, last = int(ends[1]), int(ends[2])
    if last < first:
        raise SceneError(
            OPTION,
            [f"{shorten_repr(text)}: the range {piece} is empty; begin with the smaller number"],
        )
    if last - first >= MOST_POINTS:
        raise SceneError(
            OPTION, [f"{shorten_repr(text)}: the range {piece} has more than {MOST_POINTS} values"]
        )
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
        raise SceneError(
            OPTION, [f"{shorten_repr(text)}: {depth[-1] if depth else quote} is missing"]
        )
    return [part.strip() for part in [*parts, listed[begin:]]]


def _check_axes(axes: Sequence[Axis]) -> None:
    """Raise SceneError with all errors of axes that make no sweep."""
    errors = []
    for key, times in Counter(key for axis in axes for key in axis.keys).items():
        if times > 1:
            errors.append(f"{key} is set {times} times; give its values in one list: {key}=A,B")
    for axis in axes:
        names = Counter(value_name(value) for value in axis.values)
        errors += [
            f"{axis.keys[0]}: {name} is listed {times} times"
            for name, times in names.items()
            if times > 1
        ]
    swept = [axis for axis in axes if axis.swept]
    if not swept:
        lists = "280,290", "1..8"
        if in_python():
            lists = "[280, 290]", "range(1, 9)"
        keys = "stages.0.temperature_K", SEED
        example = " or ".join(
            setting(*pair, argument="sets") for pair in zip(keys, lists, strict=True)
        )
        errors.append(f"no key has several values: give it a list or a range, such as {example}")
    count = prod(len(axis.values) for axis in swept)
    if count > MOST_POINTS:
        errors.append(f"these are {count} points; a sweep has {MOST_POINTS} at most")
    if errors:
        raise SceneError(option("sets"), errors)


def axes_of(sets: Mapping[str, Any]) -> list[Axis]:
    """Axes from Python: key -> a list, tuple, array or range of values, or one value for all
    points.

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


def with_seeds(scene: Path, axes: list[Axis], replicas: int, data: Mapping[str, Any]) -> list[Axis]:
    """The axes with an axis of the seeds of replicas."""
    if "body" in data:
        raise SceneError(
            option("replicas"), [f"{scene} is a single body, whose motion has no seed"]
        )
    with_seed = [axis for axis in axes if SEED in axis.keys]
    if any(axis.swept or len(axis.keys) > 1 for axis in with_seed):
        raise SceneError(
            option("replicas"),
            [f"sets seeds, and {option('sets')} sets them too; leave out one of them"],
        )
    seed = (
        with_seed[0].values[0]
        if with_seed
        else data.get(SEED, MolecularScene.model_fields[SEED].default)
    )
    if not isinstance(seed, int):
        raise SceneError(str(scene), [f"seed is {shorten_repr(seed)}, must be an integer"])
    return [
        *(axis for axis in axes if axis not in with_seed),
        Axis((SEED,), tuple(range(seed, seed + replicas))),
    ]


def settings(axes: Sequence[Axis]) -> list[dict[str, Any]]:
    """The values of the swept keys at each point, the last axis fastest; only the first of keys
    that vary together."""
    swept = {axis.keys[0]: axis.values for axis in axes if axis.swept}
    return [dict(zip(swept, values, strict=True)) for values in product(*swept.values())]


def read_points(path: str | Path, axes: Sequence[Axis]) -> tuple[Manifest, bool]:
    """The checked points of a sweep, and whether it is of a single body. Raises SceneError with all
    errors of all."""
    _check_axes(axes)
    keys = {axis.keys[0]: list(axis.keys) for axis in axes if axis.swept}
    fixed = {key: axis.values[0] for axis in axes if not axis.swept for key in axis.keys}
    short = short_keys(keys)
    every = settings(axes)
    digest = cache(file_digest)  # each file is read once
    errors: dict[str, list[str]] = {}  # message -> descriptions of the points that have it
    checked: dict[
        str, RigidMDError | None
    ] = {}  # values without the seed -> error; one replica is built
    manifest, scene = None, None
    for values in every:
        try:
            scene = Scene.read(
                path, fixed | {key: value for first, value in values.items() for key in keys[first]}
            )
            kind = json.dumps(
                {key: value for key, value in values.items() if key != SEED}, default=str
            )
            if kind not in checked:
                checked[kind] = None
                try:
                    resolve(scene)  # pyright: ignore[reportArgumentType]  (either kind)
                except RigidMDError as error:
                    checked[kind] = error
            if (build_error := checked[kind]) is not None:
                raise build_error
        except RigidMDError as error:
            where = (
                f"{error.where}: "
                if isinstance(error, InputError) and error.where != str(path)
                else ""
            )
            for message in error.errors if isinstance(error, InputError) else [str(error)]:
                errors.setdefault(f"{where}{message}", []).append(describe_values(values, short))
            continue
        if manifest is None:
            varied = [key for together in keys.values() for key in together]
            common = keys_of(
                plain(scene), (*NOT_COMPARED, *varied, *scene.inputs, *scene.embedded_files)
            )
            # JSON has no infinity
            common = {
                key: str(value) if value in (inf, -inf) else value for key, value in common.items()
            }
            inputs = {
                key: sha for key, sha in input_digests(scene, digest).items() if key not in varied
            }
            manifest = Manifest(scene.name, str(Path(path).absolute()), keys, fixed, common, inputs)
        manifest.points.append(
            SweepPoint(point_name(values, short), values, digest_of(scene, digest))
        )
    if errors or manifest is None:
        described = []
        for error, points in errors.items():
            more = f" and {len(points) - 1} more points" if len(points) > 1 else ""
            described.append(
                error if 1 < len(points) == len(every) else f"at {points[0]}{more}: {error}"
            )
        raise SceneError(str(path), described)
    return manifest, isinstance(scene, BodyScene)


def digest_of(scene: Scene, file_digest: Callable[[Path], str] = file_digest) -> str:
    """SHA-256 of a scene, as it was read, and of all files that it reads; see `input_digests`."""
    text = json.dumps([scene_digest(scene), input_digests(scene, file_digest)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def order_axes(folder: Path, axes: list[Axis]) -> list[Axis]:
    """The axes in the order of the sweep in a folder; a single value of a key that it varies is one
    more value."""
    if not is_sweep(folder):
        return axes
    keys = read_manifest(folder).keys
    known = [
        axis._replace(swept=axis.swept or keys.get(axis.keys[0]) == list(axis.keys))
        for axis in axes
    ]
    order = list(keys)
    return sorted(
        known, key=lambda axis: order.index(axis.keys[0]) if axis.keys[0] in order else len(order)
    )


def merge_manifests(folder: Path, fresh: Manifest, force: bool) -> Manifest:
    """The manifest of a folder with the points of `fresh`, which changes. States are read from the
    folders. An existing
    sweep keeps its points. force : remove an existing sweep. Raises OutputError, also if its scene
        differs."""
    if not is_sweep(folder):
        return fresh
    if force:
        names = [point.folder for point in fresh.points]
        with suppress(OutputError):  # a manifest that cannot be read names no folders
            there = read_manifest(folder)
            short = short_keys(there.keys)
            names += [point.folder for point in there.points]
            names += [
                point_name(values, short) for values, _ in there.combinations() if values
            ]  # of means
        clear_sweep(folder, names)
        return fresh
    there = read_manifest(folder)
    if found := _differences_between(there, fresh):
        shown = found[:MOST_SHOWN] + (
            [f"and {len(found) - MOST_SHOWN} more"] if len(found) > MOST_SHOWN else []
        )
        raise OutputError(
            f"{folder} holds a sweep of another scene: {'; '.join(shown)}. {option('force')} begins"
            f" it anew, {elsewhere()}"
        )
    known = {point.folder for point in there.points}
    fresh.points = [*there.points, *(point for point in fresh.points if point.folder not in known)]
    for point in fresh.points:
        update_state(folder, point)
    return fresh


def update_state(folder: Path, point: SweepPoint) -> None:
    """Read the state of a point from its folder; a failed point keeps its state until it runs
    again."""
    found = state_on_disk(folder, point)
    if found == "finished" or point.state != "failed":
        point.state = found


def _differences_between(there: Manifest, now: Manifest) -> list[str]:
    """Differences that make another sweep: the keys that vary, values of other keys, files."""
    if there.keys != now.keys:
        before, after = (
            " and ".join(map(", ".join, keys.values())) for keys in (there.keys, now.keys)
        )
        return [f"it varies {before}, not {after}"]
    found = []
    for key, values in differences(there.common, now.common).items():
        before, after = (value if value == "left out" else shorten_repr(value) for value in values)
        found.append(f"{key} is {after}, there {before}")
    found += [f"the file of {key} has changed" for key in differences(there.inputs, now.inputs)]
    if found:
        return found
    known = {point.folder: point.scene_sha256 for point in there.points}
    changed = [
        p.folder for p in now.points if known.get(p.folder, p.scene_sha256) != p.scene_sha256
    ]
    return [f"a file that {folder} reads has changed" for folder in changed]
