"""Thermostats and barostats as scenes and reports know them: the base classes of the files in
`scene.thermostats` and `scene.barostats`, which import no compiler."""

import re
from typing import Literal, Protocol, get_args

from rigidmd.core.integrators import Scheme
from rigidmd.core.quantities import Quantity
from rigidmd.scene.validation import Section

Values = dict[str, float]  # of keys
Shapes = Literal["isotropic", "semi_isotropic", "anisotropic", "flexible", "normal", "lateral"]

BAROSTAT_TIME = 1.0  # ps
#: Moves of the box per barostat_time_ps.
MOVES_PER_TIME = 20


class StageKeys(Protocol):
    """What thermostats and barostats read of a stage."""

    @property
    def step(self) -> float: ...  # ps

    @property
    def steps_together(self) -> int: ...

    @property
    def moves_every(self) -> int: ...

    @property
    def barostat_time_ps(self) -> float | None: ...


def default_interval(stage: StageKeys) -> float:
    """Time between two moves of the box, ps."""
    return (stage.barostat_time_ps or BAROSTAT_TIME) / MOVES_PER_TIME


class EnsembleMethod:
    """A thermostat or a barostat."""

    name: str  # of its files, and in scenes
    summary: str  # for the description of the key `thermostat` or `barostat`
    source: str  # authors, year, journal
    #: The keys that no other one has. Common ones are in `scene.ensembles`.
    keys: type[Section] | None = None
    #: What the key thermostat_time_ps or barostat_time_ps is, if it uses it.
    time_is: str = ""
    ensembles: tuple[str, ...] = ("nvt", "npt")
    is_default: bool = False  # in its ensembles
    #: Whether its time constant is the period of an oscillation, which steps have to resolve.
    oscillates: bool = False

    def defaults(self, stage: StageKeys) -> Values:
        """The keys that it uses, with their defaults in a stage."""
        return {}

    def values(self, stage: StageKeys) -> Values:
        """The keys that it uses, with their values in a stage."""
        return {
            key: getattr(stage, key) or default for key, default in self.defaults(stage).items()
        }

    @property
    def title(self) -> str:
        """Its name in reports."""
        return self.name.replace("_", " ")

    @property
    def year(self) -> int:
        """The year of its source."""
        return int(re.findall(r"\b(?:19|20)\d\d\b", self.source)[0])


class Thermostat(EnsembleMethod):
    """A thermostat."""

    #: Whether half of its flow acts before a step and half after it, or all after it, with an
    #: integrator whose row has no thermostat.
    halved: bool = True
    #: Whether it acts on each molecule by itself, so that the total momentum is not conserved and
    #: diffusion and spectra change.
    on_molecules: bool = False
    #: Whether translation and rotation each have a thermostat, which relaxes their kinetic energy
    #: to its mean in the time constant.
    by_motion: bool = False
    #: The key with the number of steps that are accepted or rejected together, in trajectories, so
    #: that averages have no time-step error. Empty: steps are not tested.
    steps_key: str = ""
    #: Why analyses of motion in time refuse its states. Empty: they do not.
    no_motion: str = ""
    #: Module whose `choose_for_stage` chooses integrator and step for integrator = "auto". Empty:
    #: they follow from the error that is set.
    pilot: str = ""
    #: Columns of the log that only its stages have.
    quantities: tuple[Quantity, ...] = ()

    @property
    def in_trajectories(self) -> bool:
        """Whether steps are accepted or rejected together."""
        return bool(self.steps_key)

    def steps_together(self, values: Values) -> int:
        """Steps that are accepted or rejected together."""
        return int(values[self.steps_key])

    @property
    def flow(self) -> str:
        """The module with its record and flow."""
        return f"rigidmd.dynamics.thermostats.{self.name}"

    def time(self, values: Values) -> float:
        """Its time constant, ps. 0 for one that acts at once."""
        return values.get("thermostat_time_ps", 0.0)

    def rates(self, values: Values) -> tuple[float, float]:
        """The rates at which it relaxes the kinetic energies of translation and of rotation
        separately, 1/ps; (0, 0) if it does not relax them linearly."""
        return 0.0, 0.0

    def describe(self, values: Values) -> str:
        """What reports print after its name. By default its time constant."""
        return f"{time:g} ps" if (time := self.time(values)) else ""

    def joined(self, scheme: Scheme, thermostat: tuple, stage: StageKeys) -> Scheme:
        """A scheme with its flow. thermostat : its record, see `dynamics.thermostats`"""
        return scheme.with_thermostat(thermostat, halved=self.halved)


class Barostat(EnsembleMethod):
    """A barostat."""

    ensembles = ("npt",)
    shapes: tuple[str, ...] = get_args(Shapes)  # how the box may change
    #: Whether its flows are parts of velocity Verlet steps, of which the integrator then has to
    #: consist.
    in_verlet_steps: bool = False
    #: Whether its time constant is the relaxation time of moves, which has to be longer than the
    #: time between two of them.
    relaxes_in_moves: bool = False
    reads_momenta: bool = False  # at the ends of steps, or only a temperature

    @property
    def flow(self) -> str:
        """The module with its record and flow."""
        return f"rigidmd.dynamics.barostats.{self.name}"

    def joined(self, scheme: Scheme, barostat: tuple, stage: StageKeys) -> Scheme:
        """A scheme with its flow. barostat : its record, see `dynamics.barostats`"""
        return scheme.with_barostat(barostat, stage.moves_every)


#: Those of a stage without one.
NO_THERMOSTAT, NO_BAROSTAT = Thermostat(), Barostat()
