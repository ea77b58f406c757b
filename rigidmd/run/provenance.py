"""Provenance of a run: versions, the processor, digests of the scene and of its input files."""

import hashlib
import json
import os
import platform
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from typing import Any

from pydantic import BaseModel

from rigidmd.compile.machine import CODE_SETTINGS, PROCESSOR, PROCESSOR_FEATURES, SIMD_BITS
from rigidmd.errors import SceneError
from rigidmd.scene import MolecularScene, Scene

#: Packages that may change the last bits of a result.
PACKAGES = ("rigidmd", "numba", "llvmlite", "numpy")
#: Keys that change no bit of a run, or, as input files, are compared by contents.
NOT_COMPARED = ("name", "threads", "output.checkpoint_minutes", "output.figures", "output.drawn_as", "watch")


def computed_with() -> dict[str, Any]:
    """Everything besides the scene that may change the bits of a result, as JSON values."""
    settings = " ".join(f"{name}={os.environ[name]}" for name in CODE_SETTINGS if name in os.environ)
    return {
        **{f"{package}_version": version(package) for package in PACKAGES}, "python_version": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}", "processor": PROCESSOR,
        "processor_features": list(PROCESSOR_FEATURES), "vector_bits": SIMD_BITS,
        **({"numba_settings": settings} if settings else {}),
    }  # fmt: skip


def provenance(scene: Scene, threads: int, inputs: Mapping[str, str], engine: str) -> dict[str, Any]:
    """The first part of summary.json: `computed_with`, and the input.

    inputs : `input_digests` at the start; engine : the program that computed the motion
    """
    molecular = isinstance(scene, MolecularScene)
    return {
        "scene": scene.name, **computed_with(), "engine": engine, "threads": threads,
        "seed": scene.seed if molecular else None, "precision": scene.precision if molecular else "double",
        "scene_sha256": scene_digest(scene), "input_sha256": dict(inputs),
    }  # fmt: skip


def scene_digest(scene: Scene) -> str:
    """SHA-256 of all keys of a resolved scene that may change the bits of its run."""
    keys = keys_of(plain(scene), (*scene.inputs, *scene.embedded_files, *NOT_COMPARED))
    return hashlib.sha256(json.dumps(keys, sort_keys=True).encode()).hexdigest()


def input_digests(scene: Scene) -> dict[str, str]:
    """SHA-256 of each input of a scene, a file or its contents, by its dotted key. Raises SceneError."""
    try:
        read = {key: hashlib.sha256(path.read_bytes()).hexdigest() for key, path in scene.inputs.items()}
    except OSError as error:
        raise SceneError(scene.source, [f"{error.filename} cannot be read: {error.strerror}"]) from None
    return read | {key: hashlib.sha256(content).hexdigest() for key, content in scene.embedded_files.items()}


def plain(scene: BaseModel) -> dict[str, Any]:
    """A scene, or a part of one, as JSON values."""
    return scene.model_dump(mode="json", exclude_none=True)


def keys_of(scene: Mapping[str, Any], excluded: Iterable[str]) -> dict[str, Any]:
    """Dotted key -> value of a `plain` scene, without the keys and tables in `excluded`."""
    left_out = tuple(f"{key}." for key in excluded)
    return {key: value for key, value in _flat(scene).items() if not f"{key}.".startswith(left_out)}


def differences(first: Mapping[str, Any], second: Mapping[str, Any], left_out: Any = "left out") -> dict[str, tuple]:
    """Key -> both values, where two dictionaries differ."""
    pairs = {key: (first.get(key, left_out), second.get(key, left_out)) for key in {**first, **second}}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


def _flat(data: Any, name: str = "") -> dict[str, Any]:
    """Dotted key -> value of nested tables, without None."""
    if isinstance(data, Mapping):
        pairs = [(f"{name}.{key}" if name else str(key), value) for key, value in data.items()]
    elif isinstance(data, list) and any(isinstance(value, Mapping) for value in data):
        pairs = [(f"{name}.{k}", value) for k, value in enumerate(data)]
    else:
        return {} if data is None else {name: data}
    return {key: value for part, inner in pairs for key, value in _flat(inner, part).items()}
