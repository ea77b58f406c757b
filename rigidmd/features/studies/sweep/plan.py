"""The points of a sweep, from its axes: keys of a scene with lists of values, by `--set` or from
Python.

The scenes of all points are read and checked before the first one runs, then merged with the folder
of the sweep.
"""

import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import product
from math import inf, prod
from pathlib import Path
from typing import NamedTuple

from rigidmd.core.toml import (
    Json,
    TOMLDecodeError,
    parse_toml,
    parse_whole_number,
    plain_values,
    shorten_repr,
)
from rigidmd.errors import InputError, OutputError, RigidMDError, SceneError, option
from rigidmd.features import provider
from rigidmd.features.studies.sweep.folder import (
    SEED,
    Manifest,
    SweepPoint,
    clear_sweep,
    describe_values,
    is_sweep,
    point_name,
    read_manifest,
    short_keys,
    value_name,
    without_seed,
)
from rigidmd.io.folder import elsewhere
from rigidmd.run.kind import with_defaults
from rigidmd.run.resume import (
    NOT_COMPARED,
    describe_differences,
    differences,
    file_digest,
    input_digests,
    keys_of,
    plain,
    scene_digest,
)
from rigidmd.scene import MolecularScene, Scene, parse_override
from rigidmd.scene.kinds import class_for
from rigidmd.scene.validation import in_python, setting

MOST_POINTS = 100_000  # largest number of points of a sweep
MOST_SHOWN = 8  # largest number of differences in a message
EMPTY = " has an empty value between its commas"


class Axis(NamedTuple):
    """Keys that are set together, to one value after another. An axis that is not `swept` has one
    value."""

    keys: tuple[str, ...]
    values: tuple[object, ...]
    swept: bool = True


def _error(text: str, problem: str) -> SceneError:
    return SceneError("--set", [f"{shorten_repr(text)}{problem}"])


def parse_axis(text: str) -> Axis:
    """KEY=A,B,... of the command line. KEY=1..8 for whole numbers. KEY,KEY=A,B for keys that vary
    together. `parse_override` reads the values. Commas in brackets or quotes do not separate
    values. Raises SceneError."""
    name, equals, listed = text.partition("=")
    keys = tuple(key.strip() for key in name.split(","))
    if not equals or not all(keys):
        raise _error(text, " is not KEY=VALUE, for example stages.0.temperature_K=280,290,300")
    if listed.rstrip().endswith(","):
        raise _error(text, EMPTY)
    try:
        values = parse_toml(f"values = [{listed}]")["values"] or [None]
    except TOMLDecodeError:
        values = _words_and_ranges(listed, text)
    is_single = len(values) == 1 and _parse_range(listed.strip(), text) is None
    return Axis(keys, tuple(values), swept=not is_single)


def _words_and_ranges(listed: str, text: str) -> list[object]:
    """The values of a list that is not TOML. Raises SceneError."""
    if re.search(r"[\[\]{}\"']", listed):
        advice = "put texts that contain them into quotation marks"
        raise _error(text, f": brackets or quotation marks do not match; {advice}")
    values: list[object] = []
    for piece in map(str.strip, listed.split(",")):
        if not piece:
            raise _error(text, EMPTY)
        values += _parse_range(piece, text) or [parse_override(f"value={piece}")[1]]
    return values


def parse_axes(texts: Sequence[str]) -> list[Axis]:
    """`parse_axis` of each. Raises SceneError with all errors."""
    axes, errors = [], []
    for text in texts:
        try:
            axes.append(parse_axis(text))
        except SceneError as error:
            errors += error.errors
    if errors:
        raise SceneError("--set", errors)
    return axes


def _parse_range(piece: str, text: str) -> range | None:
    """The whole numbers of 1..8, both ends included. None for another text. Raises SceneError."""
    ends = re.fullmatch(r"(-?\d+(?:\.\d+)?)\s*\.\.\s*(-?\d+(?:\.\d+)?)", piece)
    if ends is None:
        return None
    if any(parse_whole_number(end.removeprefix("-")) is None for end in ends.groups()):
        raise _error(text, f": {piece} is not a range of whole numbers. List the values: 0.1,0.2")
    first, last = map(int, ends.groups())
    if last < first:
        raise _error(text, f": the range {piece} is empty. Begin with the smaller number")
    if last - first >= MOST_POINTS:
        raise _error(text, f": the range {piece} has more than {MOST_POINTS} values")
    return range(first, last + 1)


