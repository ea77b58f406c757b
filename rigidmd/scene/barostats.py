"""The barostats of scenes: their names, keys and descriptions. Their flows are in `dynamics.barostats`."""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import Field

from rigidmd.scene.validation import NameIn, Number, Positive, Section

Six = tuple[float, float, float, float, float, float]
Coupling = Literal["isotropic", "semi_isotropic", "anisotropic", "flexible"]

TIME = 1.0  # ps
#: Moves of the box per barostat_time_ps.
MOVES_PER_TIME = 20
#: Compressibility of water at 298 K and 1 bar, 1/bar.
COMPRESSIBILITY = 4.5e-5


class Barostat(NamedTuple):
    """What scenes and reports know of a barostat."""

    summary: str  # for the description of the key `barostat`
    source: str
    keys: dict[str, float | Callable[[Any], float]]  # its keys -> their defaults, or functions of the stage
    ensembles: tuple[str, ...] = ("npt",)
    couplings: tuple[str, ...] = get_args(Coupling)
    #: Whether its flows are parts of velocity Verlet steps, of which the integrator then has to consist.
    in_verlet_steps: bool = False
    title: str = ""  # in reports; default: its name


def _interval(stage: Any) -> float:
    return (stage.barostat_time_ps or TIME) / MOVES_PER_TIME


#: The first one of an ensemble is its default.
BAROSTATS = {
    "cell_rescaling": Barostat(
        "stochastic cell rescaling, made exact by a Metropolis test",
        "Bernetti & Bussi 2020, J. Chem. Phys. 153, 114107",
        {"barostat_interval_ps": _interval, "barostat_time_ps": TIME},
    ),
    "monte_carlo": Barostat(
        "random changes of the volume", "Åqvist et al. 2004, Chem. Phys. Lett. 384, 288",
        {"barostat_interval_ps": _interval}, couplings=("isotropic",),
    ),
    "piston": Barostat(
        "a volume with inertia and without friction", "Andersen 1980, J. Chem. Phys. 72, 2384",
        {"barostat_time_ps": TIME}, ensembles=("nph",), couplings=("isotropic",), in_verlet_steps=True,
        title="a piston",
    ),
}  # fmt: skip


class BarostatKeys(Section):
    """The keys of barostats in a stage."""

    pressure_bar: Number | tuple[Number, Number] | tuple[Number, Number, Number] | Six | None = None
    """Pressure of the barostat, or of the minimisation of the enthalpy; two for a linear change over the stage,
    [1, 1000]; three for one along each axis; six for the tensor xx, yy, zz, xy, xz, yz"""
    pressure_coupling: Coupling = "isotropic"
    """How the box changes: isotropic keeps its shape; semi_isotropic: x and y together, z separately; anisotropic:
    three edges; flexible: edges and angles"""
    barostat: Annotated[str, NameIn(BAROSTATS)] | None = Field(
        default=None,
        description="; ".join(
            f"{name} ({' or '.join(kind.ensembles)}): {kind.summary}" for name, kind in BAROSTATS.items()
        )
        + ". Default: the first one of the ensemble",
    )
    barostat_time_ps: Positive | None = None
    """Time constant of cell_rescaling, period of the piston of nph; default: 1 ps"""
    barostat_interval_ps: Positive | None = None
    """Time between two moves of the box in npt; default: 0.05 of barostat_time_ps"""
    compressibility_per_bar: Positive | None = None
    """Compressibility; it sets the speed of the box, not the ensemble. Default: 4.5e-5, of water"""
