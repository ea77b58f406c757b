"""Of the scene of molecules: a stretch of time under one ensemble and one step."""

from typing import Any, Literal

from pydantic import field_validator, model_validator

from rigidmd.core.schemes import AUTO, SCHEMES, Rotor, Scheme, auto_faults, rotor_fault
from rigidmd.validation import Positive, Section

MOST_STEPS = 1e12


class Stage(Section):
    """A stretch of time under one ensemble and one step."""

    name: str | None = None
    """What to call it; the ensemble's name when not given"""
    ensemble: Literal["nve", "nvt"] = "nve"
    """nve keeps the energy, nvt the temperature"""
    duration_ps: Positive
    """How long"""
    timestep_fs: Positive = 2.0
    """Time step"""
    temperature_K: Positive | None = None
    """Temperature of the thermostat"""
    thermostat: Literal["velocity_rescaling"] = "velocity_rescaling"
    """velocity_rescaling is the stochastic one of Bussi et al."""
    thermostat_time_ps: Positive = 0.1
    """Time constant of the thermostat"""
    integrator: Literal[(*SCHEMES, AUTO)] = "velocity_verlet"  # type: ignore[valid-type]
    """Scheme of kicks and drifts; auto: the one, and its step, that keep the error asked for with the fewest forces"""
    energy_error_kT: Positive | None = None
    """With auto: rms error of the energy, in kT per degree of freedom"""
    trajectory_error: Positive | None = None
    """With auto: largest error of Q (of X in Å, of points) at the end of the pilot run, ten radians of libration"""
    rotor: Rotor | None = None
    """Free rotation by the split or the exact flow; the one that the integrator needs when not given"""

    @field_validator("ensemble", mode="before")
    @classmethod
    def _is_there(cls, ensemble: Any):
        if isinstance(ensemble, str) and ensemble.lower() in ("npt", "nph"):
            raise ValueError(f"is {ensemble!r}, must be 'nve' or 'nvt': there is no pressure coupling yet")
        return ensemble

    @model_validator(mode="after")
    def _makes_sense(self):
        if self.ensemble == "nvt" and self.temperature_K is None:
            raise ValueError("an nvt stage needs temperature_K")
        if self.ensemble == "nve":
            fields = type(self).model_fields
            thermal = ("temperature_K", "thermostat", "thermostat_time_ps")
            if idle := [key for key in thermal if getattr(self, key) != fields[key].default]:
                raise ValueError(f"{', '.join(idle)} would do nothing in an nve stage")
        if fault := rotor_fault(self.integrator, self.rotor):
            raise ValueError(fault)
        decided = [
            key for key in ("timestep_fs", "rotor") if getattr(self, key) != type(self).model_fields[key].default
        ]
        asked = {"energy_error_kT": self.energy_error_kT, "trajectory_error": self.trajectory_error}
        if faults := auto_faults(self.integrator, asked, decided):
            raise ValueError("; ".join(faults))
        if not self.duration_ps * 1000 / self.timestep_fs < MOST_STEPS:
            raise ValueError(f"duration_ps / timestep_fs is more than {MOST_STEPS:g} steps")
        if self.duration_ps * 1000 < 0.5 * self.timestep_fs:
            raise ValueError(f"duration_ps = {self.duration_ps:g} is less than one step of {self.timestep_fs:g} fs")
        return self

    @property
    def steps(self) -> int:
        """Number of steps: the duration in steps, rounded."""
        return round(self.duration_ps * 1000 / self.timestep_fs)

    @property
    def is_open(self) -> bool:
        """Whether integrator and step are still to be chosen."""
        return self.integrator == AUTO

    def decided(self, integrator: str, timestep_fs: float) -> "Stage":
        """This stage with what a pilot has chosen."""
        none = {"energy_error_kT": None, "trajectory_error": None}
        return self.model_copy(update={"integrator": integrator, "timestep_fs": timestep_fs} | none)

    @property
    def scheme(self) -> Scheme:
        """The integrator with its rotor."""
        return SCHEMES[self.integrator].with_rotor(self.rotor)

    @property
    def label(self) -> str:
        """Its name, or its ensemble."""
        return self.name or self.ensemble
