"""The stages of a scene in OpenMM: integrators, thermostats, barostats."""

from math import pi
from typing import Any

from rigidmd.engines.force_field import Portrait
from rigidmd.engines.openmm import system as parts
from rigidmd.scene.stage import Stage

#: Variables of the integrator for velocity Verlet: part of a kick, and whether positions move.
KICK, MOVES = "kick", "moves"
#: One more than the largest seed of random numbers; OpenMM chooses one itself for 0.
SEEDS = 2**31 - 1
#: Steps between removals of the total momentum that never come.
NEVER = 2**31 - 1
#: Relative tolerance of kept distances where they are computed in double precision, mixed and single.
TOLERANCES = {"double": 1e-12, "mixed": 1e-7, "single": 1e-6}


def tolerance(platform: str, properties: dict[str, str]) -> float:
    """Of kept distances, relative. The platforms Reference and CPU keep them in double precision."""
    return TOLERANCES[properties.get("Precision", "double")]


def integrator_of(portrait: Portrait, k: int, kept_to: float) -> Any:
    """The integrator of stage k: of a minimisation that which conserves the energy."""
    mm, stage = parts.library(), portrait.system.scene.stages[k]
    dt = stage.timestep_fs * 1e-3
    if stage.thermostat_kind == "langevin":
        made = mm.LangevinMiddleIntegrator(stage.temperatures[0], stage.frictions[0], dt)
        made.setRandomNumberSeed(_seed(portrait, k))
    elif stage.thermostat_kind == "nose_hoover":
        # a chain's frequency is that of its mass, 2 pi over the period of a scene
        made = mm.NoseHooverIntegrator(
            stage.temperatures[0], 2 * pi / stage.thermostat_time, dt, stage.nose_hoover_links
        )
    else:
        made = velocity_verlet(mm, dt)
    made.setConstraintTolerance(kept_to)
    made.setIntegrationForceGroups(integration_groups(portrait, stage))
    return made


def velocity_verlet(mm, dt: float) -> Any:
    """Velocity Verlet with kept distances, to be stepped by `step`.

    As leapfrog steps with half a kick at either end: the same positions and velocities (RATTLE; Andersen 1983, J.
    Comput. Phys. 52, 24), but no forces are needed within a step, where OpenMM has not yet put virtual sites in place.
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
    """Take some steps, of which velocity Verlet begins and ends with half a kick."""
    if not hasattr(integrator, "setGlobalVariableByName"):
        integrator.step(steps)
        return
    for kick, moves, count in ((0.5, 1, 1), (1.0, 1, steps - 1), (0.5, 0, 1)):
        integrator.setGlobalVariableByName(KICK, kick)
        integrator.setGlobalVariableByName(MOVES, moves)
        integrator.step(count)


def integration_groups(portrait: Portrait, stage: Stage) -> set[int]:
    """Groups of forces that move a stage: those that exert any, and what a barostat needs besides."""
    groups = {parts.LENNARD_JONES, parts.COULOMB_PAIRS, parts.RECIPROCAL}
    if stage.has_barostat:
        # it compares energies: with those that are continuous the pressure is that of the forces
        groups |= {parts.STEP_LENNARD_JONES, parts.STEP_COULOMB, parts.TAIL}
    return groups


def movers(portrait: Portrait, k: int) -> list:
    """What of stage k is not a matter of its integrator: a barostat; that a thermostat counts no total momentum."""
    mm, stage, system = parts.library(), portrait.system.scene.stages[k], portrait.system
    found = []
    if stage.thermostat_kind == "nose_hoover" and system.freedom_in(k).translation < 3 * int((~portrait.frozen).sum()):
        found.append(mm.CMMotionRemover(NEVER))
    if stage.has_barostat:
        barostat = mm.MonteCarloBarostat(stage.pressures[0][0], stage.temperatures[0], stage.moves_every)
        barostat.setRandomNumberSeed(_seed(portrait, k) % (SEEDS - 1) + 1)
        found.append(barostat)
    return found


def _seed(portrait: Portrait, k: int) -> int:
    return (portrait.system.scene.seed * 1000 + k) % (SEEDS - 1) + 1
