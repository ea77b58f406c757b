"""Export to OpenMM: a folder with system, integrators and state as XML, and a script that runs the
stages."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.core.files import atomic_file, write_text
from rigidmd.core.plain_text import in_comment
from rigidmd.core.state import State
from rigidmd.features.external.force_field import ForceFieldView
from rigidmd.features.external.openmm.system import (
    KICK,
    MOVES,
    NM,
    TOLERANCES,
    Layout,
    extra_forces,
    integrator_of,
    layout,
    library,
    openmm_system,
)

if TYPE_CHECKING:
    from openmm.app import Topology

SYSTEM = "system.xml"
STATE = "state.xml"
TOPOLOGY = "topology.pdb"
SCRIPT = "run.py"

#: The script, with names in braces for which `write_openmm` has values.
TEXT = Path(__file__).with_name("run.txt").read_text(encoding="utf-8")


def write_openmm(folder: Path, view: ForceFieldView, state: State) -> list[str]:
    """Write the folder for a system at a state. Returns names of files. Raises OutputError or
    EngineError."""
    mm = library()
    particles = layout(view)
    position, velocity = (values * NM for values in particles.positions(state))
    made = openmm_system(particles, state.cell, separate=False)
    context = mm.Context(
        made, mm.VerletIntegrator(0.001), mm.Platform.getPlatformByName("Reference")
    )
    context.setPositions(position)
    context.setVelocities(velocity)
    serialize = mm.XmlSerializer.serialize
    text = {
        SYSTEM: serialize(made),
        STATE: serialize(context.getState(positions=True, velocities=True)),
    }
    rows = []
    scene = view.system.scene
    for k, stage in enumerate(scene.stages):
        if stage.is_minimisation:
            continue
        number = f"_{len(rows) + 1}" if rows else ""
        file = f"integrator{number}.xml"
        text[file] = serialize(integrator_of(view, k, TOLERANCES["mixed"]))
        others = []
        for n, other in enumerate(extra_forces(view, k)):
            others.append(f"besides{number}_{n + 1}.xml")
            text[others[-1]] = serialize(other)
        intervals = (scene.output.log_interval_ps, scene.output.trajectory_interval_ps)
        every, frame = map(stage.steps_of, intervals)
        rows.append(f"    {(stage.label, stage.steps, every, frame, file, others)!r},")
    names = {"system": SYSTEM, "state": STATE, "topology": TOPOLOGY, "kick": KICK, "moves": MOVES}
    values = {"title": in_comment(scene.in_short), "stages": "\n".join(rows), **names}
    text[SCRIPT] = re.sub(f"{{({'|'.join(values)})}}", lambda match: values[match[1]], TEXT)
    for name, content in text.items():
        write_text(folder / name, content)
    with (
        atomic_file(folder / TOPOLOGY) as temporary,
        open(temporary, "w", encoding="utf-8", newline="\n") as file,
    ):
        from openmm import Vec3, app

        # Å
        app.PDBFile.writeFile(
            _topology(particles), [Vec3(*row) for row in (position / NM).tolist()], file
        )
    return [*text, TOPOLOGY]


def _topology(particles: Layout) -> "Topology":
    """Names of all particles. Mass points without a site are called P1, P2, ..."""
    from openmm import app

    made = app.Topology()
    system = particles.view.system
    chain = made.addChain()
    for k in system.model.species:
        m = system.species[k]
        extra = particles.of_species[k].extra
        residue = made.addResidue(str(m.residue_names[0]), chain)
        names = [*m.site_names, *(f"P{j + 1}" for j in range(extra))]
        for name, symbol in zip(names, [*m.elements, *["X"] * extra], strict=True):
            made.addAtom(name, None if symbol == "X" else app.Element.getBySymbol(symbol), residue)
    return made