def axes_of(sets: Mapping[str, object]) -> list[Axis]:
    """Axes from Python: key -> a list, tuple, array or range of values, or one value for all
    points.

    Keys that vary together are one text with commas. A list that is one value is put into a list:
    {"box.lengths_A": [[30, 30, 30]]}.
    """
    axes = []
    for name, values in sets.items():
        keys = tuple(key.strip() for key in name.split(","))
        values = plain_values(values)
        swept = isinstance(values, Iterable) and not isinstance(values, str | bytes | Mapping)
        listed = values if swept else [values]
        axes.append(Axis(keys, tuple(map(plain_values, listed)), swept))
    return axes


def with_seeds(
    scene: Path, axes: list[Axis], replicas: int, data: Mapping[str, object]
) -> list[Axis]:
    """The axes with an axis of the seeds of replicas."""
    kind = class_for(data)
    if kind is not None and SEED not in kind.model_fields:
        raise SceneError(
            option("replicas"), [f"{scene} is {kind.subject}, whose motion has no seed"]
        )
    seed = data.get(SEED, MolecularScene.model_fields[SEED].default)
    others = [axis for axis in axes if SEED not in axis.keys]
    for axis in axes:
        if axis.keys == (SEED,) and not axis.swept:
            seed = axis.values[0]
        elif SEED in axis.keys:
            problem = f"sets seeds, and {option('sets')} sets them too. Leave out one of them"
            raise SceneError(option("replicas"), [problem])
    if not isinstance(seed, int):
        raise SceneError(str(scene), [f"seed is {shorten_repr(seed)}, must be an integer"])
    return [*others, Axis((SEED,), tuple(range(seed, seed + replicas)))]


def settings(axes: Sequence[Axis]) -> list[Json]:
    """The values of the swept keys at each point, the last axis fastest. Only the first of keys
    that vary together."""
    swept = {axis.keys[0]: axis.values for axis in axes if axis.swept}
    return [dict(zip(swept, values, strict=True)) for values in product(*swept.values())]


def _check_axes(axes: Sequence[Axis]) -> None:
    """Raise SceneError with all errors of axes that make no sweep."""
    keys = Counter(key for axis in axes for key in axis.keys)
    errors = [
        f"{key} is set {times} times. Give its values in one list: {key}=A,B"
        for key, times in keys.items()
        if times > 1
    ]
    for axis in axes:
        names = Counter(map(value_name, axis.values))
        repeated = [name for name in names if names[name] > 1]
        errors += [f"{axis.keys[0]}: {name} is listed {names[name]} times" for name in repeated]
    swept = [axis for axis in axes if axis.swept]
    if not swept:
        lists = ("[280, 290]", "range(1, 9)") if in_python() else ("280,290", "1..8")
        temperatures = setting("stages.0.temperature_K", lists[0], argument="sets")
        example = f"{temperatures} or {setting(SEED, lists[1], argument='sets')}"
        errors.append(f"no key has several values: give it a list or a range, such as {example}")
    count = prod(len(axis.values) for axis in swept)
    if count > MOST_POINTS:
        errors.append(f"these are {count} points. A sweep has {MOST_POINTS} at most")
    if errors:
        raise SceneError(option("sets"), errors)


def read_points(
    path: Path,
    axes: Sequence[Axis],
    trusted: Sequence[str] = (),
    includes: Callable[[Json], bool] = lambda values: True,
) -> Manifest:
    """The checked points of a sweep. Raises SceneError with all errors of all points.

    includes : whether the point with these values is one of the sweep
    """
    _check_axes(axes)
    keys = {axis.keys[0]: list(axis.keys) for axis in axes if axis.swept}
    fixed = {key: axis.values[0] for axis in axes if not axis.swept for key in axis.keys}
    manifest = Manifest("", str(path.absolute()), keys, fixed, {}, {})
    short, all_values = short_keys(keys), [*filter(includes, settings(axes))]
    digest = cache(file_digest)  # each file is read once
    points_of: dict[str, list[str]] = defaultdict(list)  # error -> descriptions of its points
    build_errors: dict[str, RigidMDError | None] = {}  # values without the seed -> error
    scene = None
    unused = list(trusted)
    for values in all_values:
        try:
            scene = Scene.read(path, manifest.overrides(values))
            if unused:
                unused = provider("unused_files", "--trust").unused_files(scene, unused)
            if not manifest.points:
                _describe_scene(manifest, scene, digest)
            sha256 = digest_of(scene, digest)
            manifest.points.append(SweepPoint(point_name(values, short), values, sha256))
            kind = json.dumps(without_seed(values), default=str)
            if kind not in build_errors:
                build_errors[kind] = _build_error(scene)
            if error := build_errors[kind]:
                raise error
        except RigidMDError as error:
            for message in _messages(error, path):
                points_of[message].append(describe_values(values, short))
    errors = []
    for message, points in points_of.items():
        more = f" and {len(points) - 1} more points" if len(points) > 1 else ""
        is_everywhere = 1 < len(points) == len(all_values)
        errors.append(message if is_everywhere else f"at {points[0]}{more}: {message}")
    if errors or scene is None:
        raise SceneError(str(path), errors)
    if unused:
        provider("check_trusted", "--trust").check_trusted(scene, unused)
    return manifest


