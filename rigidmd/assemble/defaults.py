"""The defaults of scenes. A system is built from a resolved scene, in which every default is filled in.

A resolved scene runs to the same bits as the original scene. Three values stay open in it: an integrator "auto", which
a pilot run chooses; the number of threads, on which results do not depend; and the grid of PME where another cell of
the same lattice replaces a cell with a large tilt (see `SceneWithDefaults.pme_grid`).
"""

from math import inf, pi, prod, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.distance import pdist

from rigidmd.core.integrators import RK4, SOLVERS
from rigidmd.engines.system import charges_in
from rigidmd.forces.ewald.errors import (
    MAX_ALPHA_CUTOFF,
    MAX_GRID_POINTS,
    SPACINGS,
    Charges,
    alpha_for,
    k_cutoff_for,
    pme_grid_for,
)
from rigidmd.forces.ewald.k_vectors import SAME_BASIS
from rigidmd.forces.neighbors.space import Space, Triclinic, cell_of
from rigidmd.io.cells import describe_basis, describe_cell
from rigidmd.scene import BodyScene, MolecularScene
from rigidmd.scene.body import FORMULATION, SAMPLES
from rigidmd.scene.forces import Forces, default_switch_start
from rigidmd.scene.models import Molecule
from rigidmd.scene.molecules import WITH_VELOCITIES
from rigidmd.scene.stage import Stage

#: Default thermostat of external engines, because neither LAMMPS nor OpenMM has velocity rescaling of rigid bodies.
THERMOSTAT = "nose_hoover"
#: Default barostats of external engines; LAMMPS' barostat has no name in a scene.
BAROSTATS = {"lammps": None, "openmm": "monte_carlo"}
CUTOFF = 9.0  # Å, in a periodic box
ACCURACY = 1e-5  # of Ewald sums
#: Default with PME, ps. PME forces do not add up to zero exactly: in 1 ps 216 waters at an accuracy of 1e-4 gained a
#: momentum of 26 u Å/ps; their thermal momentum is 980.
REMOVE_MOMENTUM_INTERVAL = 1.0
#: Largest number of k-vectors along an edge, as for forces.ewald_k_max: more would take all memory.
MOST_K_VECTORS = 1000
MOST_K_VECTORS_IN_ALL = 2e7  # with which a step with 1000 sites takes half a minute

TOLERANCE = 1e-10  # of DOP853 and RADAU
TRAJECTORY_RADIUS = 10.0  # Å, of a body
#: Å; the columns of a .pdb file are too narrow for coordinates below -999.
FARTHEST_IN_PDB = 900.0
#: Largest entry of abs(QᵀQ - 1) of a body with schemes, which preserve it, and with ODE solvers, which do not.
ORTHOGONALITY, ORTHOGONALITY_OF_SOLVERS = 1e-9, 0.1


def with_engine_defaults(scene: MolecularScene) -> tuple[MolecularScene, list[str]]:
    """A scene with those defaults that depend on an external engine, and notes on them."""
    if not scene.engine.is_external:
        return scene, []
    notes = [f"computed by {scene.engine.title}"]
    stages = []
    for k, stage in enumerate(scene.stages):
        if stage.has_thermostat and stage.thermostat is None and not stage.thermostat_is_open:
            notes.append(f"stages.{k}: thermostat {THERMOSTAT}, because {scene.engine.name} has no velocity_rescaling")
            stage = stage.model_copy(update={"thermostat": THERMOSTAT})
        if stage.ensemble == "npt" and stage.barostat is None:
            stage = stage.model_copy(update={"barostat": BAROSTATS[scene.engine.name]})
        stages.append(stage)
    changed: dict[str, Any] = {"stages": tuple(stages)}
    forces = scene.forces
    if forces.electrostatics in ("ewald", "pme") and forces.ewald_truncation is None:
        changed["forces"] = forces.model_copy(update={"ewald_truncation": "plain"})
    if scene.run.remove_momentum_interval_ps is None:
        changed["run"] = scene.run.model_copy(update={"remove_momentum_interval_ps": False})
    return scene.model_copy(update=changed), notes


