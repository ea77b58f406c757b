"""The integrator of a stage: its scheme with the flows of the thermostat and the barostat."""

from math import inf
from typing import NamedTuple

from rigidmd.core.integrators import Scheme
from rigidmd.dynamics.barostats import BAROSTATS, Confinement, Pressure
from rigidmd.dynamics.model import mobile
from rigidmd.dynamics.noise import BAROSTAT, THERMOSTAT, key_of
from rigidmd.dynamics.thermostats import THERMOSTATS, Ramp, VelocityRescaling, constant_ramp
from rigidmd.engines.system import System
from rigidmd.scene import couplings
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, BOLTZMANN, FEMTOSECOND


def integrator_of_stage(system: System, k: int) -> Scheme:
    """The scheme of stage k, with its thermostat, its barostat and the removal of total momentum."""
    scene, stage = system.scene, system.scene.stages[k]
    found, thermostat = stage.scheme, system.thermostat
    if thermostat is not None and hasattr(thermostat, "for_stage"):
        thermostat = thermostat.for_stage(system, k)
    elif thermostat is None and stage.has_thermostat:
        thermostat = thermostat_of(system, k)
    elif (
        thermostat is None
        and not stage.has_barostat
        and any(other.thermostat_kind == couplings.DEFAULT_THERMOSTAT for other in scene.stages)
    ):
        # An idle thermostat, so that all stages run the same machine code.
        thermostat = VelocityRescaling(constant_ramp(0.0), inf, system.freedom.total, key_of(scene.seed, THERMOSTAT, k))
    if thermostat is not None:
        found = found.with_thermostat(thermostat, halved=getattr(thermostat, "halved", True))
    if stage.has_barostat:
        barostat = barostat_of(system, k)
        in_steps = couplings.BAROSTATS[stage.barostat_kind].in_verlet_steps
        found = found.with_piston(barostat) if in_steps else found.with_barostat(barostat, stage.moves_every)
    if system.keeps_momentum_in(k) and (interval := system.removes_momentum_every) is not None:
        found = found.with_momentum_removal(max(1, round(interval / (stage.timestep_fs * FEMTOSECOND))))
    return found


def thermostat_of(system: System, k: int) -> NamedTuple:
    stage = system.scene.stages[k]
    thermal, key = _thermal(stage), key_of(system.scene.seed, THERMOSTAT, k)
    return THERMOSTATS[stage.thermostat_kind](stage, thermal, system.freedom_in(k), key)


def barostat_of(system: System, k: int) -> NamedTuple:
    stage, key = system.scene.stages[k], key_of(system.scene.seed, BAROSTAT, k)
    # the scene lists xy, xz, yz: components (1, 0), (2, 0), (2, 1) of the lower triangle
    pressure = Pressure(*(tuple(x * BAR for x in ends) for ends in stage.pressures), float(stage.steps))
    tail = system.tail
    tail_terms = (0.0, 0.0) if tail is None else (tail.energy_volume, tail.pressure_square)
    x, y, z = map(float, system.model.keeps_momentum & system.keeps_momentum_in(k))
    given = Confinement(
        _thermal(stage), pressure, stage.compressibility / BAR, system.state.volume, float(mobile(system.model).sum()),
        (x, y, z), tail_terms, key,
    )  # fmt: skip
    return BAROSTATS[stage.barostat_kind](stage, given)


def _thermal(stage: Stage) -> Ramp:
    first, last = stage.temperatures
    return Ramp(BOLTZMANN * first, BOLTZMANN * last, float(stage.steps))
