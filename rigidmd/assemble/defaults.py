"""The defaults of scenes. A system is built from a resolved scene, in which every default is filled
in.

A resolved scene runs to the same bits as the original scene. Three values stay open in it: an
integrator "auto", which a pilot run chooses. The number of threads, on which results do not depend,
and the grid of PME where another cell of the same lattice replaces a cell with a large tilt (see
`SceneWithDefaults.pme_grid`).
"""

from importlib import import_module
from math import floor, inf
from types import ModuleType
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.plausibility import shortest_contact, switches_cores
from rigidmd.core.integrators import WITH_THERMOSTAT
from rigidmd.core.toml import Json
from rigidmd.forces.neighbors.space import Triclinic, cell_of, longest_gaps
from rigidmd.forces.parts import Grid, Settings, SystemParts
from rigidmd.forces.potentials.truncation import default_switch_start
from rigidmd.formats.cells import nearest_image_distance
from rigidmd.scene import MolecularScene
from rigidmd.scene.forces import ELECTROSTATICS, OPEN, PERIODIC, Forces

CUTOFF = 9.0  # Å, in a periodic box
#: Default with PME, ps. PME forces do not add up to zero exactly: in 1 ps 216 waters at an accuracy
#: of 1e-4 gained a momentum of 26 u Å/ps; their thermal momentum is 980.
REMOVE_MOMENTUM_INTERVAL = 1.0


def with_engine_defaults(scene: MolecularScene) -> tuple[MolecularScene, list[str]]:
    """A scene with those defaults that depend on an external engine, and notes on them."""
    if (program := scene.engine.program) is None:
        return scene, []
    notes = [f"computed by {scene.engine.title}"]
    stages = []
    for k, stage in enumerate(scene.stages):
        defaults = {}
        if program.thermostat and stage.has_thermostat and stage.thermostat is None:
            why = f"because {program.name} has no velocity_rescaling"
            notes.append(f"stages.{k}: thermostat {program.thermostat}, {why}")
            defaults["thermostat"] = program.thermostat
        kind = defaults.get("thermostat", stage.thermostat_kind)
        if stage.integrator in WITH_THERMOSTAT and kind != "langevin":
            notes.append(
                f"stages.{k}: the integrator that {program.name} has with {kind}, instead of"
                f" {stage.integrator}"
            )
        if stage.ensemble == "npt" and stage.barostat is None:
            defaults["barostat"] = program.barostat
        stages.append(stage.model_copy(update=defaults))
    changed: dict[str, object] = {"stages": tuple(stages)}
    if scene.run.remove_momentum_interval_ps is None:
        changed["run"] = scene.run.model_copy(update={"remove_momentum_interval_ps": False})
    return scene.model_copy(update=changed), notes


class SceneWithDefaults(NamedTuple):
    """A scene with its defaults filled in, and error messages. With errors some defaults may be
    missing."""

    scene: MolecularScene
    errors: list[str]
    #: Grid points along the edges of the box; forces.pme_grid of the scene refers to the edges of
    #: the given cell.
    pme_grid: Grid | None