def stage_with_defaults(scene: MolecularScene, stage: Stage) -> Stage:
    """A stage with all defaults; LAMMPS' barostat has only a time constant."""
    found = stage.with_defaults
    if scene.engine.name == "lammps" and stage.ensemble == "npt" and stage.barostat is None:
        found = found.model_copy(update={"barostat": None, "barostat_interval_ps": None})
    return found


class Composition(NamedTuple):
    """The properties of a system, besides its scene, on which defaults depend."""

    species: list[Molecule]
    counts: np.ndarray  # (k,) molecules of each species
    space: Space
    basis: np.ndarray  # (3, 3) integers: the edges of the box in terms of the edges of the given cell

    @property
    def charges(self) -> Charges:
        return charges_in(self.species, self.counts)

    @property
    def reciprocal(self) -> np.ndarray:
        """Reciprocal cell (3, 3), rows, 1/Å."""
        return 2 * pi * np.linalg.inv(cell_of(self.space)).T

    @property
    def has_given_cell(self) -> bool:
        """Whether the box has the edges of the given cell."""
        return np.array_equal(self.basis, SAME_BASIS)


class SceneWithDefaults(NamedTuple):
    """A scene with its defaults filled in, and error messages. With errors some defaults may be missing."""

    scene: MolecularScene
    errors: list[str]
    #: Grid points along the edges of the box; forces.pme_grid of the scene refers to the edges of the given cell.
    pme_grid: tuple[int, int, int] | None


def with_defaults(scene: MolecularScene, composition: Composition) -> SceneWithDefaults:
    """A scene of molecules with all defaults except `with_momentum_removal`."""
    numbers, faults = _cutoff_and_switch(scene.forces, composition)
    grid = None
    if not faults and scene.forces.electrostatics in ("ewald", "pme"):
        found, faults, grid = _ewald(scene.forces, composition, numbers["cutoff_A"])
        numbers |= found
    if scene.output.pressure_tensor_interval_ps and composition.space.volume == inf:
        faults.append(
            "output.pressure_tensor_interval_ps needs a periodic box, without which the pressure is not defined"
        )
    output = scene.output
    if output.velocities is None:
        can_store = bool(output.trajectory) and output.trajectory.endswith(WITH_VELOCITIES)
        output = output.model_copy(update={"velocities": can_store})
    tables = {
        "forces": scene.forces.model_copy(update=numbers),
        "output": output,
        "stages": tuple(stage_with_defaults(scene, stage) for stage in scene.stages),
    }
    # The folder of a run has a copy of the file under another name, which must not rename the species.
    tables["molecules"] = tuple(
        entry if entry.file is None else entry.model_copy(update={"name": composition.species[k].name})
        for k, entry in enumerate(scene.molecules)
    )
    if scene.structure is not None:
        tables["structure"] = scene.structure.model_copy(update={"topology": scene.topology})
    reads_velocities = scene.structure is not None and scene.structure.velocities
    if scene.start.temperature_K is None and not reads_velocities:
        first = scene.first_moving
        temperature = first.temperatures[0] if first else 0.0
        tables["start"] = scene.start.model_copy(update={"temperature_K": temperature})
    return SceneWithDefaults(scene.model_copy(update=tables), faults, grid)


def with_momentum_removal(scene: MolecularScene, keeps_momentum: np.ndarray) -> MolecularScene:
    """A scene with the default of run.remove_momentum_interval_ps. Terms conserve the components keeps_momentum (3,) of
    the total momentum."""
    if scene.run.remove_momentum_interval_ps is not None:
        return scene
    removed = scene.forces.electrostatics == "pme" and keeps_momentum.any()
    run = {"remove_momentum_interval_ps": REMOVE_MOMENTUM_INTERVAL if removed else False}
    return scene.model_copy(update={"run": scene.run.model_copy(update=run)})


