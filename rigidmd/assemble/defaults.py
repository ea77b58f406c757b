"""Every default of a scene is decided here. Systems are built from resolved scenes only, in which they are filled in.

A resolved scene runs to the same bits as the scene that it came from. Three things stay open in it: an integrator that
is "auto", which a pilot run chooses; the number of threads, on which results do not depend; and the grid of PME where
the cell of the scene leans so much that another cell of the same lattice stands for it (see `SceneWithDefaults.pme_grid`).
"""

from math import inf, pi, prod, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.distance import pdist

from rigidmd.assemble.engine_defaults import stage_with_defaults
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
from rigidmd.io.cells import basis_in_words, edges_in_words
from rigidmd.scene import BodyScene, MolecularScene
from rigidmd.scene.body import FORMULATION, SAMPLES
from rigidmd.scene.forces import Forces, default_switch_start
from rigidmd.scene.models import Molecule
from rigidmd.scene.molecules import WITH_VELOCITIES, Output

CUTOFF = 9.0  # Å, in a periodic box
ACCURACY = 1e-5  # of Ewald sums
#: ps, with PME, whose forces do not add up to zero exactly: in it 216 waters at an accuracy of 1e-4 gained 26 u Å/ps;
#: thermal were 980.
REMOVE_MOMENTUM_INTERVAL = 1.0
#: Along an edge, as forces.ewald_k_max has it: more would take all memory.
MOST_WAVES = 1000
MOST_WAVES_IN_ALL = 2e7  # of which a step with 1000 sites takes half a minute

TOLERANCE = 1e-10  # of DOP853 and RADAU
TRAJECTORY_RADIUS = 10.0  # Å, of a body
#: Å; a .pdb has no place for coordinates below -999.
FARTHEST_IN_PDB = 900.0
#: Largest entry of abs(QᵀQ - 1) of a body: under schemes, which keep it, and under general solvers, which do not.
ORTHOGONALITY, ORTHOGONALITY_OF_SOLVERS = 1e-9, 0.1


class Composition(NamedTuple):
    """What the defaults of a scene of molecules depend on, besides the scene."""

    species: list[Molecule]
    counts: np.ndarray  # (k,) molecules of each species
    space: Space
    basis: np.ndarray  # (3, 3) integers: the edges of the box in those of the cell that was described

    @property
    def charges(self) -> Charges:
        """The charges of all molecules."""
        return charges_in(self.species, self.counts)

    @property
    def reciprocal(self) -> np.ndarray:
        """Reciprocal cell (3, 3), rows, 1/Å."""
        return 2 * pi * np.linalg.inv(cell_of(self.space)).T

    @property
    def is_as_described(self) -> bool:
        """Whether the box has the edges of the cell that was described."""
        return np.array_equal(self.basis, SAME_BASIS)


class SceneWithDefaults(NamedTuple):
    """A scene with its defaults filled in, and what is wrong with its numbers. With faults some may still be open."""

    scene: MolecularScene
    faults: list[str]
    #: Grid points along the edges of the box. The scene says the same, unless the box has other edges than the cell
    #: that was described: forces.pme_grid counts along those.
    pme_grid: tuple[int, int, int] | None


