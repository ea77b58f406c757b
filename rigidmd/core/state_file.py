"""Reading and writing a state, to the bit, as `final.npz`."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.core.files import atomic_file, unreadable_reason
from rigidmd.core.process import format_gigabytes, memory_shortage
from rigidmd.core.state import NO_CELL, State, state_of
from rigidmd.errors import StructureError

#: Version of the format. Version 1 (rigidmd 0.1) had neither a version number nor the arrays from
#: `step` on.
SCHEMA = 3
#: Names of arrays in files of versions 1 and 2 -> their names now.
FORMER_NAMES = {"books": "energy_ledger", "bath": "extra_variables"}
LARGEST = 1e30  # largest magnitude of any number in a state
NOT_A_ROTATION = 1e-6  # largest |Q^T Q - 1| of a state that is read; runs end near 1e-13


class SavedState(NamedTuple):
    """The content of a file."""

    state: State
    names: list[str]  # of species
    species: np.ndarray  # (n,) index into the names
    residue_number: np.ndarray | None  # (n,); older files have none
    #: (names, 5) mass (u), moments of inertia (u Å²) and number of sites of each species
    models: np.ndarray | None = None


def write_state(path: Path, saved: SavedState) -> None:
    """Write a state of molecules, without pickle. Raises OutputError."""
    optional = {"residue_number": saved.residue_number, "models": saved.models}
    optional = {name: array for name, array in optional.items() if array is not None}
    with atomic_file(path) as temporary:
        np.savez(
            temporary,
            schema=SCHEMA,
            species_names=np.array(saved.names),
            species=saved.species,
            **optional,
            **saved.state._asdict(),
        )


def read_state(path: Path) -> SavedState:
    """Read a state, to the bit. Raises StructureError with all errors found in the file."""
    if reason := unreadable_reason(path):
        raise StructureError(str(path), [reason])
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if reason := memory_shortage(2 * size, f"reading its {format_gigabytes(size)}"):
            raise ValueError(f"not enough memory: {reason}")
        with np.load(path, allow_pickle=False) as data:
            names_in_file = map(str, data.files)
            arrays = {FORMER_NAMES.get(name, name): data[name] for name in names_in_file}
        schema = int(arrays.pop("schema", 1))
        names = [str(name) for name in arrays.pop("species_names")]
        species = arrays["species"]
    except Exception as error:  # errors from zipfile, numpy and pickle all mean the same
        raise StructureError(str(path), [f"is not a state that rigidmd wrote: {error}"]) from None
    if schema > SCHEMA:
        reason = (
            f"was written by a later rigidmd (version {schema} of the format; this one reads up to"
            f" {SCHEMA})"
        )
        raise StructureError(str(path), [reason])
    example = state_of()
    if schema == 1:
        arrays = {
            key: arrays[key]
            for key in ("species", "residue_number", *State._fields[:5])
            if key in arrays
        }
        arrays |= dict(zip(State._fields[5:], example[5:], strict=True))
    if missing := [key for key in State._fields if key not in arrays]:
        raise StructureError(
            str(path), [f"is not a state that rigidmd wrote: it holds no {', '.join(missing)}"]
        )
    if bad := _damaged(arrays, names):
        raise StructureError(
            str(path), [f"{', '.join(sorted(bad))}: damaged (wrong shape or values)"]
        )
    state = State(
        *(
            np.asarray(arrays[k], like.dtype, order="C")
            for k, like in zip(State._fields, example, strict=True)
        )
    )
    return SavedState(state, names, species, arrays.get("residue_number"), arrays.get("models"))


def _damaged(arrays: dict[str, np.ndarray], names: list[str]) -> set[str]:
    """Names of arrays with a shape or values that no state has."""
    n = len(arrays["species"]) if arrays["species"].ndim else 0
    m = n if len(np.atleast_1d(arrays["rotation"])) else 0
    shapes = {
        "species": (n,),
        "position": (n, 3),
        "velocity": (n, 3),
        "cell": (3, 3),
        "rotation": (m, 3, 3),
    }
    shapes |= {"angular_momentum_body": (m, 3), "time": (2,), "step": (2,), "energy_ledger": (3,)}
    shapes |= {"extra_variables": (arrays["extra_variables"].size,)}
    shapes |= {"residue_number": (n,)} if "residue_number" in arrays else {}
    shapes |= {"models": (len(names), 5)} if "models" in arrays else {}
    bad = {*array_errors(arrays, shapes)}
    bad |= {
        key
        for key in ("species", "residue_number")
        if key in arrays and arrays[key].dtype.kind != "i"
    }
    if (
        "species" not in bad
        and not ((arrays["species"] >= 0) & (arrays["species"] < len(names))).all()
    ):
        bad.add("species")
    return bad


def array_errors(
    arrays: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]], *, exact: bool = True
) -> dict[str, str]:
    """Name -> what is wrong with it, of the arrays of a state that have another shape, or values
    that no state has.

    exact : whether matrices must be rotations, not only numbers
    """
    errors = {}
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape:
            errors[name] = f"has the shape {array.shape}, not {shape}"
        elif array.dtype.kind not in "fi":
            errors[name] = f"is of the type {array.dtype}, not of real numbers"
        elif name == "cell" and not is_cell(array):
            errors[name] = (
                "is not a cell with a along x, b in the xy plane and positive a_x, b_y, c_z"
            )
        elif name != "cell" and not (np.abs(array) <= LARGEST).all():  # NaN is not
            errors[name] = "is not finite"
        elif name == "rotation" and exact and not are_rotations(array):
            errors[name] = "has matrices Q that are not rotations, with QᵀQ = 1 and determinant 1"
    return errors


def errors_of_arrays(state: State, like: State, about: str) -> list[str]:
    """Messages on the arrays of a state from outside, which have other shapes than those of another
    state, or values that no state has. about : the other state"""
    names = State._fields[:5]
    if masked := [name for name in names if np.ma.is_masked(getattr(state, name))]:
        return [f"{name} of the state has masked values, not numbers" for name in masked]
    arrays = {name: np.asarray(getattr(state, name)) for name in names}
    shapes = {name: getattr(like, name).shape for name in names}
    errors = array_errors(arrays, shapes)
    return [f"{name} of the state {error}; {about}" for name, error in errors.items()]


def are_rotations(matrices: np.ndarray) -> bool:
    """Whether matrices (n, 3, 3) are rotations, within NOT_A_ROTATION."""
    gap = np.swapaxes(matrices, 1, 2) @ matrices - np.eye(3)
    return bool(
        np.abs(gap).max(initial=0.0) <= NOT_A_ROTATION and (np.linalg.det(matrices) > 0).all()
    )


def is_cell(cell: np.ndarray) -> bool:
    """Whether a state may have this cell (3, 3): a along x, b in the xy plane, or the infinite
    edges of NO_CELL."""
    if not np.isfinite(cell).all():
        return np.array_equal(cell, NO_CELL)
    return bool(
        (cell.diagonal() > 0).all() and not np.triu(cell, 1).any() and np.abs(cell).max() <= LARGEST
    )
