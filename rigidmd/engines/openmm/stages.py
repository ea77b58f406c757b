"""The stages of a scene in OpenMM: integrators, thermostats, barostats."""

from math import pi
from typing import Any

from rigidmd.engines.force_field import ForceFieldView
from rigidmd.engines.openmm.system import Group, library
from rigidmd.scene.stage import Stage

#: Variables of the velocity Verlet integrator: fraction of a kick, and whether positions move.
KICK, MOVES = "kick", "moves"
#: One more than the largest seed. OpenMM chooses a seed itself for 0.
SEEDS = 2**31 - 1
#: Interval, in steps, of a removal of momentum that never happens.
NEVER = 2**31 - 1
#: Relative tolerance of constrained distances by precision, which is double on the platforms Reference and CPU.
TOLERANCES = {"double": 1e-12, "mixed": 1e-7, "single": 1e-6}


def integrator_of(view: ForceFieldView, k: int, distance_tolerance: float) -> Any:
    """The integrator of stage k. A minimisation gets velocity Verlet."""
    mm, stage = library(), view.system.scene.stages[k]
    dt = stage.timestep_fs * 1e-3
    if stage.thermostat_kind == "langevin":
        made = mm.LangevinMiddleIntegrator(stage.temperatures[0], stage.frictions[0], dt)
        made.setRandomNumberSeed(_seed(view, k))
    elif stage.thermostat_kind == "nose_hoover":
        # OpenMM has the angular frequency of a chain, a scene its period
        made = mm.NoseHooverIntegrator(
            stage.temperatures[0], 2 * pi / stage.thermostat_time, dt, stage.nose_hoover_links
        )
    else:
        made = velocity_verlet(mm, dt)
    made.setConstraintTolerance(distance_tolerance)
    made.setIntegrationForceGroups(integration_groups(view, stage))
    return made


def velocity_verlet(mm, dt: float) -> Any:
    """Velocity Verlet with constrained distances, to be stepped by `step`.

    Leapfrog steps with half a kick at either end give the same positions and velocities (RATTLE; Andersen 1983, J.
    Comput. Phys. 52, 24) without forces within a step, where OpenMM has not yet computed the virtual sites.
    """
    made = mm.CustomIntegrator(dt)
    made.addGlobalVariable(KICK, 1.0)
    made.addGlobalVariable(MOVES, 1.0)
    made.addPerDofVariable("x1", 0)
    made.addComputePerDof("v", f"v+{KICK}*dt*f/m")
    made.beginIfBlock(f"{MOVES} = 1")
    made.addComputePerDof("x", "x+dt*v")
    made.addComputePerDof("x1", "x")
    made.addConstrainPositions()
    made.addComputePerDof("v", "v+(x-x1)/dt")
    made.endBlock()
    made.beginIfBlock(f"{MOVES} = 0")
    made.addConstrainVelocities()
    made.endBlock()
    return made


def step(integrator: Any, steps: int) -> None:
    """Take steps. Velocity Verlet begins and ends with half a kick."""
    if not hasattr(integrator, "setGlobalVariableByName"):
        integrator.step(steps)
        return
    for kick, moves, count in ((0.5, 1, 1), (1.0, 1, steps - 1), (0.5, 0, 1)):
        integrator.setGlobalVariableByName(KICK, kick)
        integrator.setGlobalVariableByName(MOVES, moves)
        integrator.step(count)


def integration_groups(view: ForceFieldView, stage: Stage) -> set[int]:
    """The force groups that move a stage: those with forces, and energies that a barostat needs in addition."""
    groups = {Group.LENNARD_JONES, Group.COULOMB_PAIRS, Group.RECIPROCAL}
    if stage.has_barostat:
        # it compares energies; the pressure agrees with the forces if energies are continuous
        groups |= {Group.STEP_LENNARD_JONES, Group.STEP_COULOMB, Group.TAIL}
    return groups


def extra_forces(view: ForceFieldView, k: int) -> list:
    """The forces of stage k in addition to its integrator: a barostat, and a remover of momentum that makes OpenMM
    subtract the degrees of freedom of the total momentum."""
    mm, stage, system = library(), view.system.scene.stages[k], view.system
    found = []
    if stage.thermostat_kind == "nose_hoover" and system.freedom_in(k).translation < 3 * int((~view.frozen).sum()):
        found.append(mm.CMMotionRemover(NEVER))
    if stage.has_barostat:
        barostat = mm.MonteCarloBarostat(stage.pressures[0][0], stage.temperatures[0], stage.moves_every)
        barostat.setRandomNumberSeed(_seed(view, k) % (SEEDS - 1) + 1)
        found.append(barostat)
    return found


def _seed(view: ForceFieldView, k: int) -> int:
    return (view.system.scene.seed * 1000 + k) % (SEEDS - 1) + 1