def with_defaults(scene: MolecularScene, parts: SystemParts) -> SceneWithDefaults:
    """A scene of molecules with all defaults except `with_momentum_removal` and
    `with_precision`."""
    scene, errors = _with_electrostatics(scene, parts)
    numbers, cutoff_errors = _cutoff_and_switch(scene, parts)
    errors += cutoff_errors
    settings = Settings({}, errors)
    of_method = getattr(electrostatics_module(scene.forces), "settings", None)
    if not errors and of_method is not None:
        settings = of_method(scene.forces, parts, numbers["cutoff_A"], scene.engine.is_external)
        errors = settings.errors
    if not errors and scene.forces.dispersion != "cutoff":
        from rigidmd.forces.ewald import dispersion  # for these scenes only

        of_dispersion = dispersion.settings(scene.forces, parts, numbers["cutoff_A"])
        numbers = numbers | of_dispersion.numbers
        errors = of_dispersion.errors
    if scene.output.pressure_tensor_interval_ps and parts.space.volume == inf:
        why = "without which the pressure is not defined"
        errors.append(f"output.pressure_tensor_interval_ps needs a periodic box, {why}")
    output = scene.output
    if output.velocities is None:
        output = output.model_copy(update={"velocities": output.can_store_velocities})
    stages = [stage.with_defaults for stage in scene.stages]
    for k, stage in enumerate(scene.stages):
        if scene.engine.is_external and stage.ensemble == "npt" and stage.barostat is None:
            # the barostat of an external engine without a name has only a time constant
            stages[k] = stages[k].model_copy(
                update={"barostat": None, "barostat_interval_ps": None}
            )
    tables = {
        "forces": scene.forces.model_copy(update=numbers | settings.numbers),
        "output": output,
        "stages": tuple(stages),
        # the folder of a run has a copy of the file under another name, which must not rename the
        # species
        "molecules": tuple(
            (
                entry
                if entry.file is None
                else entry.model_copy(update={"name": parts.species[k].name})
            )
            for k, entry in enumerate(scene.molecules)
        ),
    }
    if scene.structure is not None:
        tables["structure"] = scene.structure.model_copy(update={"topology": scene.topology})
    reads_velocities = scene.structure is not None and scene.structure.velocities
    if scene.start.temperature_K is None and not reads_velocities:
        temperature = scene.first_moving.temperatures[0] if scene.first_moving else 0.0
        tables["start"] = scene.start.model_copy(update={"temperature_K": temperature})
    return SceneWithDefaults(scene.model_copy(update=tables), errors, settings.grid)


def with_momentum_removal(scene: MolecularScene, keeps_momentum: np.ndarray) -> MolecularScene:
    """A scene with the default of run.remove_momentum_interval_ps. keeps_momentum (3,) : conserved
    components.

    Where heat flows from rotation to translation, a thermostat that scales velocities scales the
    velocity of the centre of mass with them, by the same factor above 1 on average: its rounding
    error grows exponentially.
    """
    if scene.run.remove_momentum_interval_ps is not None:
        return scene
    electrostatics = ELECTROSTATICS[scene.forces.electrostatics or "none"]
    conserved = electrostatics.conserves_momentum and scene.forces.dispersion != "pme"
    is_scaled = any(stage.has_thermostat and stage.keeps_momentum for stage in scene.stages)
    removed = keeps_momentum.any() and (is_scaled or not conserved)
    run = {"remove_momentum_interval_ps": REMOVE_MOMENTUM_INTERVAL if removed else False}
    return scene.model_copy(update={"run": scene.run.model_copy(update=run)})


def _with_electrostatics(
    scene: MolecularScene, parts: SystemParts
) -> tuple[MolecularScene, list[str]]:
    """A scene with its method of electrostatics, tail correction and cutoff scheme of charges, and
    error messages."""
    forces = scene.forces
    errors = []
    method = forces.electrostatics
    if method is None:
        has_charges = any(m.charges.any() for m in parts.species)
        method = (PERIODIC if parts.space.volume < inf else OPEN) if has_charges else "none"
        errors += [f"forces.{message}" for message in forces.idle_key_errors(method)]
    numbers: Json = {"electrostatics": method}
    if method == "reaction_field" and forces.reaction_field_truncation is None:
        like = forces.truncation in ("plain", "smooth_switch")
        numbers["reaction_field_truncation"] = forces.truncation if like else "shift"
    if forces.tail_correction is None:
        numbers["tail_correction"] = not without_tail_reason(scene, parts)
    return scene.model_copy(update={"forces": forces.model_copy(update=numbers)}), errors


def without_tail_reason(scene: MolecularScene, parts: SystemParts) -> str:
    """Why a scene has no tail correction by default, or an empty text if it has a tail
    correction."""
    forces = scene.forces
    if not forces.lennard_jones:
        return "forces.lennard_jones is false"
    if forces.dispersion != "cutoff":
        return f"forces.dispersion = {forces.dispersion!r} sums over all images"
    if forces.added or scene.user_code.forces:
        return "a user's potential may end at its cutoff or fall too slowly for one"
    if scene.engine.is_external and any(stage.has_barostat for stage in scene.stages):
        return f"the barostat of {scene.engine.name} does not include it"
    if scene.fields.walls:
        return "it is for a uniform liquid, and there are walls"
    if any(m.frozen for m in scene.molecules):
        return "it is for a uniform liquid, and molecules are frozen"
    if parts.space.volume == inf:
        return "the scene has no periodic box"
    if (forces.cutoff_A or CUTOFF) < shortest_contact(parts.species):
        return "molecules touch beyond the cutoff"
    if switches_cores(forces, shortest_contact(parts.species)):
        return "the switch begins where molecules overlap"
    # A slab or a droplet leaves a part of an edge without any centre of mass, longer than two
    # distances between neighbours.
    space, position = parts.space, parts.state.position
    if longest_gaps(space, position).max() > 2 * (space.volume / len(position)) ** (1 / 3):
        return "the molecules do not fill the box evenly"
    return ""