def _build_error(scene: Scene) -> RigidMDError | None:
    try:
        with_defaults(scene)  # pyright: ignore[reportArgumentType]  (either kind)
    except RigidMDError as error:
        return error
    return None


def _messages(error: RigidMDError, path: Path) -> list[str]:
    if not isinstance(error, InputError):
        return [str(error)]
    where = "" if error.where == str(path) else f"{error.where}: "
    return [f"{where}{message}" for message in error.errors]


def _describe_scene(manifest: Manifest, scene: Scene, digest: Callable[[Path], str]) -> None:
    """Note in a manifest what all points have in common with this scene of one of them."""
    varied = [key for together in manifest.keys.values() for key in together]
    excluded = (*NOT_COMPARED, *varied, *scene.inputs, *scene.embedded_files)
    data = plain(scene)
    for key, value in keys_of(data, excluded).items():
        manifest.common[key] = str(value) if value in (inf, -inf) else value  # JSON has no infinity
    inputs = input_digests(scene, digest)
    manifest.inputs = {key: inputs[key] for key in inputs.keys() - set(varied)}
    manifest.name = scene.name
    manifest.has_checkpoints = data["output"].get("checkpoint_minutes") is not False


def digest_of(scene: Scene, file_digest: Callable[[Path], str] = file_digest) -> str:
    """SHA-256 of a scene, as it was read, and of all files that it reads; see `input_digests`."""
    text = json.dumps([scene_digest(scene), input_digests(scene, file_digest)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def order_axes(folder: Path, axes: list[Axis]) -> list[Axis]:
    """The axes in the order of the sweep in a folder. A single value of a key that it varies is one
    more value."""
    if not is_sweep(folder):
        return axes
    keys = read_manifest(folder).keys
    order = [*keys, *(axis.keys[0] for axis in axes)]
    axes = sorted(axes, key=lambda axis: order.index(axis.keys[0]))
    return [axis._replace(swept=axis.swept or [*axis.keys] in keys.values()) for axis in axes]


def merge_manifests(folder: Path, fresh: Manifest, *, force: bool) -> None:
    """Give a manifest the folder of the sweep, and the points that the sweep there already has.

    force : remove an existing sweep. Raises OutputError, also if its scene differs.
    """
    fresh.folder = folder
    if force and is_sweep(folder):
        names = {point.folder for point in fresh.points}
        with suppress(OutputError):  # a manifest that cannot be read names no folders
            earlier = read_manifest(folder)
            short = short_keys(earlier.keys)
            names |= {point.folder for point in earlier.points}
            names |= {point_name(values, short) for values, _ in earlier.combinations()}
        clear_sweep(folder, names - {""})
    elif is_sweep(folder):
        earlier = read_manifest(folder)
        if problems := _differences_between(earlier, fresh):
            raise OutputError(
                f"{folder} holds a sweep of another scene: {'; '.join(problems[:MOST_SHOWN])}."
                f" {option('force')} starts it again, {elsewhere()}"
            )
        names = {point.folder for point in earlier.points}
        new = [point for point in fresh.points if point.folder not in names]
        fresh.points = earlier.points + new
    fresh.update_states()


def _differences_between(earlier: Manifest, now: Manifest) -> list[str]:
    """Differences that make another sweep: the keys that vary, values of other keys, files."""
    if earlier.keys != now.keys:
        before = " and ".join(map(", ".join, earlier.keys.values()))
        after = " and ".join(map(", ".join, now.keys.values()))
        return [f"it varies {before}, not {after}"]
    values = differences(now.common, earlier.common)
    digests = {point.folder: point.scene_sha256 for point in earlier.points}
    return describe_differences(values, differences(now.inputs, earlier.inputs)) or [
        f"a file that {point.folder} reads has changed"
        for point in now.points
        if digests.get(point.folder, point.scene_sha256) != point.scene_sha256
    ]
