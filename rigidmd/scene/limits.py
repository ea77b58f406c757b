"""The table [watch]: limits beyond which a run stops."""

from typing import Literal

from rigidmd.scene.validation import Flag, Positive, Section

Limit = Positive | Literal[False]


class Watch(Section):
    """Limits beyond which a run stops, relative to scales of the system; false switches a check off."""

    move: Limit = 0.25
    """Largest displacement of a molecule between two evaluations of its forces, in units of the smallest site
    diameter"""
    turn_rad: Limit = 2.0
    """Largest rotation of a molecule between two evaluations of its forces"""
    kick: Limit = 20.0
    """Largest change of a momentum by one kick, in units of the thermal momentum"""
    energy: Limit = 0.5
    """Largest change of the conserved energy, in units of the kinetic energy: in an nve stage, and within each
    thermostat_time_ps of an nvt stage"""
    volume: Limit = 8.0
    """Largest volume of the box under a barostat, in units of the volume at the start"""
    orthogonality: Limit = 1e-9
    """Largest entry of abs(QᵀQ - 1)"""
    stable_step: Flag = True
    """Estimate the longest stable time step at the start of each stage, and warn if timestep_fs is longer"""


class BodyWatch(Section):
    """Limits beyond which a run of a single body stops; false switches a check off."""

    energy: Limit = 1.0
    """Largest change of the energy less the work done, in units of the largest energy exchanged so far: the kinetic
    energy at the start and changes of potential energy and work"""
    orthogonality: Limit | None = None
    """Largest entry of abs(QᵀQ - 1); default: 1e-9, or 0.1 with rk4, dop853 and radau, which do not preserve it"""
    turn_rad: Limit = False
    """Largest rotation of the body in a step"""
    stable_step: Flag = True
    """Estimate the longest stable step from the body's spin and swing, and warn if timestep_s is longer"""
