"""The table [watch]: when a run stops because its numbers no longer mean what the scene says."""

from typing import Literal

from rigidmd.validation import Flag, Positive, Section

Limit = Positive | Literal[False]


class Watch(Section):
    """Limits beyond which a run stops. Each is relative to the scene's own scales; false looks away."""

    move: Limit = 0.25
    """Most that a molecule may move from one evaluation of its forces to the next, in smallest diameters of sites"""
    turn_rad: Limit = 2.0
    """Most that a molecule may turn from one evaluation of its forces to the next"""
    kick: Limit = 20.0
    """Most that one kick may change a momentum by, in thermal momenta"""
    energy: Limit = 0.5
    """Most that the conserved energy may change by, in kinetic energies: in an nve stage, and within each
    thermostat_time_ps of an nvt stage"""
    volume: Limit = 8.0
    """Most that a box may grow to under a barostat, in volumes of the start"""
    orthogonality: Limit = 1e-9
    """Largest entry of abs(QᵀQ - 1)"""
    stable_step: Flag = True
    """Estimate at the start of each stage the longest step that is stable, and warn of a longer one"""


class BodyWatch(Section):
    """Limits beyond which a run of a single body stops; false looks away."""

    energy: Limit = 1.0
    """Most that the energy less the work done may change by, in the largest energy that has moved so far: kinetic at
    the start, and what potential and work have given"""
    orthogonality: Limit | None = None
    """Largest entry of abs(QᵀQ - 1); 1e-9 when not given, and 0.1 with rk4, dop853 and radau, which do not keep it"""
    turn_rad: Limit = False
    """Most that the body may turn in a step"""
    stable_step: Flag = True
    """Estimate the longest step that is stable from the body's spin and swing, and warn of a longer one"""
