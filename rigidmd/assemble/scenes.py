"""Public functions on scenes: the start as an `ase.Atoms`, and scenes from an `ase.Atoms`.

The atoms of such a scene are an embedded structure file, extended XYZ with every digit.
"""

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Unpack

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.toml import Json, plain_values
from rigidmd.errors import RigidMDWarning, SceneError
from rigidmd.formats import STRUCTURE
from rigidmd.formats.cells import cell_error
from rigidmd.formats.through_ase import NAMES, RESIDUE_NAMES, RESIDUE_NUMBERS, atoms_of_system
from rigidmd.scene import MolecularScene
from rigidmd.scene.base import with_absolute_paths
from rigidmd.scene.molecules import Settings

if TYPE_CHECKING:
    import ase

DURATION = 1.0  # ps, of the stage of a scene without [[stages]]
SOURCE = "atoms"  # in messages
#: Constraints that a rigid molecule fulfils.
SHAPES = {"FixLinearTriatomic", "FixInternals"}


def to_atoms(scene: MolecularScene) -> "ase.Atoms":
    """The start of a run as an `ase.Atoms`, before overlaps are removed: see `Results.atoms`.

    Parameters
    ----------
    scene : MolecularScene
        The scene of molecules

    Returns
    -------
    ase.Atoms
        The sites with mass (a,), positions in Å

    Raises
    ------
    SceneError, StructureError, MoleculeError
        As `rigidmd.with_defaults`.
    """
    system = build(scene)
    return atoms_of_system(system, system.state)


def scene_from_atoms(
    atoms: "ase.Atoms",
    models: str | Sequence[str | Mapping[str, object]],
    **settings: Unpack[Settings],
) -> MolecularScene:
    """The scene of an `ase.Atoms`, whose atoms become molecules like the atoms of a structure file.

    Cell, periodicity (along all axes or none) and momenta are used. Massless sites, such as M of
    TIP4P, need not be among the atoms. The scene contains the atoms. A run in a folder writes them
    there. Atoms that do not match the models are found when the system is built.

    Parameters
    ----------
    atoms : ase.Atoms
        Atoms of whole molecules
    models : str, dict or sequence of these
        Names of shipped models or paths of .toml files, or tables like [[molecules]] of a scene
        file
    **settings : object
        The other tables and keys of a scene file: forces={"cutoff_A": 9.0}, stages=[{...}], seed=3.
        start={"temperature_K": 300} draws momenta instead of using the atoms' momenta. Default of
        stages: 1 ps of nve, or a minimisation if neither atoms nor settings give momenta

    Returns
    -------
    MolecularScene
        The scene

    Raises
    ------
    SceneError
        With all errors.
    """
    if errors := atoms_errors(atoms):
        raise SceneError(SOURCE, errors)
    data = with_absolute_paths(settings)
    filled: dict[str, Json] = {
        key: data.setdefault(key, {}) for key in ("structure", "start", "box")
    }
    errors = ["molecules is given by the atoms and models"] if "molecules" in data else []
    for key, table in filled.items():
        if not isinstance(table, Mapping):
            kind = type(table).__name__
            errors.append(
                f"{key} is a {kind}, must be a dictionary like the table [{key}] of a scene file"
            )
    structure, start, box = filled.values()
    taken = [
        key
        for key in ("file", "frame", "topology")
        if isinstance(structure, Mapping) and key in structure
    ]
    if errors := errors + [f"structure.{key} is given by the atoms" for key in taken]:
        raise SceneError(SOURCE, errors)
    draws = start.get("temperature_K") is not None
    structure["file"] = STRUCTURE
    structure.setdefault("velocities", atoms.has("momenta") and not draws)
    if not atoms.pbc.any():
        box.setdefault("periodic", False)
    if "stages" not in data:
        data["stages"] = [
            (
                {"duration_ps": DURATION}
                if structure["velocities"] or draws
                else {"ensemble": "minimise"}
            )
        ]
    data["molecules"] = models_with_absolute_paths(models)
    data.setdefault("name", atoms.get_chemical_formula()[:40])
    ignored = sorted(
        {type(c).__name__ for c in atoms.constraints if "Bond" not in type(c).__name__} - SHAPES
    )
    if ignored:
        advice = 'freeze molecules by the models, models=[{"model": "spce", "frozen": [1, 2]}]'
        what = f"the constraints of the atoms are ignored ({', '.join(ignored)})"
        warnings.warn(f"{what}: {advice}", RigidMDWarning, stacklevel=3)
    return MolecularScene.from_dict(
        data, source=SOURCE, embedded_files={"structure.file": text_of(atoms).encode()}
    )


