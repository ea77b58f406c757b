"""What a checkpoint has of a run: its record, the memories of observers. Checks that both belong to
the scene."""

import contextlib
import hashlib
import json
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from rigidmd.compile.machine import CODE_SETTINGS, PROCESSOR, PROCESSOR_FEATURES, SIMD_BITS
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import State
from rigidmd.core.state_file import array_errors
from rigidmd.core.toml import Json, shorten_text
from rigidmd.errors import CheckpointError, SceneError, option
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.io.folder import elsewhere
from rigidmd.scene import Scene, is_molecular
from rigidmd.scene.validation import FORMER_KEYS

#: Packages that may change the last bits of a result.
PACKAGES = ("rigidmd", "numba", "llvmlite", "numpy", "scipy", "rocket_fft")
#: Keys of a summary on programs and machine.
MADE_WITH = (
    *(f"{package}_version" for package in PACKAGES),
    "python_version",
    "machine",
    "processor",
    "vector_bits",
    "numba_settings",
    "threads",
)
#: Keys that change no bit of a run, or, as input files, are compared by contents.
NOT_COMPARED = (
    "name",
    "threads",
    "output.checkpoint_minutes",
    "output.figures",
    "output.drawn_as",
    "watch",
)


@cache
def _versions() -> dict[str, str]:
    return {f"{package}_version": version(package) for package in PACKAGES}


def computed_with() -> Json:
    """Everything in addition to the scene that may change the bits of a result, as JSON values."""
    settings = " ".join(
        f"{name}={os.environ[name]}" for name in CODE_SETTINGS if name in os.environ
    )
    return {
        **_versions(),
        "python_version": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "processor": PROCESSOR,
        "processor_features": list(PROCESSOR_FEATURES),
        "vector_bits": SIMD_BITS,
        **({"numba_settings": settings} if settings else {}),
    }


def provenance(scene: Scene, threads: int, inputs: Mapping[str, str], engine: str) -> Json:
    """The first part of summary.json: `computed_with`, and the input.

    inputs : `input_digests` at the start; engine : the program that computed the motion
    """
    molecular = is_molecular(scene)
    return {
        "scene": scene.name,
        **computed_with(),
        "engine": engine,
        "threads": threads,
        "seed": scene.seed if molecular else None,
        "precision": scene.precision if molecular else "double",
        "scene_sha256": scene_digest(scene),
        "input_sha256": dict(inputs),
    }


