"""Of the scene of molecules: a stretch of time under one ensemble and one step."""

from typing import Annotated, Any, Literal

from pydantic import Field, Strict, field_validator, model_validator

from rigidmd.core.schemes import AUTO, SCHEMES, WITH_BATH, Rotor, Scheme, auto_faults, rotor_fault
from rigidmd.validation import Number, Positive, Section

MOST_STEPS = 1e12

Ensemble = Literal["nve", "nvt", "npt", "nph"]
Thermostat = Literal["velocity_rescaling", "langevin", "nose_hoover", "andersen"]
Barostat = Literal["cell_rescaling", "monte_carlo"]
Coupling = Literal["isotropic", "semi_isotropic", "anisotropic", "flexible"]
Links = Annotated[int, Strict(), Field(ge=1, le=100)]
Six = tuple[float, float, float, float, float, float]

#: Time constants (ps) of the thermostats that have one.
THERMOSTAT_TIMES = {"velocity_rescaling": 0.1, "nose_hoover": 0.5, "andersen": 1.0}
FRICTION = 1.0  # 1/ps
BAROSTAT_TIME = 1.0  # ps
#: A move of the box comes every so many parts of barostat_time_ps.
MOVES_PER_TIME = 20
#: Of water at 298 K and 1 bar, 1/bar.
COMPRESSIBILITY = 4.5e-5

#: Ensembles, thermostats and barostats under which each key does something.
USED = {
    "temperature_K": {"nvt", "npt"},
    "thermostat": {"nvt", "npt"},
    "thermostat_time_ps": set(THERMOSTAT_TIMES),
    "friction_translation_per_ps": {"langevin"},
    "friction_rotation_per_ps": {"langevin"},
    "nose_hoover_links": {"nose_hoover"},
    "pressure_bar": {"npt", "nph"},
    "pressure_coupling": {"npt", "nph"},
    "barostat": {"npt"},
    "barostat_time_ps": {"cell_rescaling", "nph"},
    "barostat_interval_ps": {"npt"},
    "compressibility_per_bar": {"npt", "nph"},
}

#: What may be asked of the integrator and step that are left to a pilot.
ASKED = ("energy_error_kT", "trajectory_error", "bias_kT")

#: Names that users of other programs ask for, and what to say.
REFUSED = {
    "berendsen": "'berendsen' samples no ensemble: its fluctuations are too small and heat flows into the slowest "
    "motions",
    "parrinello_rahman": "Parrinello-Rahman is not here; cell_rescaling samples the same ensemble without its swings",
    "mttk": "MTTK is not here; cell_rescaling samples the same ensemble without its swings",
    "c_rescale": "C-rescale is called cell_rescaling here",
    "v_rescale": "V-rescale is called velocity_rescaling here",
}


