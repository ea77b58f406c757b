"""Export to OpenMM: a folder with system, integrators and state as XML, and a script that runs the stages."""

# isort: skip_file
import re
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.core.files import atomic_file, write_text
from rigidmd.core.plain_text import in_comment
from rigidmd.core.state import State
from rigidmd.engines.force_field import ForceFieldView
from rigidmd.engines.openmm.system import (
    KICK, MOVES, NM, TOLERANCES, Layout, extra_forces, integrator_of, layout, library, openmm_system,
)  # fmt: skip

if TYPE_CHECKING:
    from openmm.app import Topology

SYSTEM, STATE, TOPOLOGY, SCRIPT = "system.xml", "state.xml", "topology.pdb", "run.py"

TEXT = '''"""{title}

Written by rigidmd. It needs OpenMM alone:  python run.py [CPU|CUDA|OpenCL|HIP|Reference]
"""

import csv
import sys

import openmm as mm
from openmm import app

# name, steps, steps between lines, steps between frames, files of the integrator and of what else acts
STAGES = [
{stages}
]


def load(name):
    with open(name) as file:
        return mm.XmlSerializer.deserialize(file.read())


def advance(integrator, steps):
    """Take steps; the integrator of constant energy begins and ends with half a kick."""
    if not isinstance(integrator, mm.CustomIntegrator):
        return integrator.step(steps)
    for kick, moves, count in ((0.5, 1, 1), (1.0, 1, steps - 1), (0.5, 0, 1)):
        integrator.setGlobalVariableByName("{kick}", kick)
        integrator.setGlobalVariableByName("{moves}", moves)
        integrator.step(count)


platform = mm.Platform.getPlatformByName(sys.argv[1] if len(sys.argv) > 1 else "CPU")
topology, state = app.PDBFile("{topology}").topology, load("{state}")
trajectory = None
with open("log.csv", "w") as log, open("trajectory.dcd", "wb") as frames:
    lines = csv.writer(log, lineterminator="\\n")
    lines.writerow(["stage", "step", "potential_kJ_mol", "kinetic_kJ_mol", "volume_A3"])
    for name, steps, every, frame, file, others in STAGES:
        system, integrator = load("{system}"), load(file)
        for other in others:
            system.addForce(load(other))
        context = mm.Context(system, integrator, platform)
        context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        context.setPositions(state.getPositions())
        context.setVelocities(state.getVelocities())
        trajectory = trajectory or app.DCDFile(frames, topology, integrator.getStepSize())
        done = 0
        while done < steps:
            more = min(steps, (done // every + 1) * every, (done // frame + 1) * frame) - done
            advance(integrator, more)
            done += more
            groups = integrator.getIntegrationForceGroups()
            state = context.getState(positions=True, velocities=True, energy=True, groups=groups)
            if done % every == 0:
                energies = [e._value for e in (state.getPotentialEnergy(), state.getKineticEnergy())]
                volume = state.getPeriodicBoxVolume()._value * 1e3
                lines.writerow([name, done, *energies, volume])
                log.flush()
            if done % frame == 0:
                trajectory.writeModel(state.getPositions(), periodicBoxVectors=state.getPeriodicBoxVectors())
with open("final.xml", "w") as file:
    file.write(mm.XmlSerializer.serialize(state))
'''


def write_openmm(folder: Path, view: ForceFieldView, state: State) -> list[str]:
    """Write the folder for a system at a state; returns names of files. Raises OutputError or EngineError."""
    mm = library()
    particles = layout(view)
    position, velocity = (values * NM for values in particles.positions(state))
    made = openmm_system(particles, state.cell, separate=False)
    context = mm.Context(made, mm.VerletIntegrator(0.001), mm.Platform.getPlatformByName("Reference"))
    context.setPositions(position)
    context.setVelocities(velocity)
    serialize = mm.XmlSerializer.serialize
    text = {SYSTEM: serialize(made), STATE: serialize(context.getState(positions=True, velocities=True))}
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
        every, frame = (max(1, round(interval * 1e3 / stage.timestep_fs)) for interval in intervals)
        rows.append(f"    {(stage.label, stage.steps, every, frame, file, others)!r},")
    names = {"system": SYSTEM, "state": STATE, "topology": TOPOLOGY, "kick": KICK, "moves": MOVES}
    values = {"title": in_comment(scene.in_short), "stages": "\n".join(rows), **names}
    text[SCRIPT] = re.sub(f"{{({'|'.join(values)})}}", lambda found: values[found[1]], TEXT)
    for name, content in text.items():
        write_text(folder / name, content)
    with atomic_file(folder / TOPOLOGY) as temporary, open(temporary, "w", encoding="utf-8") as file:
        from openmm import Vec3, app

        app.PDBFile.writeFile(_topology(particles), [Vec3(*row) for row in (position / NM).tolist()], file)  # Å
    return [*text, TOPOLOGY]


def _topology(particles: Layout) -> "Topology":
    """Names of all particles. Mass points without a site are called P1, P2, ..."""
    from openmm import app

    made, system = app.Topology(), particles.view.system
    chain = made.addChain()
    for k in system.model.species:
        m, extra = system.species[k], particles.of_species[k].extra
        residue = made.addResidue(str(m.residue_names[0]), chain)
        names = [*m.site_names, *(f"P{j + 1}" for j in range(extra))]
        for name, symbol in zip(names, [*m.elements, *["X"] * extra], strict=True):
            made.addAtom(name, None if symbol == "X" else app.Element.getBySymbol(symbol), residue)
    return made
