"""The tables [[stages]] of a scene of molecules: each has one ensemble and one time step, or is a
minimisation."""

from math import pi
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from rigidmd.core.integrators import AUTO, SCHEMES, SOLVERS, WITH_THERMOSTAT, Rotor, auto_errors
from rigidmd.scene.ensemble_methods import (
    BAROSTAT_TIME,
    NO_BAROSTAT,
    NO_THERMOSTAT,
    Barostat,
    EnsembleMethod,
    Thermostat,
    Values,
)
from rigidmd.scene.ensembles import (
    BAROSTATS,
    COMPRESSIBILITY,
    DEFAULT_THERMOSTAT,
    THERMOSTATS,
    BarostatKeys,
    Six,
    ThermostatKeys,
    in_lines,
)
from rigidmd.scene.integrators import VERLET_ELSEWHERE, MovedByScheme, advise_on_integrator
from rigidmd.scene.validation import (
    MOST_STEPS,
    Count,
    NameIn,
    Positive,
    Section,
    ShortName,
    TrajectoryError,
    not_none,
    number_of_steps,
)
from rigidmd.units import FEMTOSECOND

Ensemble = Literal["nve", "nvt", "npt", "nph", "minimise"]

#: Ensembles of stages that are not minimisations.
MOVING = {"nve", "nvt", "npt", "nph"}
#: Stands in USED for a minimisation in which the cell relaxes.
CELL = "minimise with a cell"
#: Key -> the ensembles that use it; keys of thermostats and barostats are in their tables.
USED = {
    **dict.fromkeys(("duration_ps", "timestep_fs", "integrator", "rotor"), MOVING),
    **{
        key: {"minimise"}
        for key in ("force_limit_kJ_mol_A", "torque_limit_kJ_mol", "max_iterations")
    },
    **{key: {"npt", "nph"} for key in ("barostat", "compressibility_per_bar")},
    **{key: {"nvt", "npt"} for key in ("temperature_K", "thermostat")},
    "volume": {"nve", "nvt"},
    "pressure_bar": {"npt", "nph", "minimise"},
    "pressure_coupling": {"npt", "nph", CELL},
    "pressure_limit_bar": {CELL},
}

#: Keys of errors for which integrator = "auto" chooses the integrator and the step.
ERROR_TARGETS = ("energy_error_kT", "trajectory_error", "bias_kT")

#: Names of methods in other programs -> advice.
REFUSED = {
    "berendsen": (
        "'berendsen' samples no ensemble: its fluctuations are too small and heat flows into the"
        " slowest motions"
    ),
    "parrinello_rahman": (
        "Parrinello-Rahman is not available. cell_rescaling samples the same ensemble"
    ),
    "mttk": "MTTK is not available. cell_rescaling samples the same ensemble",
    "c_rescale": "C-rescale is called cell_rescaling in rigidmd",
    "v_rescale": "V-rescale is called velocity_rescaling in rigidmd",
}
#: Integrators of single bodies and of other programs -> advice.
OTHER_INTEGRATORS = {
    **dict.fromkeys(SOLVERS, "general ODE solvers are for single bodies"),
    **VERLET_ELSEWHERE,
    **dict.fromkeys(
        ("sd", "bd", "langevin"), "write ensemble = 'nvt' with thermostat = 'langevin'"
    ),
    **dict.fromkeys(("steep", "cg", "l_bfgs", "lbfgs"), "write ensemble = 'minimise'"),
}


#: Step with which pilot runs start, and the default for molecules without a known fast motion, fs.
USUAL_STEP = 2.0


#: Thermostats whose averages have no time-step error, in the description of `integrator`.
_EXCEPTIONS = "".join(
    f", except with {name}, which corrects it"
    for name, kind in THERMOSTATS.items()
    if kind.in_trajectories
)


