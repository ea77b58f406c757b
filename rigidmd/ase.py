"""rigidmd as a calculator of ASE.

from rigidmd.ase import RigidMD

atoms.calc = RigidMD(["spce"], cutoff_A=9.0, electrostatics="pme")
atoms.get_potential_energy()
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.stress import full_3x3_to_voigt_6_stress, voigt_6_to_full_3x3_stress

from rigidmd.assemble.build import build
from rigidmd.assemble.matching import MatchedMolecules, massive_sites, match, refit
from rigidmd.assemble.scenes import SOURCE, atoms_faults, scene_from_atoms
from rigidmd.assemble.species import species_of
from rigidmd.core.state import State, state_of
from rigidmd.engines.cpu import Engine
from rigidmd.engines.system import System
from rigidmd.errors import RigidMDWarning, SceneError, StructureError
from rigidmd.io.cells import basis_of, least_skewed_cell, standard_rotation
from rigidmd.io.structure_file import read_atoms
from rigidmd.run.atom_forces import Form, ase_results
from rigidmd.run.minimise import minimise
from rigidmd.run.summary import describe_minimum, minimum_figures
from rigidmd.scene import MolecularScene, Scene
from rigidmd.scene.forces import Forces
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import did_you_mean, not_none

__all__ = ["RigidMD"]

#: A cell with a larger strain than this since numbers such as PME's grid were chosen has them chosen anew.
LARGEST_STRAIN = 0.1
#: Tables of a scene that a calculator takes.
TABLES = ("forces", "fields", "precision")


class RigidMD(Calculator):
    """Energy, forces and stress of rigid molecules, for the atoms that it is attached to.

    At each call rigid molecules are fitted to the atoms, by least squares with masses, as structure files are read.
    Massless sites (the M of TIP4P) are not among the atoms. All axes are periodic or none.

    energy, free_energy : eV, of the fitted molecules
    forces : eV/Å, minus the gradient of this energy. They share each molecule's force and torque among its atoms like
        the forces of a rigid motion, so they are 0 at a minimum. With atom_forces="sites" each atom has the forces of
        its own site, and those of massless sites are spread over the atoms: linear combinations of atoms by their
        coefficients, others by the least forces. Total force and torque on a molecule are the same in both, and
        constraints on all distances (`ase.constraints.FixBondLengths`) make them equal
    stress : eV/Å³, signs and order of ASE, from the molecular virial: the derivative for a strain that moves centres of
        mass and turns no molecule. Where torques are 0 it is also that of a strain of all atoms

    ASE moves atoms, and without constraints they bend molecules. The energy does not change then, but a warning tells
    it beyond `bend`, and atoms further from a rigid molecule than `tolerance` are an error. `minimise` moves rigid
    molecules instead, and `make_rigid` puts atoms where the fitted molecules have them.

    Parameters
    ----------
    models : names of shipped models or paths of .toml files, or tables like [[molecules]] of a scene file; or a scene,
        whose species, [forces], [fields] and precision count, and forces that Python added to it (`with_user_code`)
    atom_forces : "gradient" or "sites", see above
    bend : largest distance of an atom from its place in a rigid molecule without a warning, over the molecule's radius
    tolerance : the same without an error
    precision : "double" or "mixed"
    fields : the table [fields] of a scene file
    forces : keys of the table [forces]: cutoff_A, electrostatics, truncation, ...

    Raises SceneError or StructureError where atoms and models do not fit each other.
    """

    implemented_properties = ["energy", "free_energy", "forces", "stress"]  # noqa: RUF012  (ASE has it so)
    nolabel = True

    def __init__(
        self,
        models: MolecularScene | str | Sequence[str | Mapping[str, Any]],
        *,
        atom_forces: Form = "gradient",
        bend: float = 0.05,
        tolerance: float = 0.15,
        precision: str | None = None,
        fields: Mapping[str, Any] | None = None,
        **forces: Any,
    ):
        super().__init__()
        faults = []
        if atom_forces not in ("gradient", "sites"):
            faults.append(f"atom_forces is {atom_forces!r}, must be 'gradient' or 'sites'")
        if not 0 < bend <= tolerance < 1:
            faults.append(f"bend = {bend} and tolerance = {tolerance}: must be 0 < bend <= tolerance < 1")
        own = {"precision": precision, "fields": fields, "forces": forces or None}
        given = {key: value for key, value in own.items() if value is not None}
        known = list(Forces.model_fields)
        faults += [f"unknown keyword {key}{did_you_mean(key, known)}" for key in forces if key not in known]
        self._user_forces: tuple[Any, ...] = ()
        if isinstance(models, Scene):
            if not isinstance(models, MolecularScene):
                faults.append(f"the scene {models.name} is of a single body, which has no atoms")
            elif given:
                faults.append(f"{', '.join(given)}: the scene says them; change the scene")
            else:
                given, self._user_forces = _tables(models), models.user_code.forces
                models = [_entry(models, k) for k in range(len(models.molecules))]
        if faults:
            raise SceneError("RigidMD", faults)
        self._models: Any = models
        self._settings = given
        self._form: Form = atom_forces
        self._bend, self._tolerance = bend, tolerance
        self._warned = False
        self._assembly: _Assembly | None = None
        not_none(self.parameters).update(models=models, atom_forces=atom_forces, **given)

    def calculate(self, atoms: Atoms | None = None, properties=("energy",), system_changes=all_changes) -> None:
        """Energy, forces and, in a box, stress; called by ASE."""
        super().calculate(atoms, properties, system_changes)
        placed = self._placed(not_none(self.atoms))
        if not self._warned and placed.bent > self._bend:
            self._warned = True
            warnings.warn(
                f"an atom is {placed.largest:.3f} Å from its place in a rigid molecule, {placed.bent:.0%} of the "
                "molecule's radius: energy and forces are those of rigid molecules fitted to the atoms. make_rigid "
                "puts atoms there, minimise moves rigid molecules, and ase.constraints.FixBondLengths keeps them",
                RigidMDWarning,
                stacklevel=2,
            )
        assembly, turn = placed.assembly, placed.turn
        found = ase_results(assembly.system, assembly.engine, placed.state, self._form, placed.atoms)
        forces = np.zeros((len(not_none(self.atoms)), 3))
        forces[assembly.order] = found["forces"] @ turn
        self.results = {"energy": found["energy"], "free_energy": found["energy"], "forces": forces}
        if "stress" in found:
            full = turn.T @ voigt_6_to_full_3x3_stress(found["stress"]) @ turn
            self.results["stress"] = full_3x3_to_voigt_6_stress(full)

    def make_rigid(self, atoms: Atoms) -> float:
        """Put atoms where the rigid molecules fitted to them have them; the largest move, Å. Momenta stay."""
        placed = self._placed(atoms)
        before = atoms.get_positions()
        self._put(atoms, placed, placed.state)
        return float(np.linalg.norm(atoms.positions - before, axis=1).max())

    def minimise(self, atoms: Atoms, **limits: Any) -> dict[str, Any]:
        """Move rigid molecules to a minimum of the energy near them, or of the enthalpy if there is a pressure_bar.

        limits : keys of a stage with ensemble = "minimise": force_limit_kJ_mol_A, torque_limit_kJ_mol, pressure_bar,
            pressure_coupling, ...

        Sets positions, and the cell where it relaxes; constraints of the atoms are not asked (models say what is
        frozen). Returns the figures of the minimum, as summary.json has them. Raises SceneError, SimulationError.
        """
        assembly = self._assemble(atoms, limits)
        placed = assembly.place(atoms)
        stage, state = assembly.system.scene.stages[0], placed.state.copy()
        found = minimise(assembly.system, state, stage)
        if not found.converged:
            warnings.warn(describe_minimum(found, stage), RigidMDWarning, stacklevel=2)
        self._put(atoms, placed, state)
        return minimum_figures(found, len(state.position))

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_assembly": None}  # machine code stays in its process

    def _placed(self, atoms: Atoms) -> "_Placed":
        """Rigid molecules at the atoms, by what was matched before if it still fits."""
        if faults := atoms_faults(atoms):
            raise SceneError(SOURCE, faults)
        if self._assembly is not None and self._assembly.serves(atoms):
            placed = self._assembly.place(atoms)
            if placed.bent <= self._tolerance:
                return placed
            try:
                self._assembly = self._assemble(atoms, {})
            except StructureError as error:
                hint = "They fitted before: hold the molecules rigid by constraints, or move them by RigidMD.minimise"
                raise StructureError(SOURCE, [*error.errors, hint]) from None
        else:
            self._assembly = self._assemble(atoms, {})
        return self._assembly.place(atoms)

    def _assemble(self, atoms: Atoms, limits: Mapping[str, Any]) -> "_Assembly":
        """A system of these atoms. Raises SceneError, StructureError."""
        bare = atoms.copy()
        bare.set_constraint()
        bare.arrays.pop("momenta", None)
        settings = self._settings | {
            "structure": {"tolerance": self._tolerance},
            "stages": [{"ensemble": "minimise", **limits}],
        }
        scene = scene_from_atoms(bare, self._models, **settings)
        if self._user_forces:
            scene = scene.with_user_code(self._user_forces)
        system = build(scene)
        species = species_of(scene)
        held = scene.embedded_files["structure.file"]
        cell = atoms.cell.array if atoms.pbc.all() else None
        matched = match(read_atoms(Path("atoms.xyz"), held=held), species, cell, self._tolerance)
        if isinstance(matched, list):
            raise StructureError(SOURCE, matched)
        basis = np.eye(3)
        if cell is not None:
            upright, _ = standard_rotation(cell)
            other, turn = least_skewed_cell(upright)
            basis = basis_of(other @ turn, upright)
        own = bare.cell.array.copy()
        return _Assembly(system, system.engine(), species, matched, bare.numbers, bare.pbc.copy(), own, basis)

    @staticmethod
    def _put(atoms: Atoms, placed: "_Placed", state: State) -> None:
        """Set the positions of atoms to those of a state, each in the image in which it was; and the cell."""
        assembly, turn = placed.assembly, placed.turn
        before, after = (assembly.rigid(s) for s in (placed.state, state))
        positions = atoms.get_positions()
        if atoms.pbc.all():
            image = np.rint((placed.atoms_as_given - before) @ np.linalg.inv(placed.state.cell))
            after = after + image @ state.cell
            if not np.array_equal(state.cell, placed.state.cell):
                sign = np.sign(np.linalg.det(atoms.cell.array))
                given = np.linalg.inv(assembly.basis) @ state.cell @ turn
                atoms.set_cell(given * np.array([1, 1, sign])[:, None])
        positions[assembly.order] = after @ turn
        atoms.set_positions(positions, apply_constraint=False)


class _Placed(NamedTuple):
    """Rigid molecules fitted to atoms, in the frame of the engine: x_engine = turn x_ase."""

    assembly: "_Assembly"
    state: State
    turn: np.ndarray  # (3, 3)
    atoms: np.ndarray  # (a, 3) in the order of the system, molecules whole
    atoms_as_given: np.ndarray  # (a, 3) the same where they are
    largest: float  # distance of an atom from its place, Å
    bent: float  # the largest over the molecule's radius


class _Assembly(NamedTuple):
    """A system of some atoms, which serves other positions and cells."""

    system: System
    engine: Engine
    species: list[Molecule]
    matched: MatchedMolecules
    numbers: np.ndarray
    pbc: np.ndarray
    cell: np.ndarray  # (3, 3) for which its numbers were chosen
    basis: np.ndarray  # (3, 3) integers: edges of the engine's cell in those of the atoms' cell

    @property
    def order(self) -> np.ndarray:
        """Index (a,) into the atoms of the sites with mass."""
        return np.concatenate(self.matched.atoms)

    def serves(self, atoms: Atoms) -> bool:
        """Whether atoms of this kind, in about this cell, are those of the system."""
        if not (np.array_equal(atoms.numbers, self.numbers) and np.array_equal(atoms.pbc, self.pbc)):
            return False
        if not atoms.pbc.all():
            return True
        strain = np.linalg.solve(self.cell, atoms.cell.array) - np.eye(3)
        return bool(np.abs(strain).max() <= LARGEST_STRAIN)

    def place(self, atoms: Atoms) -> _Placed:
        """Fit the molecules to atoms."""
        turn, cell = np.eye(3), None
        if atoms.pbc.all():
            upright, first = standard_rotation(atoms.cell.array)
            cell, second = standard_rotation(self.basis @ upright)
            turn = second @ first
        position = atoms.positions @ turn.T
        found = refit(position, self.matched, self.species, cell)
        turning = len(self.system.state.rotation) > 0
        state = state_of(found.centre, None, found.rotation if turning else None, None, cell)
        given = position[self.order]
        whole = given
        if cell is not None:
            whole = given - np.rint((given - self.rigid(state)) @ np.linalg.inv(cell)) @ cell
        radius = np.array([m.radius if len(massive_sites(m)) > 1 else np.inf for m in self.species])[found.species]
        bent = found.deviation / radius
        return _Placed(self, state, turn, whole, given, float(found.deviation.max()), float(bent.max()))

    def rigid(self, state: State) -> np.ndarray:
        """Positions (a, 3) of the sites with mass."""
        return self.system.site_positions(state)[self.system.sites.mass > 0]


def _tables(scene: MolecularScene) -> dict[str, Any]:
    """The tables of a scene that a calculator takes, with the places of files."""
    tables = scene.model_dump(exclude_defaults=True)
    for force in tables.get("forces", {}).get("custom", ()):
        if "module" in force:
            force["module"] = str(scene.path(force["module"]).resolve())
    return {key: tables[key] for key in TABLES if key in tables}


def _entry(scene: MolecularScene, k: int) -> dict[str, Any]:
    """The table of a species, for other atoms: without a number of molecules, with the places of its files."""
    table = scene.molecules[k].model_dump(exclude_defaults=True)
    table.pop("count", None)
    return table | {key: str(scene.path(table[key]).resolve()) for key in ("file", "parameters") if key in table}