def with_defaults(scene: MolecularScene, facts: Composition) -> SceneWithDefaults:
    """A scene of molecules with every number that a run of it uses, but for that of `with_momentum_removal`."""
    numbers, faults = _range_of_forces(scene.forces, facts)
    grid = None
    if not faults and scene.forces.electrostatics in ("ewald", "pme"):
        found, faults, grid = _ewald(scene.forces, facts, numbers["cutoff_A"])
        numbers |= found
    if scene.output.pressure_tensor_interval_ps and facts.space.volume == inf:
        faults.append("output.pressure_tensor_interval_ps needs a periodic box: without one there is no pressure")
    tables = {
        "forces": scene.forces.model_copy(update=numbers),
        "output": _output(scene.output),
        "stages": tuple(stage_with_defaults(scene, stage) for stage in scene.stages),
    }
    # A file is copied under another name, which must not rename the species.
    tables["molecules"] = tuple(
        entry if entry.file is None else entry.model_copy(update={"name": facts.species[k].name})
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
    """A scene with the time between removals of the total momentum.

    keeps_momentum (3,) : which components of it the terms conserve
    """
    if scene.run.remove_momentum_interval_ps is not None:
        return scene
    removed = scene.forces.electrostatics == "pme" and keeps_momentum.any()
    run = {"remove_momentum_interval_ps": REMOVE_MOMENTUM_INTERVAL if removed else False}
    return scene.model_copy(update={"run": scene.run.model_copy(update=run)})


def _output(output: Output) -> Output:
    if output.velocities is not None:
        return output
    holds = bool(output.trajectory) and output.trajectory.endswith(WITH_VELOCITIES)
    return output.model_copy(update={"velocities": holds})


def _range_of_forces(forces: Forces, facts: Composition) -> tuple[dict[str, Any], list[str]]:
    """Cut-off and start of a switch as keys of [forces], and faults."""
    space = facts.space
    given = forces.cutoff_A or (CUTOFF if space.volume < inf else None)
    cutoff, start, faults = given or inf, forces.switch_start_A, []
    half = min(space.edges) / 2
    least = "the smallest of a_x, b_y, c_z" if isinstance(space, Triclinic) else "the shortest edge"
    if cutoff > half:
        faults.append(
            f"forces.cutoff_A = {cutoff:g}{_default(forces.cutoff_A)} is longer than half {least} of the box, "
            f"{half:.3f} Å: a site would meet two images of another. Take a larger box or a shorter cut-off"
        )
    for m in facts.species:
        extent = pdist(m.positions_body).max(initial=0.0)
        if extent > half:
            faults.append(
                f"a molecule of {m.name} is {extent:.2f} Å long, more than half {least} of the box, {half:.3f} Å"
            )
    if start is not None and start >= cutoff:
        faults.append(f"forces.switch_start_A = {start:g} is not below the cut-off of {cutoff:g} Å")
    if forces.tail_correction and space.volume == inf:
        faults.append("forces.tail_correction needs a periodic box: without one there is no liquid beyond the cut-off")
    faults += _electrostatic_faults(forces, space, cutoff)
    if start is None and cutoff < inf and "switch" in forces.truncation:
        start = default_switch_start(forces.truncation, cutoff)
    return {"cutoff_A": given, "switch_start_A": start}, faults


def _default(given: object) -> str:
    """Marks a default in a message."""
    return "" if given else " (the default)"


def _electrostatic_faults(forces: Forces, space: Space, cutoff: float) -> list[str]:
    """What is wrong with the electrostatics in this box."""
    method = forces.electrostatics
    if method in ("ewald", "pme") and space.volume == inf:
        return [
            f"forces.electrostatics = {method!r} sums over the images of a periodic box, and there is none; "
            "use reaction_field, which without a box is Coulomb's plain law"
        ]
    if method == "damped_shifted_force" and cutoff == inf:
        return ["forces.electrostatics = 'damped_shifted_force' ends at a cut-off; give forces.cutoff_A"]
    screening = {"damped_shifted_force": "damping_per_A", "ewald": "ewald_alpha_per_A", "pme": "ewald_alpha_per_A"}
    if (key := screening.get(method)) and (getattr(forces, key) or 0.0) * cutoff > MAX_ALPHA_CUTOFF:
        return [
            f"forces.{key} = {getattr(forces, key):g} with a cut-off of {cutoff:g} Å screens charges there by "
            f"erfc({getattr(forces, key) * cutoff:.3g}), far below rounding; at most {MAX_ALPHA_CUTOFF / cutoff:.3g} is of use"
        ]
    return []


def _ewald(
    forces: Forces, facts: Composition, cutoff: float
) -> tuple[dict[str, Any], list[str], tuple[int, int, int] | None]:
    """Numbers of an Ewald sum as keys of [forces], faults, and the grid of PME along the edges of the box.

    The accuracy goes once all that follows from it is there: beside those numbers it would do nothing.
    """
    usual = "plain" if forces.truncation == "plain" else "shift"
    numbers: dict[str, Any] = {"ewald_truncation": forces.ewald_truncation or usual}
    charges = facts.charges
    if charges.count == 0:
        return numbers, [], None
    accuracy = forces.ewald_accuracy or ACCURACY
    share = accuracy / sqrt(2)  # for either part
    asked = f"forces.ewald_accuracy = {accuracy:g}{_default(forces.ewald_accuracy)} cannot be had"
    alpha = float(forces.ewald_alpha_per_A or alpha_for(charges, cutoff, facts.space.volume, share))
    if alpha * cutoff > MAX_ALPHA_CUTOFF:
        return numbers, [f"{asked} with a cut-off of {cutoff:g} Å; take a longer one"], None
    numbers |= {"ewald_alpha_per_A": alpha, "ewald_accuracy": None}
    if forces.electrostatics == "ewald":
        radius = forces.ewald_k_radius_per_A
        if not forces.sets_k_vectors:
            radius = float(k_cutoff_for(charges, alpha, facts.reciprocal, share))
        longest = np.linalg.norm(cell_of(facts.space), axis=1).max()
        if radius is not None and forces.ewald_k_max is None and radius * longest > 2 * pi * MOST_WAVES:
            fault = (
                f"forces.ewald_k_radius_per_A = {radius:g}{_default(forces.ewald_k_radius_per_A)} is more than "
                f"{MOST_WAVES} waves along an edge of the box"
            )
            return numbers, [fault], None
        if (count := _waves_at_most(forces, radius, facts.space.volume)) > MOST_WAVES_IN_ALL:
            fault = (
                f"forces.electrostatics = 'ewald' needs about {count:.2g} waves, more than {MOST_WAVES_IN_ALL:.2g}: "
                "use pme, or ask for less accuracy, fewer waves or a smaller box"
            )
            return numbers, [fault], None
        return numbers | {"ewald_k_radius_per_A": radius}, [], None
    grid, order, cell = forces.pme_grid, forces.pme_order, cell_of(facts.space)
    if grid is not None and len(set(grid)) > 1 and not facts.is_as_described:
        fault = (
            f"forces.pme_grid = {list(grid)} counts points along edges of a cell that leans too much; the box is that "
            f"with {edges_in_words(cell)}, {basis_in_words(facts.basis)}, and has its own edges. Describe the box by "
            "that cell, or give three equal numbers, or leave pme_grid out"
        )
        return numbers, [fault], None
    if grid is None and (longest := np.linalg.norm(cell, axis=1).max()) > MAX_GRID_POINTS * SPACINGS[0]:
        fault = (
            f"forces.electrostatics = 'pme': an edge of {longest:.4g} Å is too long for a grid of {MAX_GRID_POINTS} points"
        )
        return numbers, [fault], None
    if grid is None or order is None:
        found = pme_grid_for(charges, alpha, cell, share, order, grid)
        if found is None:
            given = " with the forces.pme_order or pme_grid that is given" if order or grid else ""
            fault = f"{asked}{given} at alpha = {alpha:.3g} 1/Å; ask for less, or take a longer cut-off"
            return numbers, [fault], None
        grid, order = found
    numbers["pme_order"] = order
    if facts.is_as_described or forces.pme_grid is not None:
        numbers["pme_grid"] = grid
    else:
        numbers["ewald_accuracy"] = accuracy
    return numbers, [], grid


def _waves_at_most(forces: Forces, radius: float | None, volume: float) -> float:
    """About how many waves the radius (1/Å) and the limits of [forces] leave."""
    most = forces.ewald_k_max
    boxed = inf if most is None else prod(2.0 * n + 1 for n in (most if isinstance(most, tuple) else (most,) * 3))
    return min(boxed, inf if radius is None else radius**3 * volume / (6 * pi**2))


def body_with_defaults(scene: BodyScene, turns: bool, radius: float) -> BodyScene:
    """A scene of a single body with every number that a run of it uses.

    turns : whether the body has an orientation. radius : of the points that its trajectory shows, m
    """
    run, watch = scene.run, scene.watch
    solver = run.integrator in SOLVERS
    if solver:
        numbers: dict[str, Any] = {"formulation": (run.formulation or FORMULATION) if turns else None}
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