def atoms_errors(atoms: object) -> list[str]:
    """Messages on an object that is not an `ase.Atoms`, or cannot consist of molecules."""
    import ase

    if not isinstance(atoms, ase.Atoms):
        hint = ". ase.io.read returns a list of them for ':'" if isinstance(atoms, list) else ""
        return [f"are of the type {type(atoms).__name__}, must be one ase.Atoms{hint}"]
    if len(atoms) == 0:
        return ["there are no atoms"]
    values = [("position", atoms.positions)]
    values += [("momentum", atoms.get_momenta())] if atoms.has("momenta") else []
    values += [("mass", atoms.get_masses()[:, None])] if atoms.has("masses") else []
    errors = []
    for what, array in values:
        if not (fine := np.isfinite(array).all(axis=1)).all():
            errors.append(f"atoms[{np.argmin(fine)}] has a {what} that is not a finite number")
    if atoms.pbc.any() and not atoms.pbc.all():
        axes = ", ".join(x for x, periodic in zip("abc", atoms.pbc, strict=True) if periodic)
        advice = "set pbc along all three axes or none (a slab can have a long cell)"
        errors.append(f"they are periodic along {axes} only: {advice}")
    elif atoms.pbc.all():
        cell = atoms.cell.array
        if np.isfinite(cell).all():
            why = cell_error(cell)
        else:
            why = "it has an edge that is not a finite number"
        if why:
            errors.append(
                f"they are periodic, but their cell is invalid: {why}. Set atoms.cell, or atoms.pbc"
                " = False"
            )
    return errors


def text_of(atoms: "ase.Atoms") -> str:
    """Atoms as extended XYZ with all digits of numbers, and with a cell if they are periodic."""
    columns = [("species", "S", [[symbol] for symbol in atoms.get_chemical_symbols()])]
    columns.append(("pos", "R", _digits(atoms.positions)))
    columns += [("momenta", "R", _digits(atoms.get_momenta()))] if atoms.has("momenta") else []
    columns += (
        [("masses", "R", _digits(atoms.get_masses()[:, None]))] if atoms.has("masses") else []
    )
    for name, kind in ((NAMES, "S"), (RESIDUE_NAMES, "S"), (RESIDUE_NUMBERS, "I")):
        values = [str(value) for value in atoms.arrays.get(name, ())]
        if values and all(value.isprintable() and len(value.split()) == 1 for value in values):
            columns.append((name, kind, [[value] for value in values]))
    about = ":".join(f"{name}:{kind}:{len(rows[0])}" for name, kind, rows in columns)
    box = 'pbc="F F F"'
    if atoms.pbc.all():
        # ASE reads a number without a point as an integer
        [edges] = _digits(atoms.cell.array.reshape(1, 9))
        edges = " ".join(text if "." in text else f"{float(text):.16e}" for text in edges)
        box = f'Lattice="{edges}" pbc="T T T"'
    lines = (
        " ".join(word for row in rows for word in row)
        for rows in zip(*(c[2] for c in columns), strict=True)
    )
    return "\n".join([str(len(atoms)), f"{box} Properties={about}", *lines]) + "\n"


def _digits(values: np.ndarray) -> list[list[str]]:
    """The shortest texts of numbers (n, k) that reproduce all bits."""
    return [[repr(x) for x in row] for row in np.asarray(values, float).tolist()]


def models_with_absolute_paths(
    models: str | Sequence[str | Mapping[str, object]],
) -> list[Json]:
    """Tables [[molecules]] of models, with absolute paths, so that they do not depend on the
    working directory."""
    models = plain_values(models)
    entries = [
        entry
        if isinstance(entry, dict)
        else {"file" if str(entry).endswith(".toml") else "model": entry}
        for entry in (models if isinstance(models, list) else [models])
    ]
    return with_absolute_paths({"molecules": entries})["molecules"]
