"""The thermostats and barostats of scenes: their names, keys and descriptions.

Their flows are in `dynamics.thermostats` and `dynamics.barostats`, under the same names.
"""

from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple, Protocol, get_args

from pydantic import Field, Strict

from rigidmd.scene.validation import NameIn, Number, Positive, Section, number_of_steps

Values = dict[str, float]  # of keys
Six = tuple[float, float, float, float, float, float]
Shapes = Literal["isotropic", "semi_isotropic", "anisotropic", "flexible", "normal", "lateral"]

BAROSTAT_TIME = 1.0  # ps
#: Moves of the box per barostat_time_ps.
MOVES_PER_TIME = 20
#: Compressibility of water at 298 K and 1 bar, 1/bar.
COMPRESSIBILITY = 4.5e-5


class CoupledStage(Protocol):
    """The keys of a stage on which defaults of other keys depend."""

    @property
    def step(self) -> float: ...  # ps

    @property
    def barostat_time_ps(self) -> float | None: ...

    @property
    def friction_translation_per_ps(self) -> float | None: ...


class Coupling(NamedTuple):
    """What scenes and reports know of a thermostat or barostat."""

    summary: str  # for the description of the key `thermostat` or `barostat`
    source: str
    #: Its keys -> their defaults, or functions of the stage
    keys: dict[str, float | Callable[[CoupledStage], float]]
    ensembles: tuple[str, ...] = ("nvt", "npt")
    #: For a thermostat: whether it acts on each molecule by itself, so that the total momentum is
    #: not conserved and diffusion and spectra change; its time constant (ps) and its description by
    #: the values of its keys.
    on_molecules: bool = False
    in_trajectories: bool = False  # whether steps are accepted or rejected together
    halved: bool = True  # half of its flow before a step and half after it, or all after it
    #: Whether translation and rotation each have a thermostat, which relaxes their kinetic energy
    #: to its mean in the time constant.
    by_motion: bool = False
    time: Callable[[Values], float] = lambda values: values["thermostat_time_ps"]
    description: Callable[[Values], str] = lambda values: f"{values['thermostat_time_ps']:g} ps"
    #: Whether its time constant is the period of an oscillation, which steps have to resolve, or
    #: the relaxation time of moves, which has to be longer than the time between two of them.
    oscillates: bool = False
    relaxes_in_moves: bool = False
    #: For a barostat: how the box may change; whether its flows are parts of velocity Verlet steps,
    #: of which the integrator then has to consist; its name in reports, if it is another one.
    shapes: tuple[str, ...] = get_args(Shapes)
    in_verlet_steps: bool = False
    title: str = ""
    #: For a barostat: whether it reads the momenta at the ends of steps, or only a temperature.
    reads_momenta: bool = False

    def values(self, stage: CoupledStage) -> Values:
        """The values of its keys in a stage."""
        defaults = {
            key: default(stage) if callable(default) else default
            for key, default in self.keys.items()
        }
        return {key: getattr(stage, key) or default for key, default in defaults.items()}


def _describe_frictions(values: Values) -> str:
    translation, rotation = values.values()
    return f"friction {translation:g}/ps" + (
        f" ({rotation:g}/ps of rotation)" if rotation != translation else ""
    )


#: Length of a trajectory of hybrid Monte Carlo, ps.
TRAJECTORY_PS = 0.1


def _describe_trajectories(values: Values) -> str:
    steps, new = values.values()
    drawn = "" if new == 1 else f", {new:g} of each momentum's variance drawn again"
    return f"trajectories of {steps:g} step{'s' if steps > 1 else ''}{drawn}"


def default_interval(stage: CoupledStage) -> float:
    """Time between two moves of the box, ps."""
    return (stage.barostat_time_ps or BAROSTAT_TIME) / MOVES_PER_TIME


