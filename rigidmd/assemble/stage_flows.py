"""The integrator of a stage: its scheme with the flows of the thermostat and the barostat."""

from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import Scheme
from rigidmd.dynamics.barostats import COUPLINGS, CellRescaling, Pressure, VolumeMoves, piston
from rigidmd.dynamics.momenta import mobile
from rigidmd.dynamics.noise import BAROSTAT, THERMOSTAT, key_of
from rigidmd.dynamics.thermostats import Andersen, Langevin, NoseHoover, Ramp, VelocityRescaling, constant_ramp
from rigidmd.engines.system import System
from rigidmd.scene.stage import Six, Stage
from rigidmd.units import BAR, BOLTZMANN, FEMTOSECOND

#: Largest change of the volume in a Monte Carlo move, in standard deviations of its fluctuations.
WIDTH = 2.0


def integrator_of_stage(system: System, k: int) -> Scheme:
    """The scheme of stage k, with its thermostat, its barostat and the removal of total momentum."""
    scene, stage = system.scene, system.scene.stages[k]
    found = stage.scheme
    if (user := system.thermostat) is not None:
        thermostat = user.for_stage(system, k) if hasattr(user, "for_stage") else user
        found = found.with_thermostat(thermostat, halved=getattr(thermostat, "halved", True))
    elif stage.has_thermostat:
        found = found.with_thermostat(thermostat_of(system, k), halved=stage.thermostat_kind != "velocity_rescaling")
    elif not stage.has_barostat and any(other.thermostat_kind == "velocity_rescaling" for other in scene.stages):
        # An idle thermostat, so that all stages run the same machine code.
        idle = VelocityRescaling(constant_ramp(0.0), inf, system.freedom.total, key_of(scene.seed, THERMOSTAT, k))
        found = found.with_thermostat(idle)
    if stage.ensemble == "npt":
        found = found.with_barostat(barostat_of(system, k), stage.moves_every)
    elif stage.ensemble == "nph":
        found = found.with_piston(barostat_of(system, k))
    if system.keeps_momentum_in(k) and (interval := system.removes_momentum_every) is not None:
        found = found.with_momentum_removal(max(1, round(interval / (stage.timestep_fs * FEMTOSECOND))))
    return found


def thermostat_of(system: System, k: int) -> NamedTuple:
    stage, freedom = system.scene.stages[k], system.freedom_in(k)
    thermal, key = _thermal(stage), key_of(system.scene.seed, THERMOSTAT, k)
    match stage.thermostat_kind:
        case "langevin":
            return Langevin(thermal, *stage.frictions, key)
        case "andersen":
            return Andersen(thermal, stage.thermostat_time, key)
        case "nose_hoover":
            links = stage.nose_hoover_links
            return NoseHoover(thermal, stage.thermostat_time, links, freedom.translation, freedom.rotation)
    return VelocityRescaling(thermal, stage.thermostat_time, freedom.total, key)


def barostat_of(system: System, k: int) -> NamedTuple:
    stage, key = system.scene.stages[k], key_of(system.scene.seed, BAROSTAT, k)
    # the scene lists xy, xz, yz: components (1, 0), (2, 0), (2, 1) of the lower triangle
    first, last = stage.pressures
    pressure = Pressure(_scaled(first, BAR), _scaled(last, BAR), float(stage.steps))
    tail = system.tail
    tail_terms = (0.0, 0.0) if tail is None else (tail.energy_volume, tail.pressure_square)
    compressibility, volume = stage.compressibility / BAR, system.state.volume
    if stage.ensemble == "nph":
        return piston(pressure, stage.barostat_time, compressibility, volume, tail_terms)
    if stage.barostat_kind == "monte_carlo":
        spread = np.sqrt(BOLTZMANN * max(stage.temperatures) * compressibility * volume)
        return VolumeMoves(
            _thermal(stage), pressure, float(WIDTH * spread), float(mobile(system.model).sum()), tail_terms, key
        )
    x, y, z = map(float, system.model.keeps_momentum & system.keeps_momentum_in(k))
    rate = compressibility / stage.barostat_time
    return CellRescaling(
        _thermal(stage), pressure, rate, COUPLINGS[stage.pressure_coupling], (x, y, z), tail_terms, key
    )


def _scaled(tensor: Six, factor: float) -> Six:
    xx, yy, zz, xy, xz, yz = tensor
    return xx * factor, yy * factor, zz * factor, xy * factor, xz * factor, yz * factor


def _thermal(stage: Stage) -> Ramp:
    first, last = stage.temperatures
    return Ramp(BOLTZMANN * first, BOLTZMANN * last, float(stage.steps))