class Stage(Section):
    """A stretch of time under one ensemble and one step."""

    name: str | None = None
    """What to call it; the ensemble's name when not given"""
    ensemble: Ensemble = "nve"
    """nve keeps energy and volume; nvt temperature and volume; npt temperature and pressure; nph enthalpy and
    pressure"""
    duration_ps: Positive
    """How long"""
    timestep_fs: Positive = 2.0
    """Time step"""
    temperature_K: Positive | tuple[Positive, Positive] | None = None
    """Temperature of the thermostat; two for one that changes evenly over the stage, [300, 240]"""
    thermostat: Thermostat | None = None
    """velocity_rescaling: the stochastic one of Bussi et al.; langevin: friction and noise; nose_hoover: one chain for
    translation and one for rotation; andersen: collisions. When not given: langevin with baoab, else
    velocity_rescaling"""
    thermostat_time_ps: Positive | None = None
    """Time constant: of velocity_rescaling (0.1 ps when not given), period of nose_hoover (0.5 ps), mean time between
    two collisions of a molecule with andersen (1 ps)"""
    friction_translation_per_ps: Positive | None = None
    """Of langevin, on translation; 1 when not given"""
    friction_rotation_per_ps: Positive | None = None
    """Of langevin, on rotation; that on translation when not given"""
    nose_hoover_links: Links = 3
    """Links of each Nose-Hoover chain"""
    pressure_bar: Number | tuple[Number, Number] | tuple[Number, Number, Number] | Six | None = None
    """Pressure of the barostat; two for one that changes evenly over the stage, [1, 1000]; three for that along each
    axis; six for the tensor xx, yy, zz, xy, xz, yz"""
    pressure_coupling: Coupling = "isotropic"
    """How the box changes: isotropic keeps its shape; semi_isotropic: x and y together, z apart; anisotropic: three
    edges; flexible: edges and angles"""
    barostat: Barostat | None = None
    """Of npt. cell_rescaling: stochastic cell rescaling, made exact by a Metropolis test, when not given; monte_carlo:
    random changes of the volume. nph has a piston without friction"""
    barostat_time_ps: Positive | None = None
    """Time constant of cell_rescaling, period of the piston of nph; 1 ps when not given"""
    barostat_interval_ps: Positive | None = None
    """Of npt, time between two moves of the box; 0.05 of barostat_time_ps when not given"""
    compressibility_per_bar: Positive | None = None
    """How the volume answers the pressure; sets speed, not what is sampled. That of water, 4.5e-5, when not given"""
    integrator: Literal[(*SCHEMES, *WITH_BATH, AUTO)] = "velocity_verlet"  # type: ignore[valid-type]
    """Scheme of kicks and drifts; baoab: with the thermostat in the middle of the drift, the one of langevin when not
    given; auto: the one, and its step, that keep the error asked for with the fewest forces"""
    energy_error_kT: Positive | None = None
    """With auto: rms error of the energy, in kT per degree of freedom"""
    trajectory_error: Positive | None = None
    """With auto: largest error of Q (of X in Å, of points) at the end of the pilot run, ten radians of libration"""
    bias_kT: Positive | None = None
    """With auto, of nvt: estimated bias of the average potential energy, in kT per degree of freedom"""
    rotor: Rotor | None = None
    """Free rotation by the split or the exact flow; the one that the integrator needs when not given"""

    @model_validator(mode="before")
    @classmethod
    def _goes_together(cls, data: Any):
        """Langevin and BAOAB each bring the other."""
        if isinstance(data, dict) and data.get("ensemble") in ("nvt", "npt"):
            if data.get("thermostat") == "langevin" and "integrator" not in data:
                return data | {"integrator": "baoab"}
            if data.get("integrator") == "baoab" and "thermostat" not in data:
                return data | {"thermostat": "langevin"}
        return data

    @field_validator("thermostat", "barostat", mode="before")
    @classmethod
    def _is_there(cls, name: Any):
        asked = name.lower().replace("-", "_") if isinstance(name, str) else ""
        if asked in REFUSED:
            raise ValueError(f"{REFUSED[asked]}. There are {', '.join((*Thermostat.__args__, *Barostat.__args__))}")
        return name

    @model_validator(mode="after")
    def _makes_sense(self):
        faults = []
        if self.has_thermostat and self.temperature_K is None:
            faults.append(f"an {self.ensemble} stage needs temperature_K")
        if self.has_barostat and self.pressure_bar is None:
            faults.append(f"an {self.ensemble} stage needs pressure_bar")
        if idle := [key for key, where in USED.items() if self._is_given(key) and not where & self._parts]:
            faults.append(f"{', '.join(idle)} would do nothing {self._where(idle)}")
        if self.integrator in WITH_BATH and not self.has_thermostat:
            faults.append(f"{self.integrator} has its place for a thermostat, and {self.ensemble} has none")
        if self.has_barostat:
            faults += self._pressure_faults()
        if fault := rotor_fault(self.integrator, self.rotor):
            faults.append(fault)
        decided = [
            key for key in ("timestep_fs", "rotor") if getattr(self, key) != type(self).model_fields[key].default
        ]
        asked = {key: getattr(self, key) for key in ASKED}
        faults += auto_faults(self.integrator, asked, decided)
        if self.bias_kT is not None and not self.has_thermostat:
            faults.append(f"bias_kT is of averages at a temperature, and {self.ensemble} has no thermostat")
        if not self.duration_ps * 1000 / self.timestep_fs < MOST_STEPS:
            faults.append(f"duration_ps / timestep_fs is more than {MOST_STEPS:g} steps")
        if self.duration_ps * 1000 < 0.5 * self.timestep_fs:
            faults.append(f"duration_ps = {self.duration_ps:g} is less than one step of {self.timestep_fs:g} fs")
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def _is_given(self, key: str) -> bool:
        return getattr(self, key) != type(self).model_fields[key].default

    @property
    def _parts(self) -> set[str]:
        """Its ensemble, thermostat and barostat."""
        return {self.ensemble, self.thermostat_kind, self.barostat_kind}

    def _where(self, idle: list[str]) -> str:
        """Where keys would do nothing."""
        known = [USED[key] for key in idle]
        of_ensemble = any(where <= {"nvt", "npt", "nph"} for where in known) or not self.has_thermostat
        if of_ensemble:
            return f"in an {self.ensemble} stage"
        kinds = [kind for kind in (self.thermostat_kind, self.barostat_kind) if kind]
        return f"with {' and '.join(kinds)}"

    def _pressure_faults(self) -> list[str]:
        faults, given, coupling = [], self.pressure_bar, self.pressure_coupling
        several = len(given) if isinstance(given, tuple) else 1
        if self.integrator == AUTO:
            faults.append("integrator = 'auto' chooses for a constant volume: name one for a stage with a pressure")
        apart = coupling == "semi_isotropic" and isinstance(given, tuple) and several == 3 and given[0] != given[1]
        if apart or (coupling == "isotropic" and several == 3):
            faults.append(f"pressure_bar: these three need pressure_coupling = 'anisotropic', not {coupling!r}")
        if several == 6 and coupling != "flexible":
            faults.append(f"pressure_bar: a tensor needs pressure_coupling = 'flexible', not {coupling!r}")
        if self.ensemble == "nph" and (coupling != "isotropic" or several > 2):
            faults.append("nph has an isotropic pressure only")
        if self.ensemble == "nph" and self.integrator in SCHEMES and SCHEMES[self.integrator].exact_rotor:
            plain = [name for name, scheme in SCHEMES.items() if not scheme.exact_rotor]
            faults.append(f"nph needs an integrator made of Verlet steps: {', '.join(plain)}")
        if self.barostat == "monte_carlo" and (coupling != "isotropic" or several > 2):
            faults.append("barostat = 'monte_carlo' has an isotropic pressure only; cell_rescaling has others")
        return faults

    @property
    def steps(self) -> int:
        """Number of steps: the duration in steps, rounded."""
        return round(self.duration_ps * 1000 / self.timestep_fs)

    @property
    def is_open(self) -> bool:
        """Whether integrator and step are still to be chosen."""
        return self.integrator == AUTO

    @property
    def leaves_thermostat(self) -> bool:
        """Whether the thermostat is chosen with the integrator: a bias is asked for, and nothing of a thermostat."""
        return self.bias_kT is not None and self.thermostat is None and self.thermostat_time_ps is None

    def decided(self, integrator: str, timestep_fs: float) -> "Stage":
        """This stage with what a pilot has chosen."""
        changes = {"integrator": integrator, "timestep_fs": timestep_fs}
        return self.model_copy(update=changes | dict.fromkeys(ASKED))

    @property
    def resolved(self) -> "Stage":
        """This stage with every number that it uses."""
        found: dict[str, Any] = {}
        if self.has_thermostat and not self.leaves_thermostat:
            found |= {"thermostat": self.thermostat_kind}
            if self.thermostat_kind == "langevin":
                translation, rotation = self.frictions
                found |= {"friction_translation_per_ps": translation, "friction_rotation_per_ps": rotation}
            else:
                found |= {"thermostat_time_ps": self.thermostat_time}
        if self.has_barostat:
            found |= {"compressibility_per_bar": self.compressibility}
            if self.barostat_kind:
                found |= {"barostat": self.barostat_kind, "barostat_interval_ps": self.barostat_interval}
            if self.barostat_kind != "monte_carlo":
                found |= {"barostat_time_ps": self.barostat_time}
        return self.model_copy(update=found)

    @property
    def scheme(self) -> Scheme:
        """The integrator with its rotor."""
        return (SCHEMES | WITH_BATH)[self.integrator].with_rotor(self.rotor)

    @property
    def label(self) -> str:
        """Its name, or its ensemble."""
        return self.name or self.ensemble

    @property
    def has_thermostat(self) -> bool:
        """Whether its temperature is kept."""
        return self.ensemble in ("nvt", "npt")

    @property
    def has_barostat(self) -> bool:
        """Whether its pressure is kept."""
        return self.ensemble in ("npt", "nph")

    @property
    def thermostat_kind(self) -> str:
        """Its thermostat; empty where it has none."""
        return (self.thermostat or "velocity_rescaling") if self.has_thermostat else ""

    @property
    def barostat_kind(self) -> str:
        """Its barostat; empty where it has none, and with nph, whose piston is the only one."""
        return (self.barostat or "cell_rescaling") if self.ensemble == "npt" else ""

    @property
    def temperatures(self) -> tuple[float, float]:
        """Temperature at its begin and its end, K; that of a stage with a thermostat."""
        both = self.temperature_K
        return both if isinstance(both, tuple) else (both or 0.0, both or 0.0)

    @property
    def thermostat_time(self) -> float:
        """Time constant of its thermostat, ps; of langevin the longer one."""
        if self.thermostat_kind == "langevin":
            return 1 / min(self.frictions)
        return self.thermostat_time_ps or THERMOSTAT_TIMES[self.thermostat_kind]

    @property
    def frictions(self) -> tuple[float, float]:
        """On translation and rotation, 1/ps."""
        translation = self.friction_translation_per_ps or FRICTION
        return translation, self.friction_rotation_per_ps or translation

    @property
    def pressures(self) -> tuple[Six, Six]:
        """At its begin and its end, bar: xx, yy, zz, xy, xz, yz."""
        given = self.pressure_bar
        ends = given if isinstance(given, tuple) and len(given) == 2 else (given, given)
        return _tensor(ends[0]), _tensor(ends[1])

    @property
    def barostat_time(self) -> float:
        """ps"""
        return self.barostat_time_ps or BAROSTAT_TIME

    @property
    def barostat_interval(self) -> float:
        """Time between two moves of the box, ps."""
        return self.barostat_interval_ps or self.barostat_time / MOVES_PER_TIME

    @property
    def compressibility(self) -> float:
        """1/bar"""
        return self.compressibility_per_bar or COMPRESSIBILITY

    @property
    def keeps_momentum(self) -> bool:
        """Whether its thermostat leaves the total momentum as it is."""
        return self.thermostat_kind not in ("langevin", "andersen")


def _tensor(given: Any) -> Six:
    """A pressure, three or six of them, as a tensor."""
    values = given if isinstance(given, tuple) else (given,) * 3
    return (*values, 0.0, 0.0, 0.0) if len(values) == 3 else values
