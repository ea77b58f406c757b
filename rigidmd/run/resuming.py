"""Whether a checkpoint is one of this scene, and the state that it holds."""

import contextlib
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.core.state import NOW, State
from rigidmd.errors import CheckpointError
from rigidmd.scene import MolecularScene, Scene

#: Keys that change no bit of a run, or are compared otherwise: input files by their contents.
APART = ("name", "threads", "output.checkpoint_minutes", "output.figure", "output.figures", "watch")


def digests(scene: Scene) -> dict[str, str]:
    """SHA-256 of each input file of a scene, by its dotted key."""
    return {key: hashlib.sha256(path.read_bytes()).hexdigest() for key, path in scene.inputs.items()}


def check_same_scene(scene: Scene, before: Mapping[str, Any], inputs: Mapping[str, str], steps: int) -> None:
    """Raise CheckpointError unless a resolved scene goes on with a run of `before` after so many steps.

    The last stage of molecules may be longer or shorter than it was, but not shorter than it has been.
    """
    now = _flat(scene.model_dump(mode="json", exclude_none=True))
    then = _flat(before)
    apart = {*scene.inputs, *APART}
    if isinstance(scene, MolecularScene) and not scene.stages[-1].ramps:
        apart.add(f"stages.{len(scene.stages) - 1}.duration_ps")
        if sum(stage.steps for stage in scene.stages) < steps:
            raise CheckpointError(f"{scene.source}: the run in the folder is longer already, {steps} steps")
    keys = [key for key in (now | then) if not any(f"{key}.".startswith(f"{other}.") for other in apart)]
    faults = [
        f"{key} is {now.get(key, 'left out')}, there {then.get(key, 'left out')}"
        for key in keys
        if now.get(key) != then.get(key)
    ]
    found = digests(scene)
    faults += [f"the file of {key} has changed" for key in found if found[key] != inputs.get(key)]
    if faults:
        raise CheckpointError(
            f"{scene.source}: is not the scene of the run in the folder: {'; '.join(faults[:8])}. "
            "--force begins a new run, -o names another folder"
        )


def _flat(data: Any, name: str = "") -> dict[str, Any]:
    """Dotted key -> value of nested tables, without those that are None."""
    if isinstance(data, Mapping):
        pairs = [(f"{name}.{key}" if name else str(key), value) for key, value in data.items()]
    elif isinstance(data, list) and any(isinstance(value, Mapping) for value in data):
        pairs = [(f"{name}.{k}", value) for k, value in enumerate(data)]
    else:
        return {} if data is None else {name: data}
    return {key: value for part, inner in pairs for key, value in _flat(inner, part).items()}


def state_from(arrays: Mapping[str, np.ndarray], like: State) -> State:
    """The state in a checkpoint, of a run that began from a state like this one. Raises ValueError, KeyError."""
    found = State(*(np.array(arrays[name]) for name in State._fields))
    for name, array, own in zip(State._fields, found, like, strict=True):
        if array.dtype != own.dtype or (name != "bath" and array.shape != own.shape):
            raise ValueError(f"{name} has the shape {array.shape}, not {own.shape}")
    if not found.is_finite or found.step[NOW] < 0:
        raise ValueError("the state is not finite")
    return found


@contextlib.contextmanager
def fitting(folder: Path | None) -> Iterator[None]:
    """Turns whatever does not fit in a checkpoint into a CheckpointError."""
    try:
        yield
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise CheckpointError(
            f"the checkpoint in {folder} does not fit this run: {error}. --force begins a new run"
        ) from None