def scene_digest(scene: Scene) -> str:
    """SHA-256 of all keys in a resolved scene that may change the bits of its run."""
    keys = keys_of(plain(scene), (*scene.inputs, *scene.embedded_files, *NOT_COMPARED))
    return hashlib.sha256(json.dumps(keys, sort_keys=True).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of the content of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def input_digests(scene: Scene, file_digest: Callable[[Path], str] = file_digest) -> dict[str, str]:
    """SHA-256 of each input of a scene, a file or its contents, by its dotted key. Raises
    SceneError."""
    try:
        read = {key: file_digest(path) for key, path in scene.inputs.items()}
    except OSError as error:
        raise SceneError(
            scene.source, [f"{error.filename} cannot be read: {error.strerror}"]
        ) from None
    return read | {
        key: hashlib.sha256(content).hexdigest() for key, content in scene.embedded_files.items()
    }


def plain(scene: BaseModel) -> Json:
    """A scene, or a part of one, as JSON values."""
    return scene.model_dump(mode="json", exclude_none=True)


def keys_of(scene: Mapping[str, object], excluded: Iterable[str]) -> Json:
    """Dotted key -> value of a `plain` scene, without the keys and tables in `excluded`."""
    left_out = tuple(f"{key}." for key in excluded)
    return {key: value for key, value in _flat(scene).items() if not f"{key}.".startswith(left_out)}


def differences(
    first: Mapping[str, object], second: Mapping[str, object], left_out: object = "left out"
) -> dict[str, tuple[object, object]]:
    """Key -> both values, where two dictionaries differ."""
    pairs = {
        key: (first.get(key, left_out), second.get(key, left_out)) for key in {**first, **second}
    }
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


def describe_differences(
    values: Mapping[str, tuple[object, object]], files: Iterable[str]
) -> list[str]:
    """Phrases: keys with their values now and before, and keys of files that have changed."""
    changes = []
    for key, (now, before) in values.items():
        changes.append(f"{key} is {shorten_text(str(now))}, there {shorten_text(str(before))}")
    return changes + [f"the file of {key} has changed" for key in files]


def _flat(data: object, name: str = "") -> Json:
    """Dotted key -> value of nested tables, without None."""
    if isinstance(data, list) and any(isinstance(value, Mapping) for value in data):
        data = dict(enumerate(data))
    if not isinstance(data, Mapping):
        return {} if data is None else {name: data}
    start = f"{name}." if name else ""
    return {
        key: value
        for part, inner in data.items()
        for key, value in _flat(inner, f"{start}{FORMER_KEYS.get(str(part), part)}").items()
    }


Count = Annotated[int, Field(ge=0)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
#: Arrays by name, as the value of one field.
Arrays = dict[str, np.ndarray]


def check_same_scene(
    scene: Scene, before: Mapping[str, object], inputs: Mapping[str, str], steps: int
) -> None:
    """Raise CheckpointError unless a resolved scene can continue a run of the scene `before` after
    some steps. The last stage of molecules may be longer or shorter than before, but not shorter
    than it has run."""
    excluded = [*scene.inputs, *scene.embedded_files, *NOT_COMPARED]
    if is_molecular(scene) and not scene.stages[-1].ramps:
        excluded.append(f"stages.{len(scene.stages) - 1}.duration_ps")
        if sum(stage.steps for stage in scene.stages) < steps:
            raise CheckpointError(
                f"{scene.source}: the run in the folder is already longer, {steps} steps"
            )
    unlike = differences(keys_of(plain(scene), excluded), keys_of(before, excluded))
    digests = input_digests(scene)
    changed = [key for key in digests if digests[key] != inputs.get(key)]
    if changes := describe_differences(unlike, changed):
        raise CheckpointError(
            f"{scene.source}: is not the scene of the run in the folder: {'; '.join(changes[:8])}. "
            f"{option('force')} begins a new run, {elsewhere()}"
        )


def describe_changes(before: Mapping[str, object]) -> str | None:
    """A sentence if the run so far was computed with other versions or on another processor. None
    otherwise."""
    changed = [
        f"{key.replace('_', ' ').removesuffix(' version')} {then} there, {here} here"
        for key, (then, here) in differences(before, computed_with(), None).items()
        if key not in ("python_version", "processor_features")
        and (key in before or not key.endswith("_version"))  # earlier versions named fewer packages
    ]
    if not changed:
        return None
    return (
        f"the run so far was computed with {'; '.join(changed)}: from here on bits may differ from"
        " a run without a stop"
    )


def state_from(arrays: Mapping[str, np.ndarray], like: State, *, exact: bool = True) -> State:
    """The state in a checkpoint of a run whose states have arrays like `like`. Raises ValueError,
    KeyError.

    exact : whether the method of the run keeps rotation matrices orthogonal to rounding
    """
    expected = like._asdict()
    state = State(*(np.array(arrays[name], array.dtype) for name, array in expected.items()))
    shapes = {name: array.shape for name, array in expected.items()}
    for name, problem in array_errors(
        dict(zip(State._fields, state, strict=True)), shapes, exact=exact
    ).items():
        raise ValueError(f"{name} of its state {problem}")
    if (np.isfinite(state.cell) != np.isfinite(like.cell)).any():
        raise ValueError("its state has another kind of box")
    return state


def stored(owner: object, types: Mapping[str, object]) -> Checkpoint:
    """Attributes of an object for a checkpoint, by their names and types: arrays as arrays, all
    others as JSON."""
    arrays, plain_types = {}, {}
    for name, kind in types.items():
        if kind is np.ndarray:
            arrays[name] = getattr(owner, name)
        elif kind == Arrays:
            arrays |= {f"{name}/{key}": array for key, array in getattr(owner, name).items()}
        else:
            plain_types[name] = kind
    values = {name: getattr(owner, name) for name in plain_types}
    model = _model_of(tuple(plain_types.items()))
    dumped = model.model_construct(**values).model_dump(mode="json", exclude_none=True)
    return Checkpoint({name: dumped.get(name) for name in plain_types}, arrays)


def restored(
    kept: Checkpoint, types: Mapping[str, object], rows: Mapping[str, Scheme] | None = None
) -> Json:
    """The attributes of `stored`, validated. rows : see `Scene.rows`. Raises ValueError or
    KeyError."""
    arrays: Json = {name: kept.arrays[name] for name, kind in types.items() if kind is np.ndarray}
    for name in (name for name, kind in types.items() if kind == Arrays):
        start = f"{name}/"
        arrays[name] = {
            key.removeprefix(start): kept.arrays[key]
            for key in kept.arrays
            if key.startswith(start)
        }
    try:
        model = _model_of(tuple((name, types[name]) for name in types if name not in arrays))
        values = model.model_validate(kept.values, context=rows)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    return {name: getattr(values, name) for name in types if name not in arrays} | arrays


@cache
def _model_of(types: tuple[tuple[str, object], ...]) -> type[BaseModel]:
    config = ConfigDict(
        extra="forbid", allow_inf_nan=False, ser_json_inf_nan="constants", protected_namespaces=()
    )
    fields = {name: (kind, ...) for name, kind in types}
    return create_model("Stored", __config__=config, **fields)  # pyright: ignore[reportCallIssue, reportArgumentType]


@dataclass
class RunPosition:
    """The position of a run in its segments."""

    segment: Count = 0
    first: Count = 0  # steps before the segment
    time: NotNegative = 0.0  # at the start of the segment, ps or s
    computing: list[NotNegative] = field(default_factory=list)  # seconds, of the segments before
    seconds: NotNegative = 0.0  # of computing in this segment


@dataclass
class RunRecord:
    """The input of a run and all that evolves in it, in addition to its state, its engine and its
    observers.

    Every field of this class and its subclasses is in the checkpoints: `stored` and `restored`
    follow the annotations.
    """

    scene: Json = field(default_factory=dict)  # as JSON values
    inputs: dict[str, str] = field(default_factory=dict)  # key -> SHA-256
    notes: list[str] = field(default_factory=list)  # warnings
    position: RunPosition = field(default_factory=RunPosition)

    @classmethod
    def types(cls) -> Json:
        """Field -> its type."""
        return get_type_hints(cls, include_extras=True)


@contextlib.contextmanager
def as_checkpoint_errors(folder: Path | None) -> Iterator[None]:
    """Convert errors of checks and of wrong data into a CheckpointError."""
    try:
        yield
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, ArithmeticError) as error:
        raise CheckpointError(
            f"the checkpoint in {folder} does not fit this run: {error}. {option('force')} begins a"
            " new run"
        ) from None