class Timing(Section):
    """The first keys of a stage."""

    name: ShortName | None = None
    """Name of the stage. Default: the name of the ensemble"""
    ensemble: Ensemble = "nve"
    """What is constant. nve: energy and volume. nvt: temperature and volume. npt: temperature and
    pressure. nph: enthalpy and pressure. minimise: no time passes. Molecules move and rotate to a
    minimum of the potential energy. If pressure_bar is set, molecules and cell relax to a minimum
    of the enthalpy"""
    duration_ps: Positive | None = Field(default=None, validate_default=True)
    """Duration. Required except with minimise"""
    timestep_fs: Positive | None = None
    """Time step. Default: one of 1, 2, 2.5, 4, 5, 10 fs and their tenths, from the fastest motion
    of the molecules and the temperature. With baoab it is the longest whose bias of U stays below
    0.005 kT per degree of freedom, 4 fs for water at 300 K. At constant energy it is half as long.
    `rigidmd check` prints it"""
    temperature_K: Positive | tuple[Positive, Positive] | None = None
    """Temperature of the thermostat. Use two values for a linear change over the stage, [300,
    240]"""
    volume: Literal["mean"] | None = None
    """mean: at the start of an nve or nvt stage the box is scaled to its mean over the equilibrated
    part of the npt or nph stage just before. Default: the box at the end of that stage"""