def _cutoff_and_switch(forces: Forces, composition: Composition) -> tuple[dict[str, Any], list[str]]:
    """Cutoff and start of a switch as keys of [forces], and error messages."""
    space = composition.space
    given = forces.cutoff_A or (CUTOFF if space.volume < inf else None)
    cutoff, start, faults = given or inf, forces.switch_start_A, []
    half = min(space.edges) / 2
    least = "the smallest of a_x, b_y, c_z" if isinstance(space, Triclinic) else "the shortest edge"
    if cutoff > half:
        faults.append(
            f"forces.cutoff_A = {cutoff:g}{_default(forces.cutoff_A)} is longer than half {least} of the box, "
            f"{half:.3f} Å, which violates the minimum-image convention. Use a larger box or a shorter cutoff"
        )
    for m in composition.species:
        extent = pdist(m.positions_body).max(initial=0.0)
        if extent > half:
            longer = f"more than half {least} of the box, {half:.3f} Å"
            faults.append(f"a molecule of {m.name} is {extent:.2f} Å long, {longer}")
    if start is not None and start >= cutoff:
        faults.append(f"forces.switch_start_A = {start:g} is not below the cutoff of {cutoff:g} Å")
    if forces.tail_correction and space.volume == inf:
        faults.append("forces.tail_correction needs a periodic box, filled by a uniform liquid beyond the cutoff")
    faults += _electrostatic_errors(forces, space, cutoff)
    if start is None and cutoff < inf and "switch" in forces.truncation:
        start = default_switch_start(forces.truncation, cutoff)
    return {"cutoff_A": given, "switch_start_A": start}, faults


def _default(given: object) -> str:
    return "" if given else " (the default)"


def _electrostatic_errors(forces: Forces, space: Space, cutoff: float) -> list[str]:
    """Messages on electrostatics that this box does not allow."""
    method = forces.electrostatics
    if method in ("ewald", "pme") and space.volume == inf:
        instead = "use reaction_field, which without a box is Coulomb's law"
        return [f"forces.electrostatics = {method!r} needs a periodic box; {instead}"]
    if method == "damped_shifted_force" and cutoff == inf:
        return ["forces.electrostatics = 'damped_shifted_force' needs a cutoff; give forces.cutoff_A"]
    screening = {"damped_shifted_force": "damping_per_A", "ewald": "ewald_alpha_per_A", "pme": "ewald_alpha_per_A"}
    if (key := screening.get(method)) and (getattr(forces, key) or 0.0) * cutoff > MAX_ALPHA_CUTOFF:
        return [
            f"forces.{key} = {getattr(forces, key):g} with a cutoff of {cutoff:g} Å screens charges there by "
            f"erfc({getattr(forces, key) * cutoff:.3g}), far below rounding; at most {MAX_ALPHA_CUTOFF / cutoff:.3g} "
            "is of use"
        ]
    return []


