"""Whether a checkpoint is one of this scene, and the state that it holds."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.core.state import NOW, State
from rigidmd.errors import CheckpointError
from rigidmd.run.provenance import APART, computed_with, differences, input_digests, keys_of, plain
from rigidmd.scene import MolecularScene, Scene


def check_same_scene(scene: Scene, before: Mapping[str, Any], inputs: Mapping[str, str], steps: int) -> None:
    """Raise CheckpointError unless a resolved scene goes on with a run of `before` after so many steps.

    The last stage of molecules may be longer or shorter than it was, but not shorter than it has been.
    """
    apart = [*scene.inputs, *scene.held, *APART]
    if isinstance(scene, MolecularScene) and not scene.stages[-1].ramps:
        apart.append(f"stages.{len(scene.stages) - 1}.duration_ps")
        if sum(stage.steps for stage in scene.stages) < steps:
            raise CheckpointError(f"{scene.source}: the run in the folder is longer already, {steps} steps")
    unlike = differences(keys_of(plain(scene), apart), keys_of(before, apart))
    faults = [f"{key} is {now}, there {then}" for key, (now, then) in unlike.items()]
    found = input_digests(scene)
    faults += [f"the file of {key} has changed" for key in found if found[key] != inputs.get(key)]
    if faults:
        raise CheckpointError(
            f"{scene.source}: is not the scene of the run in the folder: {'; '.join(faults[:8])}. "
            "--force begins a new run, -o names another folder"
        )


def changed_since(told: Mapping[str, Any]) -> str | None:
    """A sentence if the run so far was computed with other versions or on another processor, which may change bits."""
    now = computed_with()
    changed = [
        f"{key.replace('_', ' ').removesuffix(' version')} {then} there, {here} here"
        for key, (then, here) in differences(told, now, None).items()
        if key not in ("python_version", "processor_features")
    ]
    if not changed:
        return None
    return (
        f"the run so far was computed with {'; '.join(changed)}: from here on bits may differ from a run without a stop"
    )


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