class Stage(MovedByScheme, BarostatKeys, ThermostatKeys, Timing):
    """A part of a run with one ensemble and one time step."""

    integrator: Annotated[str, NameIn((*SCHEMES, *WITH_THERMOSTAT, AUTO), in_scene=True)] = Field(
        default="velocity_verlet",
        description=in_lines(
            "Scheme of kicks and drifts. baoab: the thermostat acts in the middle of the drift."
            " auto: the scheme and step that keep the requested error with the fewest force"
            " evaluations. Default: baoab with nvt and npt, whose averages have almost no time-step"
            f" error{_EXCEPTIONS}, else velocity_verlet"
        ),
    )
    energy_error_kT: Positive | None = None
    """With auto: rms error of the energy over the whole stage, in kT per degree of freedom, as
    predicted by pilot runs"""
    trajectory_error: TrajectoryError | None = None
    """With auto: largest error of Q at the end of the pilot run of ten radians of libration. For
    points it is the error of X in Å"""
    bias_kT: Positive | None = None
    """With auto in nvt: estimated bias of the average potential energy, in kT per degree of
    freedom"""
    rotor: Rotor | None = None
    """Free rotation by the split or the exact flow. Default: the flow that the integrator needs"""
    force_limit_kJ_mol_A: Positive = 0.1
    """With minimise: largest force on a molecule at convergence. Forces in a liquid are of the
    order of 10 kJ/mol/Å, and force constants between 1 (argon) and 100 kJ/mol/Å² (hydrogen bonds):
    with 0.1 positions are good to 0.1 and 0.001 Å and energies to 0.005 kJ/mol per molecule, 0.002
    kT at 300 K"""
    torque_limit_kJ_mol: Positive = 0.1
    """With minimise: largest torque on a molecule about a principal axis at convergence. For a
    molecule with a radius of 1 Å it is as strict as the default force limit"""
    pressure_limit_bar: Positive = 1.0
    """With minimise and pressure_bar: largest deviation of the pressure at convergence. With the
    compressibility of water, 1 bar changes the volume by 5e-5"""
    max_iterations: Count = 5000
    """With minimise: maximum number of iterations. The minimisation then stops with a warning"""

    @model_validator(mode="before")
    @classmethod
    def _middle_thermostat(cls, data: object):
        """Set baoab as the default with a thermostat that acts in the middle of a step."""
        if not isinstance(data, dict) or "integrator" in data:
            return data
        kind = THERMOSTATS.get(str(data.get("thermostat") or DEFAULT_THERMOSTAT))
        if data.get("ensemble") in ("nvt", "npt") and kind and not kind.in_trajectories:
            return data | {"integrator": "baoab"}
        return data

    @field_validator("thermostat", "barostat", mode="before")
    @classmethod
    def _is_available(cls, name: object, field: ValidationInfo):
        plain = name.lower().replace("-", "_") if isinstance(name, str) else ""
        if plain in REFUSED:
            known = THERMOSTATS if field.field_name == "thermostat" else BAROSTATS
            raise ValueError(f"{REFUSED[plain]}. The {field.field_name}s are {', '.join(known)}")
        return name

    @field_validator("integrator", mode="before")
    @classmethod
    def _moves_molecules(cls, name: object, info: ValidationInfo):
        known = (*SCHEMES, *WITH_THERMOSTAT, AUTO)
        return advise_on_integrator(name, OTHER_INTEGRATORS, known, info.context)

    @field_validator("duration_ps")
    @classmethod
    def _has_duration(cls, duration: float | None, others: ValidationInfo):
        if duration is None and others.data.get("ensemble") != "minimise":
            raise ValueError("is missing")
        return duration

    def _errors(self):
        if self.has_thermostat and self.temperature_K is None:
            yield f"an {self.ensemble} stage needs temperature_K, for example temperature_K = 300"
        if self.has_barostat and self.pressure_bar is None:
            yield f"an {self.ensemble} stage needs pressure_bar, for example pressure_bar = 1"
        if idle := [key for key in self.idle_keys if self._is_given(key)]:
            where = self._where([self._users(key) for key in idle])
            yield f"{', '.join(idle)} would have no effect {where}"
        if (
            self.integrator in WITH_THERMOSTAT
            and not self.has_thermostat
            and not self.is_minimisation
        ):
            yield f"{self.integrator} contains a thermostat, but {self.ensemble} has none"
        if self.integrator in WITH_THERMOSTAT and self.in_trajectories:
            yield (
                f"{self.integrator} contains a thermostat of its own: name another one for"
                f" {self.thermostat_kind}"
            )
        if self.changes_box:
            yield from self._pressure_errors()
        if self.has_barostat:
            yield from self._barostat_errors()
        yield from self._rotor_errors()
        yield from self._coupling_errors()
        targets = {key: getattr(self, key) for key in ERROR_TARGETS}
        step_keys = [key for key in ("timestep_fs", "rotor") if self._is_given(key)]
        if self.in_trajectories and self.is_auto:
            if set_keys := [key for key, target in targets.items() if target is not None]:
                kind = self.thermostat_kind
                yield (
                    f"{', '.join(set_keys)} would have no effect: averages of {kind} have no"
                    " time-step error"
                )
        else:
            yield from auto_errors(self.integrator, targets, step_keys)
        if self.bias_kT is not None and not self.has_thermostat:
            yield f"bias_kT is for averages at a temperature, and {self.ensemble} has no thermostat"
        if not self.duration / self.step < MOST_STEPS:
            yield f"duration_ps / timestep_fs is more than {MOST_STEPS:g} steps"
        elif not self.steps_together < MOST_STEPS:
            yield (
                f"a trajectory of {self.thermostat_kind} is more than {MOST_STEPS:g} steps: set"
                f" {self.thermostat_method.steps_key} or a longer timestep_fs"
            )
        if self.duration < 0.5 * self.step and not self.is_minimisation:
            yield (
                f"duration_ps = {self.duration_ps:g} is less than one step of {self.step_fs:g} fs"
            )

    @property
    def idle_keys(self) -> list[str]:
        """The keys that have no effect in this stage."""
        parts = {self.ensemble, self.thermostat_kind, self.barostat_kind}
        parts |= {CELL} if self.is_minimisation and self.changes_box else set()
        return [
            key
            for key in type(self).model_fields
            if (users := self._users(key)) and users.isdisjoint(parts)
        ]

    def _users(self, key: str) -> set[str]:
        """The ensembles, thermostats and barostats that use a key. None for the keys of every
        stage."""
        methods = [*THERMOSTATS.values(), *BAROSTATS.values()]
        return USED.get(key, set()) | {
            method.name for method in methods if key in method.defaults(self)
        }

    def _is_given(self, key: str) -> bool:
        return getattr(self, key) != type(self).model_fields[key].default

    def _where(self, users: list[set[str]]) -> str:
        """The settings with which keys of these users would have no effect, for the message."""
        if self.is_minimisation:
            return "in a minimise stage" + (
                " without pressure_bar" if all(CELL in names for names in users) else ""
            )
        kinds: dict[str, EnsembleMethod] = {**THERMOSTATS, **BAROSTATS}
        for names in users:
            if not any(
                self.ensemble in (kinds[name].ensembles if name in kinds else (name,))
                for name in names
            ):
                return f"in an {self.ensemble} stage"
        concerned = set().union(*users)  # a key of the barostat does not depend on the thermostat
        parts = ((self.thermostat_kind, THERMOSTATS), (self.barostat_kind, BAROSTATS))
        return (
            f"with {' and '.join(kind for kind, among in parts if kind and concerned & set(among))}"
        )

    def _pressure_errors(self):
        pressure, coupling = self.pressure_bar, self.pressure_coupling
        several = len(pressure) if isinstance(pressure, tuple) else 1
        if self.is_minimisation and several == 2:
            yield "pressure_bar: a minimum has one pressure, not one that changes"
        if self.integrator == AUTO:
            yield (
                "integrator = 'auto' is for constant volume: name an integrator for a stage with a"
                " pressure"
            )
        unequal = (
            coupling == "semi_isotropic"
            and isinstance(pressure, tuple)
            and several == 3
            and pressure[0] != pressure[1]
        )
        if unequal or (coupling == "isotropic" and several == 3):
            yield (
                "pressure_bar: these three need pressure_coupling = 'anisotropic', not"
                f" {coupling!r}"
            )
        if several in (3, 6) and coupling in ("normal", "lateral"):
            yield f"pressure_bar: pressure_coupling = {coupling!r} has one pressure"
        elif several == 6 and coupling != "flexible":
            yield f"pressure_bar: a tensor needs pressure_coupling = 'flexible', not {coupling!r}"

    def _barostat_errors(self):
        name = self.barostat_kind
        kind = self.barostat_method
        others = [
            other
            for other in BAROSTATS
            if self.ensemble in BAROSTATS[other].ensembles and other != name
        ]
        if self.ensemble not in kind.ensembles:
            yield (
                f"barostat = {name!r} is for {' and '.join(kind.ensembles)}; {self.ensemble} has"
                f" {', '.join(others)}"
            )
            return
        several = isinstance(self.pressure_bar, tuple) and len(self.pressure_bar) > 2
        if self.pressure_coupling not in kind.shapes or (several and kind.shapes == ("isotropic",)):
            allowed = " or ".join(coupling.replace("_", "-") for coupling in kind.shapes)
            subject = f"barostat = {name!r}" if self.barostat else self.ensemble
            better = [other for other in others if len(BAROSTATS[other].shapes) > len(kind.shapes)]
            advice = f"; {better[0]} allows others" if better else ""
            yield f"{subject} allows only an {allowed} pressure{advice}"
        if kind.in_verlet_steps and self.has_scheme and self.row.exact_rotor:
            plain = [name for name, scheme in SCHEMES.items() if not scheme.exact_rotor]
            yield f"{self.ensemble} needs an integrator made of Verlet steps: {', '.join(plain)}"

    def _coupling_errors(self):
        """Messages on time constants that are too short for the steps of the stage."""
        if self.is_auto or self.is_minimisation:
            return
        step = self.step
        least = pi * step
        barostat = self.barostat_method
        if self.thermostat_method.oscillates and self.thermostat_time < least:
            yield (
                f"thermostat_time_ps = {self.thermostat_time:g} is a period shorter than pi steps,"
                f" {least:.3g} ps"
            )
        if barostat.oscillates and self.barostat_time < least:
            yield (
                f"barostat_time_ps = {self.barostat_time:g} is a period shorter than pi steps,"
                f" {least:.3g} ps"
            )
        moves = self.moves_every * step if barostat.relaxes_in_moves else 0.0
        if self.barostat_time < moves:
            yield (
                f"barostat_time_ps = {self.barostat_time:g} is shorter than the {moves:g} ps"
                " between moves of the box"
            )

    @property
    def step_fs(self) -> float:
        """Time step, fs. The usual one until `assemble.time_step` or a pilot run has set it."""
        return self.timestep_fs or USUAL_STEP

    @property
    def step(self) -> float:
        """Time step, ps."""
        return self.step_fs * FEMTOSECOND

    @property
    def steps(self) -> int:
        return self.steps_of(self.duration) if self.duration else 0

    def steps_of(self, interval: float) -> int:
        """The nearest number of steps to an interval (ps), at least one step or trajectory, see
        `number_of_steps`."""
        return number_of_steps(interval, self.step, self.steps_together)

    @property
    def steps_together(self) -> int:
        """Steps that are accepted or rejected together, between which nothing is observed, else
        1."""
        if not self.in_trajectories:
            return 1
        return self.thermostat_method.steps_together(self.thermostat_values)

    @property
    def in_trajectories(self) -> bool:
        """Whether steps are accepted or rejected together, so that averages have no time-step
        error."""
        return self.thermostat_method.in_trajectories

    @property
    def duration(self) -> float:
        """Duration, ps, 0 for a minimisation."""
        return self.duration_ps or 0.0

    @property
    def is_minimisation(self) -> bool:
        return self.ensemble == "minimise"

    def with_integrator(self, integrator: str, timestep_fs: float) -> "Stage":
        """This stage with the integrator and step that pilot runs have chosen."""
        changes = {"integrator": integrator, "timestep_fs": timestep_fs}
        return self.model_copy(update=changes | dict.fromkeys(ERROR_TARGETS))

    @property
    def with_defaults(self) -> "Stage":
        """This stage with the defaults of all keys that it uses."""
        defaults: dict[str, object] = {}
        if self.has_thermostat:
            defaults |= {"thermostat": self.thermostat_kind} | self.thermostat_values
        if self.has_barostat:
            named = {"barostat": self.barostat_kind} if self.ensemble == "npt" else {}
            defaults |= (
                named | {"compressibility_per_bar": self.compressibility} | self.barostat_values
            )
        return self.model_copy(update=defaults)

    @property
    def label(self) -> str:
        return self.name or self.ensemble

    @property
    def has_thermostat(self) -> bool:
        return self.ensemble in ("nvt", "npt")

    @property
    def has_barostat(self) -> bool:
        return self.ensemble in ("npt", "nph")

    @property
    def changes_box(self) -> bool:
        """Whether the cell changes: by a barostat, or in a minimisation with pressure_bar."""
        return self.has_barostat or (self.is_minimisation and self.pressure_bar is not None)

    @property
    def thermostat_kind(self) -> str:
        """The thermostat, or an empty text."""
        return (self.thermostat or DEFAULT_THERMOSTAT) if self.has_thermostat else ""

    @property
    def barostat_kind(self) -> str:
        """The barostat, or an empty text."""
        defaults = [
            name
            for name, kind in BAROSTATS.items()
            if kind.is_default and self.ensemble in kind.ensembles
        ]
        return (self.barostat or defaults[0]) if defaults else ""

    @property
    def thermostat_method(self) -> Thermostat:
        """The thermostat. Without one, it has no keys and no effect."""
        return THERMOSTATS[self.thermostat_kind] if self.has_thermostat else NO_THERMOSTAT

    @property
    def barostat_method(self) -> Barostat:
        """The barostat. Without one, it has no keys and no effect."""
        return BAROSTATS[self.barostat_kind] if self.has_barostat else NO_BAROSTAT

    @property
    def thermostat_values(self) -> Values:
        """The keys of the thermostat with their values."""
        return self.thermostat_method.values(self)

    @property
    def barostat_values(self) -> Values:
        """The keys of the barostat with their values."""
        return self.barostat_method.values(self)

    @property
    def temperatures(self) -> tuple[float, float]:
        """Temperature of the thermostat at start and end, K."""
        temperature = self.temperature_K
        if isinstance(temperature, tuple):
            return temperature
        return temperature or 0.0, temperature or 0.0

    @property
    def thermostat_time(self) -> float:
        """Time constant of the thermostat, ps. The longer one of langevin."""
        return self.thermostat_method.time(self.thermostat_values)

    @property
    def pressures(self) -> tuple[Six, Six]:
        """Pressure at start and end, bar: xx, yy, zz, xy, xz, yz."""
        pressure = not_none(self.pressure_bar)
        first, last = (
            pressure if isinstance(pressure, tuple) and len(pressure) == 2 else (pressure, pressure)
        )
        return _tensor(first), _tensor(last)

    @property
    def ramps(self) -> bool:
        """Whether temperature or pressure changes over the duration."""
        first, last = self.temperatures
        begin, end = self.pressures if self.changes_box else ((), ())
        return first != last or begin != end

    @property
    def barostat_time(self) -> float:
        return self.barostat_time_ps or BAROSTAT_TIME

    @property
    def moves_every(self) -> int:
        """Steps between two moves of the box."""
        return self.steps_of(self.barostat_values["barostat_interval_ps"])

    @property
    def compressibility(self) -> float:
        return self.compressibility_per_bar or COMPRESSIBILITY

    @property
    def keeps_momentum(self) -> bool:
        """Whether the thermostat conserves the total momentum."""
        return not self.thermostat_method.on_molecules


def _tensor(pressure: float | tuple[float, float, float] | Six) -> Six:
    """One, three or six pressures as a tensor."""
    if not isinstance(pressure, tuple):
        return pressure, pressure, pressure, 0.0, 0.0, 0.0
    return pressure if len(pressure) == 6 else (*pressure, 0.0, 0.0, 0.0)
