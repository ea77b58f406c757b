"""rigidmd as a calculator of ASE, and calculators of ASE as forces on rigid molecules.

from rigidmd.ase import CalculatorForce, RigidMD

atoms.calc = RigidMD(["spce"], cutoff_A=9.0, electrostatics="pme")
atoms.get_potential_energy()

results = rigidmd.Simulation(scene, forces=[CalculatorForce(calculator)]).run()
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.stress import full_3x3_to_voigt_6_stress, voigt_6_to_full_3x3_stress

from rigidmd.assemble.assignment import massive_sites
from rigidmd.assemble.build import build
from rigidmd.assemble.matching import CLEARLY_BETTER, CLOSE_FIT, MatchedMolecules, match, refit
from rigidmd.assemble.scenes import (
    SOURCE,
    atoms_errors,
    models_with_absolute_paths,
    scene_from_atoms,
)
from rigidmd.assemble.species import species_of
from rigidmd.core.state import NOW, State, state_of
from rigidmd.core.toml import Json
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.engines.system import System
from rigidmd.errors import RigidMDWarning, SceneError, StructureError, describe_error
from rigidmd.features.potentials.user_code.force import Force, UserForceError, real_numbers
from rigidmd.formats import STRUCTURE
from rigidmd.formats.cells import basis_of, least_skewed_cell, standard_rotation
from rigidmd.formats.through_ase import EV, atoms_of_sites
from rigidmd.io.structure_file import read_atoms
from rigidmd.io.trajectory import read_frames
from rigidmd.run.atom_forces import Form, ase_results
from rigidmd.run.minimise import minimise
from rigidmd.run.record import read_record
from rigidmd.run.summary import describe_minimum, minimum_figures
from rigidmd.scene import MolecularScene, Scene, is_molecular
from rigidmd.scene.base import with_absolute_paths
from rigidmd.scene.forces import Forces
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import did_you_mean, not_none
from rigidmd.units import KJ_PER_MOL

__all__ = ["CalculatorForce", "RigidMD"]

#: Largest strain of the cell for which numbers such as the grid of PME are kept.
LARGEST_STRAIN = 0.1
#: Atoms that are bent by this factor more than those before may be other atoms.
JUMP = 2.0
#: Tables of a scene that a calculator uses, and others on which no energy of the atoms depends.
TABLES = ("forces", "fields", "coupling", "precision")
WITHOUT_ENERGIES = (
    *("name", "seed", "threads", "engine", "structure", "box", "molecules", "start"),
    *("integrators", "stages", "run", "output", "watch", "from_python"),
)


class RigidMD(Calculator):
    """Energy, forces and stress of rigid molecules, for the atoms that it is attached to.

    Each call fits rigid molecules to the atoms, by least squares with masses. Massless sites (M of
    TIP4P) are not among the atoms. All axes are periodic or none. The page `ase` (`rigidmd help
    ase`) defines energy (eV), forces (eV/Å) and stress (eV/Å³), and describes what happens when ASE
    bends molecules.

    Parameters
    ----------
    models : MolecularScene, str, dict or sequence of these
        Names of shipped models or paths of .toml files, or tables like [[molecules]] of a scene
        file, or a scene, whose species, [forces], [fields], [coupling], precision and forces from
        Python are used
    atom_forces : {"gradient", "sites"}, optional
        "gradient" of the energy of the fitted molecules, or of "sites": each atom has the forces of
        its site
    bend : float, optional
        Largest distance of an atom from its rigid position without a warning, over the molecule's
        radius
    tolerance : float, optional
        Largest such distance without an error, over the molecule's radius
    precision : {"double", "mixed"}, optional
        Precision of sums over sites. Default: "double"
    fields : dict, optional
        The table [fields] of a scene file
    **forces : object
        Keys of the table [forces] of a scene file: cutoff_A, electrostatics, ...

    Raises
    ------
    SceneError, StructureError
        If atoms and models do not match.
    """

    # ASE has it so
    implemented_properties = ["energy", "free_energy", "forces", "stress"]  # noqa: RUF012
    nolabel = True

    def __init__(
        self,
        models: MolecularScene | str | Sequence[str | Mapping[str, object]],
        *,
        atom_forces: Form = "gradient",
        bend: float = 0.05,
        tolerance: float = 0.15,
        precision: str | None = None,
        fields: Mapping[str, object] | None = None,
        **forces: object,
    ):
        super().__init__()
        errors = []
        if atom_forces not in ("gradient", "sites"):
            errors.append(f"atom_forces is {atom_forces!r}, must be 'gradient' or 'sites'")
        if not 0 < bend <= tolerance < 1:
            errors.append(
                f"bend = {bend} and tolerance = {tolerance}: must be 0 < bend <= tolerance < 1"
            )
        tables = (("precision", precision), ("fields", fields), ("forces", forces or None))
        given = {key: value for key, value in tables if value is not None}
        known = list(Forces.model_fields)
        errors += [
            f"unknown keyword {key}{did_you_mean(key, known)}" for key in forces if key not in known
        ]
        self._user_forces: tuple[object, ...] = ()
        species: str | Sequence[str | Mapping[str, object]] = []
        if not isinstance(models, Scene):
            species = models
        elif not is_molecular(models):
            errors.append(f"the scene {models.name} is of {models.subject}, which has no atoms")
        elif given:
            errors.append(f"{', '.join(given)}: set by the scene. Change the scene")
        else:
            self._user_forces = models.user_code.forces
            species, given = _parts_of(models)
        if errors:
            raise SceneError("RigidMD", errors)
        self._models = models_with_absolute_paths(species)
        self._settings = with_absolute_paths(given)
        self._form: Form = atom_forces
        self._bend, self._tolerance = bend, tolerance
        self._warned = False
        self._assembly: _Assembly | None = None
        self._bent = 0.0  # of the molecules seen last
        not_none(self.parameters).update(models=species, atom_forces=atom_forces, **given)

    def calculate(
        self, atoms: Atoms | None = None, properties=("energy",), system_changes=all_changes
    ) -> None:
        """Energy, forces and, in a box, stress. Called by ASE.

        Parameters
        ----------
        atoms : ase.Atoms, optional
            Atoms of whole molecules
        properties : sequence of str, optional
            Names of requested properties. All are computed
        system_changes : sequence of str, optional
            What has changed since the last call
        """
        super().calculate(atoms, properties, system_changes)
        fitted = self._fit_atoms(not_none(self.atoms))
        if not self._warned and fitted.bent > self._bend:
            self._warned = True
            message = (
                f"an atom is {fitted.largest:.3f} Å from its position in a rigid molecule,"
                f" {fitted.bent:.0%} of the molecule's radius: energy and forces are computed for"
                " rigid molecules fitted to the atoms. make_rigid corrects the atoms, minimise"
                " moves rigid molecules, ase.constraints.FixBondLengths keeps distances"
            )
            warnings.warn(message, RigidMDWarning, stacklevel=2)
        assembly, rotation = fitted.assembly, fitted.rotation
        found = ase_results(
            assembly.system, assembly.engine, fitted.state, self._form, fitted.atoms
        )
        forces = np.zeros((len(not_none(self.atoms)), 3))
        forces[assembly.order] = found["forces"] @ rotation
        self.results = {"energy": found["energy"], "free_energy": found["energy"], "forces": forces}
        if "stress" in found:
            full = rotation.T @ voigt_6_to_full_3x3_stress(found["stress"]) @ rotation
            self.results["stress"] = full_3x3_to_voigt_6_stress(full)

    def make_rigid(self, atoms: Atoms) -> float:
        """Move atoms to their positions in the fitted rigid molecules.

        Parameters
        ----------
        atoms : ase.Atoms
            Atoms of whole molecules, which are moved

        Returns
        -------
        float
            Largest displacement, Å

        Raises
        ------
        StructureError
            If atoms and models do not match.
        """
        fitted = self._fit_atoms(atoms)
        before = atoms.get_positions()
        self._put(atoms, fitted, fitted.state)
        return float(np.linalg.norm(atoms.positions - before, axis=1).max())

    def minimise(self, atoms: Atoms, **stage_keys: object) -> Json:
        """Move rigid molecules to a near minimum of the energy, or of the enthalpy with
        pressure_bar.

        Sets positions, and the cell with pressure_bar. Constraints of the atoms are ignored. Models
        set what is frozen.

        Parameters
        ----------
        atoms : ase.Atoms
            Atoms of whole molecules, which are moved
        **stage_keys : object
            Keys of a stage with ensemble = "minimise": force_limit_kJ_mol_A, pressure_bar, ...

        Returns
        -------
        dict
            The values of the minimum, as in summary.json

        Raises
        ------
        SceneError, SimulationError
            For invalid keys, and if the minimisation fails.
        """
        assembly = self._assemble(atoms, stage_keys)
        fitted = assembly.fit(atoms)
        stage = assembly.system.scene.stages[0]
        state = fitted.state.copy()
        found = minimise(assembly.system, state, stage)
        if not found.converged:
            warnings.warn(describe_minimum(found, stage), RigidMDWarning, stacklevel=2)
        self._put(atoms, fitted, state)
        return minimum_figures(found, len(state.position))

    def __getstate__(self) -> dict[str, object]:
        return self.__dict__ | {"_assembly": None}  # machine code cannot be pickled

    def _fit_atoms(self, atoms: Atoms) -> "_FittedAtoms":
        """Rigid molecules fitted to the atoms, as matched before if this still fits. If they
        deviate much more than before, other atoms may be at the positions of these: then they are
        matched again, and the better match counts, so that an energy does not depend on the atoms
        that were seen before."""
        if errors := atoms_errors(atoms):
            raise SceneError(SOURCE, errors)
        known = (
            self._assembly
            if self._assembly is not None and self._assembly.applies_to(atoms)
            else None
        )
        before = known.fit(atoms) if known is not None else None
        usual = min(max(JUMP * self._bent, CLOSE_FIT), self._tolerance)
        if before is not None and before.bent <= usual:
            self._bent = before.bent
            return before
        try:
            found = self._assemble(atoms, {})
        except StructureError as error:
            if known is None:
                raise
            hint = (
                "They matched before: keep the molecules rigid by constraints, or move them by"
                " RigidMD.minimise"
            )
            raise StructureError(SOURCE, [*error.errors, hint]) from None
        fitted = found.fit(atoms)
        if before is not None and before.bent <= min(self._tolerance, fitted.bent / CLEARLY_BETTER):
            found = not_none(known)
            fitted = before
        self._assembly, self._bent = found, fitted.bent
        return fitted

    def _assemble(self, atoms: Atoms, stage_keys: Mapping[str, object]) -> "_Assembly":
        """A system of these atoms. Raises SceneError, StructureError."""
        bare = atoms.copy()
        bare.set_constraint()
        bare.arrays.pop("momenta", None)
        tables: Json = {"structure": {"tolerance": self._tolerance}} | self._settings
        scene = scene_from_atoms(
            bare, self._models, stages=[{"ensemble": "minimise", **stage_keys}], **tables
        )
        if self._user_forces:
            scene = scene.with_user_code(self._user_forces)
        system, species = build(scene), species_of(scene)
        read = read_atoms(Path(STRUCTURE), content=scene.embedded_files["structure.file"])
        cell = atoms.cell.array if atoms.pbc.all() else None
        matched = match(read, species, cell, self._tolerance)
        if isinstance(matched, list):
            raise StructureError(SOURCE, matched)
        basis = np.eye(3)
        if cell is not None:
            upright, _ = standard_rotation(cell)
            other, rotation = least_skewed_cell(upright)
            basis = basis_of(other @ rotation, upright)
        return _Assembly(
            system,
            system.engine(),
            species,
            matched,
            bare.numbers,
            bare.pbc.copy(),
            bare.cell.array.copy(),
            basis,
        )

    @staticmethod
    def _put(atoms: Atoms, fitted: "_FittedAtoms", state: State) -> None:
        """Set the positions of atoms, each in its image, and the cell, to a state."""
        assembly, rotation = fitted.assembly, fitted.rotation
        before, after = (assembly.rigid(s) for s in (fitted.state, state))
        positions = atoms.get_positions()
        if atoms.pbc.all():
            image = np.rint((fitted.atoms_as_given - before) @ np.linalg.inv(fitted.state.cell))
            after = after + image @ state.cell
            if not np.array_equal(state.cell, fitted.state.cell):
                given = np.linalg.inv(assembly.basis) @ state.cell @ rotation
                atoms.set_cell(
                    given * np.array([1, 1, np.sign(np.linalg.det(atoms.cell.array))])[:, None]
                )
        positions[assembly.order] = after @ rotation
        atoms.set_positions(positions, apply_constraint=False)


class _FittedAtoms(NamedTuple):
    """Rigid molecules fitted to atoms, in the frame of the engine: x_engine = rotation x_ase."""

    assembly: "_Assembly"
    state: State
    rotation: np.ndarray  # (3, 3)
    atoms: np.ndarray  # (a, 3) in the order of the system, molecules whole
    atoms_as_given: np.ndarray  # (a, 3) the same, not wrapped
    largest: float  # distance of an atom from its position in a rigid molecule, Å
    bent: float  # the largest distance over the radius of the molecule


class _Assembly(NamedTuple):
    """A system of atoms, for any positions and for similar cells."""

    system: System
    engine: CpuEngine
    species: list[Molecule]
    matched: MatchedMolecules
    numbers: np.ndarray
    pbc: np.ndarray
    cell: np.ndarray  # (3, 3) for which numbers such as the grid of PME were chosen
    # (3, 3) integers: edges of the engine's cell in terms of the edges of the atoms' cell
    basis: np.ndarray

    @property
    def order(self) -> np.ndarray:
        """Index (a,) into the atoms of the sites with mass."""
        return np.concatenate(self.matched.atoms)

    def applies_to(self, atoms: Atoms) -> bool:
        """Whether atoms have the elements and periodicity of the system, and a similar cell."""
        is_same = np.array_equal(atoms.numbers, self.numbers) and np.array_equal(
            atoms.pbc, self.pbc
        )
        if not is_same or not atoms.pbc.all():
            return is_same
        strain = np.linalg.solve(self.cell, atoms.cell.array) - np.eye(3)
        return bool(np.abs(strain).max() <= LARGEST_STRAIN)

    def fit(self, atoms: Atoms) -> _FittedAtoms:
        """Fit the molecules to atoms."""
        rotation = np.eye(3)
        cell = None
        if atoms.pbc.all():
            upright, first = standard_rotation(atoms.cell.array)
            cell, second = standard_rotation(self.basis @ upright)
            rotation = second @ first
        position = atoms.positions @ rotation.T
        found = refit(position, self.matched, self.species, cell)
        rotations = found.fit.rotation if len(self.system.state.rotation) else None
        state = state_of(found.fit.centre, None, rotations, None, cell)
        whole = given = position[self.order]
        if cell is not None:
            whole = given - np.rint((given - self.rigid(state)) @ np.linalg.inv(cell)) @ cell
        radius = np.array(
            [m.radius if len(massive_sites(m)) > 1 else np.inf for m in self.species]
        )[found.species]
        bent = found.fit.deviation / radius
        return _FittedAtoms(
            self, state, rotation, whole, given, float(found.fit.deviation.max()), float(bent.max())
        )

    def rigid(self, state: State) -> np.ndarray:
        """Positions (a, 3) of the sites with mass."""
        return self.system.site_positions(state)[self.system.sites.mass > 0]


class CalculatorForce(Force):
    """Forces on the atoms of rigid molecules from a calculator of ASE.

    The calculator is called once for each new set of positions, with one `ase.Atoms` of all sites
    with mass, molecules whole, in the order of `system.sites`. Forces within molecules have no
    effect. Its stress gives the molecular virial W = -V sigma - sum_i f_i (x) (r_i - R). The page
    `ase` (`rigidmd help ase`) has the formulas.

    Parameters
    ----------
    calculator : ase.calculators.calculator.Calculator
        With energies (eV) and forces (eV/Å) of periodic or free atoms, as the scene has them, and
        for a barostat or the pressure with a stress (eV/Å³)
    name : str, optional
        Name in logs and messages. Default: the name of the calculator's class
    energy_noise_eV : float, optional
        Random error of its energies, eV, as of self-consistent iterations or of single precision.
        Larger differences between forces and differences of the energy are rejected at the start of
        a run
    changes_momentum : bool or sequence of bool, optional
        Which components of the total momentum it may change: True for external fields and
        restraints

    Raises
    ------
    SceneError
        If a calculator without stress is used with a barostat.
    SimulationError
        If the calculator fails. The message names the step and the closest atoms.
    """

    def __init__(
        self,
        calculator: Calculator,
        *,
        name: str | None = None,
        energy_noise_eV: float = 0.0,
        changes_momentum: bool | Sequence[bool] = False,
    ):
        if not (hasattr(calculator, "calculate") and hasattr(calculator, "implemented_properties")):
            raise ValueError(f"calculator is {calculator!r:.60}, must be a calculator of ASE")
        if not 0 <= energy_noise_eV < np.inf:
            raise ValueError(
                f"energy_noise_eV is {energy_noise_eV!r}, must be a finite number, not negative"
            )
        self.calculator = calculator
        self.name = name or type(calculator).__name__  # type: ignore[misc]  # of each object here
        self.energy_noise = energy_noise_eV * EV / KJ_PER_MOL  # type: ignore[misc]
        self.changes_momentum = changes_momentum  # type: ignore[misc,assignment]

    def begin(self, system: System) -> None:
        """Make the atoms, and choose the properties that the calculator computes.

        Parameters
        ----------
        system : System
            The system of molecules
        """
        can = self.calculator.implemented_properties
        periodic = bool(np.isfinite(system.state.cell).all())
        if missing := [name for name in ("energy", "forces") if name not in can]:
            raise UserForceError(f"the calculator has no {' and no '.join(missing)}")
        self._has_virial = periodic and "stress" in can
        stages = [stage.label for stage in system.scene.stages if stage.changes_box]
        if stages and not self._has_virial:
            raise UserForceError(
                f"the stage {stages[0]} changes the box, and the calculator has no stress"
            )
        if periodic and not self._has_virial:
            system.notes.append(f"{self.name} has no stress: the pressure does not include it")
        self.absolute_positions = periodic and not self._has_virial  # type: ignore[misc]
        self._sites = system.sites
        self.atoms = atoms_of_sites(
            system, system.site_positions(system.state), None, system.state.cell, 0.0
        )

    def on_sites(self, position: np.ndarray, state: State) -> tuple:
        """Energy, forces on all sites, and the molecular virial where there is a stress.

        Parameters
        ----------
        position : ndarray
            Positions (s, 3) of the sites, Å
        state : State
            The state of the molecules

        Returns
        -------
        tuple
            Energy in kJ/mol, forces (s, 3) in kJ/mol/Å and the virial (3, 3) in kJ/mol
        """
        sites = self._sites
        calculator = self.calculator
        unit = EV / KJ_PER_MOL
        atom = sites.mass > 0
        self.atoms.positions[:] = position[atom]
        if self.atoms.pbc.all():
            self.atoms.set_cell(state.cell)
        try:
            if changes := calculator.check_state(self.atoms):
                calculator.reset()
                wanted = (
                    ["energy", "forces", "stress"] if self._has_virial else ["energy", "forces"]
                )
                calculator.calculate(self.atoms, wanted, changes)
            found = calculator.results
            energy = found["free_energy"] if "free_energy" in found else found["energy"]
            forces = found["forces"]
            stress = found["stress"] if self._has_virial else None
        except Exception as error:  # calculators raise anything
            where = f"at step {state.step[NOW]}; {self._closest_atoms()}"
            raise UserForceError(
                f"the calculator {self.name} raised {describe_error(error)} {where}"
            ) from error
        energy = unit * self._checked("energy", energy, (), (1,)).item()
        on_sites = np.zeros(position.shape)
        on_sites[atom] = unit * self._checked("forces", forces, (len(self.atoms), 3))
        if stress is None:
            return energy, on_sites
        stress = self._checked("stress", stress, (3, 3), (6,))
        stress = stress if stress.shape == (3, 3) else voigt_6_to_full_3x3_stress(stress)
        arm = position - state.position[sites.molecule]
        return energy, on_sites, -unit * state.volume * stress - on_sites.T @ arm

    def _checked(self, what: str, given: object, *shapes: tuple[int, ...]) -> np.ndarray:
        """Values of the calculator as an array of real numbers in one of these shapes. Raises
        UserForceError."""
        array = real_numbers(given)
        wanted = " or ".join(map(str, shapes))
        if array is None:
            kind = "masked or complex values" if hasattr(given, "dtype") else f"{given!r:.60}"
            problem = f"{kind} as {what}, not real numbers of the shape {wanted}"
        elif array.shape not in shapes:
            problem = f"{what} of the shape {array.shape}, not {wanted}"
        else:
            return array
        raise UserForceError(f"the calculator {self.name} returned {problem}")

    def _closest_atoms(self) -> str:
        """A message with the two atoms of different molecules that are closest."""
        owner = self._sites.molecule[self._sites.mass > 0]
        best = np.inf
        words = "there is one molecule"
        for k in range(len(owner) - 1):
            others = np.flatnonzero(owner[k + 1 :] != owner[k]) + k + 1
            if (
                len(others)
                and (distances := self.atoms.get_distances(k, others, mic=True)).min() < best
            ):
                best = distances.min()
                other = others[distances.argmin()]
                one, two = (
                    f"{self.atoms.symbols[i]} of molecule {owner[i] + 1}" for i in (k, other)
                )
                words = (
                    f"the closest atoms of different molecules, {one} and {two}, are at"
                    f" {best:.3g} Å"
                )
        return words


def read_rigidmd(name: str, index: int | slice = -1) -> Atoms | list[Atoms]:
    """Frames of a run for `ase.io.read`.

    Parameters
    ----------
    name : str
        Folder of the run, or the trajectory in it
    index : int or slice, optional
        Index of a frame, or several. Default: the last one

    Returns
    -------
    ase.Atoms or list of ase.Atoms
        A list for a slice

    Raises
    ------
    OutputError
        If the folder has no run of molecules.
    """
    record = read_record(Path(name) if Path(name).is_dir() else Path(name).parent)
    if not is_molecular(record.scene):
        raise TypeError(f"this is a run of {record.scene.subject}, which has no atoms")
    found = read_frames(record.trajectory, record.system.site_count, most=1 << 60)
    arrays = [
        [None] * len(found.time) if a is None else a
        for a in (found.positions, found.velocities, found.cells)
    ]
    return [
        atoms_of_sites(record.system, *frame)
        for frame in zip(*arrays, found.time.tolist(), strict=True)
    ][index]


def _parts_of(scene: MolecularScene) -> tuple[list[Json], Json]:
    """The tables of a scene's species without numbers of molecules, and the other TABLES. Paths are
    absolute."""
    tables = with_absolute_paths(scene.model_dump(exclude_defaults=True), scene.path(""))
    unknown = [key for key in tables if key not in (*TABLES, *WITHOUT_ENERGIES)]
    if unknown:
        errors = [f"{key}: a calculator cannot use this table. Leave it out" for key in unknown]
        raise SceneError(scene.source, errors)
    for table in tables["molecules"]:
        table.pop("count", None)
    return list(tables["molecules"]), {key: tables[key] for key in TABLES if key in tables}