def electrostatics_module(forces: Forces) -> ModuleType | None:
    """The module of `forces` with the method of electrostatics. None for electrostatics =
    "none"."""
    name = ELECTROSTATICS[forces.electrostatics or "none"].module
    return import_module(f"rigidmd.forces.{name}") if name else None


def _larger_box(scene: MolecularScene, parts: SystemParts, cutoff: float) -> str:
    """What has twice the cutoff between its faces, for a message."""
    for entry, kind in zip(scene.molecules, parts.species, strict=False):
        if entry.repeat is not None and kind.cell is not None:
            unit = kind.cell / np.array(entry.repeat)[:, None]
            heights = 1 / np.linalg.norm(np.linalg.inv(unit), axis=0)
            return f"repeat = {np.ceil(2 * cutoff / heights).astype(int).tolist()}"
    return "a larger box"


def _cutoff_and_switch(scene: MolecularScene, parts: SystemParts) -> tuple[Json, list[str]]:
    """Cutoff and start of a switch as keys of [forces], and error messages."""
    from scipy.spatial.distance import pdist  # slow to import

    forces = scene.forces
    space = parts.space
    cutoff_A = forces.cutoff_A or (CUTOFF if space.volume < inf else None)
    cutoff = cutoff_A or inf
    start = forces.switch_start_A
    errors = []
    half = min(space.edges) / 2
    allowed = nearest_image_distance(cell_of(space)) / 2 if half < inf else inf
    least = "the smallest of a_x, b_y, c_z" if isinstance(space, Triclinic) else "the shortest edge"
    limit = f"half {least} of the box, {half:.3f} Å"
    for key, value in (("cutoff_A", cutoff), ("ewald_cutoff_A", forces.ewald_cutoff_A or 0.0)):
        if value > half:
            default = "" if getattr(forces, key) else " (the default)"
            larger = _larger_box(scene, parts, value)
            shorter = f"{key} = {floor(100 * half) / 100:g} or less"
            why = "which violates the minimum-image convention"
            if value <= allowed:
                why = (
                    "up to which rigidmd finds the nearest images in this cell (the minimum-image"
                    f" convention allows {allowed:.3f} Å, half the distance of its nearest images)"
                )
            advice = f"Use {larger}, or {shorter}"
            errors.append(
                f"forces.{key} = {value:g}{default} is longer than {limit}, {why}. {advice}"
            )
    bodies = [m for m in parts.species if m.cell is None]  # a framework fills the box
    extents = {m.name: pdist(m.positions_body).max(initial=0.0) for m in bodies}
    errors += [
        f"a molecule of {m} is {x:.2f} Å long, more than {limit}"
        for m, x in extents.items()
        if x > half
    ]
    if start is not None and start >= cutoff:
        errors.append(f"forces.switch_start_A = {start:g} is not below the cutoff of {cutoff:g} Å")
    if forces.tail_correction and space.volume == inf:
        errors.append(
            "forces.tail_correction needs a periodic box, filled by a uniform liquid beyond the"
            " cutoff"
        )
    if (of_method := getattr(electrostatics_module(forces), "setting_errors", None)) is not None:
        errors += of_method(forces, space, cutoff)
    if start is None and cutoff < inf:
        schemes = (forces.truncation, forces.reaction_field_truncation or "")
        start = next(
            (default_switch_start(name, cutoff) for name in schemes if "switch" in name), None
        )
    return {"cutoff_A": cutoff_A, "switch_start_A": start}, errors