def _ewald(
    forces: Forces, composition: Composition, cutoff: float
) -> tuple[dict[str, Any], list[str], tuple[int, int, int] | None]:
    """Numbers of an Ewald sum as keys of [forces], error messages, and the grid of PME along the edges of the box.
    ewald_accuracy becomes None when all numbers that follow from it are set."""
    usual = "plain" if forces.truncation == "plain" else "shift"
    numbers: dict[str, Any] = {"ewald_truncation": forces.ewald_truncation or usual}
    charges = composition.charges
    if charges.count == 0:
        return numbers, [], None
    accuracy = forces.ewald_accuracy or ACCURACY
    part = accuracy / sqrt(2)  # of the real-space and of the reciprocal error
    unreachable = f"forces.ewald_accuracy = {accuracy:g}{_default(forces.ewald_accuracy)} cannot be reached"
    alpha = float(forces.ewald_alpha_per_A or alpha_for(charges, cutoff, composition.space.volume, part))
    if alpha * cutoff > MAX_ALPHA_CUTOFF:
        return numbers, [f"{unreachable} with a cutoff of {cutoff:g} Å; use a longer one"], None
    numbers |= {"ewald_alpha_per_A": alpha, "ewald_accuracy": None}
    if forces.electrostatics == "ewald":
        radius = forces.ewald_k_radius_per_A
        if not forces.sets_k_vectors:
            radius = float(k_cutoff_for(charges, alpha, composition.reciprocal, part))
        longest = np.linalg.norm(cell_of(composition.space), axis=1).max()
        if radius is not None and forces.ewald_k_max is None and radius * longest > 2 * pi * MOST_K_VECTORS:
            given = f"forces.ewald_k_radius_per_A = {radius:g}{_default(forces.ewald_k_radius_per_A)}"
            return numbers, [f"{given} is more than {MOST_K_VECTORS} k-vectors along an edge of the box"], None
        if (count := _number_of_k_vectors(forces, radius, composition.space.volume)) > MOST_K_VECTORS_IN_ALL:
            fault = f"needs about {count:.2g} k-vectors, more than {MOST_K_VECTORS_IN_ALL:.2g}"
            advice = "use pme, a lower accuracy, fewer k-vectors or a smaller box"
            return numbers, [f"forces.electrostatics = 'ewald' {fault}: {advice}"], None
        return numbers | {"ewald_k_radius_per_A": radius}, [], None
    grid, order, cell = forces.pme_grid, forces.pme_order, cell_of(composition.space)
    if grid is not None and len(set(grid)) > 1 and not composition.has_given_cell:
        fault = (
            f"forces.pme_grid = {list(grid)} refers to the edges of a cell with a large tilt; the box is the "
            f"equivalent cell with {describe_cell(cell)}, {describe_basis(composition.basis)}. Give this cell as the "
            "box, or three equal numbers, or leave pme_grid out"
        )
        return numbers, [fault], None
    if grid is None and (longest := np.linalg.norm(cell, axis=1).max()) > MAX_GRID_POINTS * SPACINGS[0]:
        fault = f"an edge of {longest:.4g} Å is too long for a grid of {MAX_GRID_POINTS} points"
        return numbers, [f"forces.electrostatics = 'pme': {fault}"], None
    if grid is None or order is None:
        found = pme_grid_for(charges, alpha, cell, part, order, grid)
        if found is None:
            given = " with the given forces.pme_order or pme_grid" if order or grid else ""
            fault = f"{unreachable}{given} at alpha = {alpha:.3g} 1/Å; use a lower accuracy or a longer cutoff"
            return numbers, [fault], None
        grid, order = found
    numbers["pme_order"] = order
    if composition.has_given_cell or forces.pme_grid is not None:
        numbers["pme_grid"] = grid
    else:
        numbers["ewald_accuracy"] = accuracy
    return numbers, [], grid


def _number_of_k_vectors(forces: Forces, radius: float | None, volume: float) -> float:
    """Approximate number of k-vectors within a radius (1/Å) and the limits of [forces]."""
    most = forces.ewald_k_max
    boxed = inf if most is None else prod(2.0 * n + 1 for n in (most if isinstance(most, tuple) else (most,) * 3))
    return min(boxed, inf if radius is None else radius**3 * volume / (6 * pi**2))


def body_with_defaults(scene: BodyScene, rotates: bool, radius: float) -> BodyScene:
    """A scene of a single body with all defaults; rotates: the body has an orientation; radius: of the points in its
    trajectory, m."""
    run, watch = scene.run, scene.watch
    solver = run.integrator in SOLVERS
    if solver:
        numbers: dict[str, Any] = {"formulation": (run.formulation or FORMULATION) if rotates else None}
        if run.integrator != RK4:
            numbers["relative_tolerance"] = run.relative_tolerance or TOLERANCE
            numbers["absolute_tolerance"] = run.absolute_tolerance or TOLERANCE
        run = run.model_copy(update=numbers)
    scale = scene.output.trajectory_A_per_m or (TRAJECTORY_RADIUS / radius if radius > 0 else 1.0)
    reach = scale * (radius + max(map(abs, scene.start.position_m or (0.0,))))
    output = {
        "interval_s": scene.output.interval_s or run.duration_s / SAMPLES,
        "trajectory_A_per_m": scale,
        "topology": scene.output.topology or f"topology.{'pdb' if reach < FARTHEST_IN_PDB else 'gro'}",
    }
    if watch.orthogonality is None:
        watch = watch.model_copy(update={"orthogonality": ORTHOGONALITY_OF_SOLVERS if solver else ORTHOGONALITY})
    return scene.model_copy(update={"run": run, "output": scene.output.model_copy(update=output), "watch": watch})