DEFAULT_THERMOSTAT = "velocity_rescaling"
THERMOSTATS = {
    "velocity_rescaling": Coupling(
        "stochastic, one of translation and one of rotation, by Bussi et al.",
        "Bussi, Donadio & Parrinello 2007, J. Chem. Phys. 126, 014101",
        {"thermostat_time_ps": 0.05},
        by_motion=True,
        halved=False,
    ),
    "langevin": Coupling(
        "friction and noise",
        "Davidchack, Ouldridge & Tretyakov 2015, J. Chem. Phys. 142, 144114",
        {
            "friction_translation_per_ps": 1.0,
            "friction_rotation_per_ps": lambda stage: stage.friction_translation_per_ps or 1.0,
        },
        on_molecules=True,
        time=lambda values: 1 / min(values.values()),
        description=_describe_frictions,
    ),
    "nose_hoover": Coupling(
        "one chain for translation and one for rotation",
        "Martyna, Tuckerman, Tobias & Klein 1996, Mol. Phys. 87, 1117",
        {"thermostat_time_ps": 0.5, "nose_hoover_links": 3},
        oscillates=True,
    ),
    "andersen": Coupling(
        "collisions",
        "Andersen 1980, J. Chem. Phys. 72, 2384",
        {"thermostat_time_ps": 1.0},
        on_molecules=True,
    ),
    "hybrid_monte_carlo": Coupling(
        "trajectories from new momenta, accepted or rejected: averages without a time-step error",
        "Duane, Kennedy, Pendleton & Roweth 1987, Phys. Lett. B 195, 216",
        {
            "trajectory_steps": lambda stage: number_of_steps(TRAJECTORY_PS, stage.step),
            "momentum_refreshment": 1.0,
        },
        on_molecules=True,
        in_trajectories=True,
        time=lambda values: 0.0,
        description=_describe_trajectories,
    ),
}
#: The first one of an ensemble is its default.
BAROSTATS = {
    "cell_rescaling": Coupling(
        "stochastic cell rescaling, made exact by a Metropolis test",
        "Bernetti & Bussi 2020, J. Chem. Phys. 153, 114107",
        {"barostat_time_ps": BAROSTAT_TIME, "barostat_interval_ps": default_interval},
        ("npt",),
        relaxes_in_moves=True,
        reads_momenta=True,
    ),
    "monte_carlo": Coupling(
        "random changes of the volume",
        "Åqvist et al. 2004, Chem. Phys. Lett. 384, 288",
        {"barostat_interval_ps": default_interval},
        ("npt",),
        shapes=("isotropic",),
    ),
    "piston": Coupling(
        "a volume with inertia and without friction",
        "Andersen 1980, J. Chem. Phys. 72, 2384",
        {"barostat_time_ps": BAROSTAT_TIME},
        ("nph",),
        shapes=("isotropic",),
        in_verlet_steps=True,
        title="a piston",
        oscillates=True,
        reads_momenta=True,
    ),
}


class ThermostatKeys(Section):
    """The keys of thermostats in a stage."""

    thermostat: Annotated[str, NameIn(THERMOSTATS)] | None = Field(
        default=None,
        description="; ".join(f"{name}: {kind.summary}" for name, kind in THERMOSTATS.items())
        + f". Default: {DEFAULT_THERMOSTAT}",
    )
    thermostat_time_ps: Positive | None = None
    """Time constant of velocity_rescaling (default: 0.05 ps), period of nose_hoover (0.5 ps), or
    mean time between two collisions of a molecule with andersen (1 ps)"""
    friction_translation_per_ps: Positive | None = None
    """Friction that langevin applies to translation. Default: 1"""
    friction_rotation_per_ps: Positive | None = None
    """Friction that langevin applies to rotation. Default: friction_translation_per_ps"""
    nose_hoover_links: Annotated[int, Strict(), Field(ge=1, le=100)] = 3
    """Links of each Nose-Hoover chain"""
    trajectory_steps: Annotated[int, Strict(), Field(ge=1, le=100_000)] | None = None
    """Number of steps of a hybrid_monte_carlo trajectory, which is then accepted or rejected.
    Default: the number of steps in 0.1 ps"""
    momentum_refreshment: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Fraction of the variance of each momentum that hybrid_monte_carlo draws again before a
    trajectory. 1: all of it"""


class BarostatKeys(Section):
    """The keys of barostats in a stage."""

    pressure_bar: Number | tuple[Number, Number] | tuple[Number, Number, Number] | Six | None = None
    """Pressure of the barostat, or of the minimisation of the enthalpy. Use two values for a linear
    change over the stage, [1, 1000], three values for the pressures along the axes, or six values
    for the tensor xx, yy, zz, xy, xz, yz"""
    pressure_coupling: Shapes = "isotropic"
    """How the box changes. isotropic: it keeps its shape. semi_isotropic: x and y together, z
    separately. anisotropic: three edges. flexible: edges and angles. normal: z alone, at constant
    area. lateral: x and y together, z is kept"""
    barostat: Annotated[str, NameIn(BAROSTATS)] | None = Field(
        default=None,
        description="; ".join(
            f"{name}, of {kind.ensembles[0]}: {kind.summary}" for name, kind in BAROSTATS.items()
        )
        + ". Default: the first one of the ensemble",
    )
    barostat_time_ps: Positive | None = None
    """Time constant of cell_rescaling, or period of the piston of nph. Default: 1 ps"""
    barostat_interval_ps: Positive | None = None
    """Time between two box moves in npt. Default: 0.05 of barostat_time_ps"""
    compressibility_per_bar: Positive | None = None
    """Compressibility. It sets how fast the box changes, but not the ensemble. Default: 4.5e-5, the
    value for water"""
