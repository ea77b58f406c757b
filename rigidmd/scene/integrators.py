"""User-defined integrators, in the tables [[integrators]] of a scene or by
`integrator`."""

from collections.abc import Container, Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, PrivateAttr, Strict, ValidationError

from rigidmd.core.integrators import (
    AUTO,
    SCHEMES,
    SOLVERS,
    WITH_THERMOSTAT,
    Rotor,
    Scheme,
    composed,
    measured_order,
    split,
)
from rigidmd.core.toml import Json, plain_values
from rigidmd.errors import SceneError
from rigidmd.scene.validation import Line, Section, exact_names, validation_messages

RESERVED = (*SCHEMES, *WITH_THERMOSTAT, AUTO, *SOLVERS)
Coefficient = Annotated[float, Strict(), Field(ge=-10, le=10)]
Coefficients = Annotated[tuple[Coefficient, ...], Field(min_length=1, max_length=1000)]
#: Largest difference of the order that is measured for an oscillator from the order that a row
#: states.
ORDER_TOLERANCE = 0.5
#: Names that other programs give to velocity Verlet -> advice.
VERLET_ELSEWHERE = dict.fromkeys(
    ("md", "md_vv", "leap_frog", "leapfrog"), "write 'velocity_verlet'"
)
#: Coefficients whose longest has a number of decimals between these are probably truncated.
FEWEST_DECIMALS, ALL_DECIMALS = 4, 14


class IntegratorRow(Section):
    """An integrator as a scheme, for stages and for `rigidmd accuracy`."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z]\w*$", max_length=60)]
    """Name for stages, [run] of a body and --integrators"""
    steps: Coefficients | None = None
    """Lengths of successive velocity Verlet steps, as fractions of the time step. Such a scheme
    works with any rotor"""
    kicks: Coefficients | None = None
    """Instead of steps: fractions of the kicks, of which the first and the last may be 0. The
    scheme needs the exact rotor"""
    drifts: Coefficients | None = None
    """Fractions of the drifts between the kicks, one fewer than kicks"""
    gradients: Coefficients | None = None
    """The force gradient of each kick, tau/dt², without the fraction of the kick. Default: none"""
    order: Annotated[int, Strict(), Field(ge=2, le=20)]
    """Order of convergence. It is compared with the order for an anharmonic oscillator"""
    source: Line = ""
    """Source of the coefficients"""

    def _errors(self):
        if exact_names(self.name, Literal[RESERVED]) in RESERVED:
            yield f"name: {self.name} is an integrator of rigidmd. Choose another name"
        if (self.steps is None) == (self.kicks is None or self.drifts is None):
            yield "needs steps, or kicks and drifts"
        elif self.steps is not None and (self.kicks or self.drifts or self.gradients):
            yield "steps and kicks, drifts or gradients contradict each other: omit one"
        elif any(
            g and not kick for g, kick in zip(self.gradients or (), self.kicks or (), strict=False)
        ):
            yield (
                "gradients: a kick of fraction 0 has no gradient: its coefficient is multiplied by"
                " the fraction"
            )
        else:
            try:
                order = measured_order(self.scheme)
            except ValueError as error:
                yield f"{str(error).partition('; odd')[0]}{self._advice_on_digits}"
            else:
                if order < self.order - ORDER_TOLERANCE:
                    yield (
                        f"order = {self.order}, but the error of an oscillator has order"
                        f" {order:.1f}{self._advice_on_digits}"
                    )

    @property
    def _advice_on_digits(self) -> str:
        """Advice for fractions with some decimals of more, whose rounding is an error of the
        scheme."""
        rows = (self.steps, self.kicks, self.drifts, self.gradients)
        lengths = [len(repr(x).partition(".")[2]) for row in rows for x in row or ()]
        cut = FEWEST_DECIMALS <= max(lengths) < ALL_DECIMALS
        return f". Give all digits of its coefficients ({ALL_DECIMALS} or more)" if cut else ""

    @property
    def scheme(self) -> Scheme:
        """Raises ValueError if kicks or drifts do not sum to 1, or the row is not a palindrome."""
        if self.steps is not None:
            return composed(self.name, self.steps, self.order, self.source)
        return split(
            self.name, self.kicks or (), self.drifts or (), self.order, self.source, self.gradients
        )


#: Rows that Python has registered in this process.
_REGISTERED: dict[str, IntegratorRow] = {}


def register_integrator(
    name: str,
    *,
    order: int,
    steps: Sequence[float] | None = None,
    kicks: Sequence[float] | None = None,
    drifts: Sequence[float] | None = None,
    gradients: Sequence[float] | None = None,
    source: str = "",
) -> str:
    """Register a scheme as an integrator, which scenes then accept by its name.

    Fractions sum to 1 and read the same from both ends. Give `steps`, or `kicks` and `drifts`. A
    scene that names the scheme keeps its coefficients in its table [[integrators]], so that its
    file and the folder of its run are complete.

    Parameters
    ----------
    name : str
        Name in scenes
    order : int
        Order of the scheme, 2 or an even number
    steps : sequence of float, optional
        Lengths of successive velocity Verlet steps, as fractions of the time step
    kicks : sequence of float, optional
        Fractions of the kicks of kick, drift, ..., drift, kick
    drifts : sequence of float, optional
        Fractions of the drifts between the kicks
    gradients : sequence of float, optional
        For each kick, tau/dt² without the fraction of the kick: 1/12 in both kicks of kick(1/2)
        drift(1) kick(1/2) is the scheme of Takahashi and Imada
    source : str, optional
        Publication of the scheme

    Returns
    -------
    str
        The name

    Raises
    ------
    SceneError
        If the coefficients are invalid.

    Examples
    --------
        rigidmd.register_integrator(
            "ruth_4", order=4, steps=[1.3512, -1.7024, 1.3512], source="Forest & Ruth 1990"
        )
    """
    values = {
        "name": name,
        "order": order,
        "steps": steps,
        "kicks": kicks,
        "drifts": drifts,
        "gradients": gradients,
    }
    table = {
        key: value
        for key, value in plain_values(values | {"source": source}).items()
        if value is not None
    }
    try:
        _REGISTERED[name] = IntegratorRow.model_validate(table)
    except ValidationError as error:
        errors = [
            fault.removeprefix("scene: ") for fault in validation_messages(error, IntegratorRow)
        ]
        raise SceneError(f"integrator {name!r:.60}", errors) from None
    return name


def with_registered_rows(data: Json) -> tuple[Json, dict[str, Scheme]]:
    """Tables of a scene with those registered rows that it names and does not have, and its names
    of rows, each with a scheme that stands for an invalid row, so that only the row is an error."""
    tables, stages = (
        [*entries] if isinstance(entries := data.get(key), list) else []
        for key in ("integrators", "stages")
    )
    names = [
        table.get("integrator") for table in (*stages, data.get("run")) if isinstance(table, dict)
    ]
    given_names = [table.get("name") for table in tables if isinstance(table, dict)]
    taken = [name for name in given_names if isinstance(name, str)]
    rows = [row for name, row in _REGISTERED.items() if name in names and name not in taken]
    changed = {}
    if rows:
        new_tables = [row.model_dump(exclude_none=True) for row in rows]
        changed = {"integrators": [*tables, *new_tables]}
    return data | changed, dict.fromkeys(taken, SCHEMES["velocity_verlet"])


def advise_on_integrator(
    name: object, advice: dict[str, str], known: Iterable[str], rows: Container[object] | None
) -> object:
    """The name of an integrator, unless there is advice on it. Raises ValueError.

    advice : name of an integrator for other scenes or of other programs -> advice; rows : names of
    the rows of the scene
    """
    plain = name.lower().replace("-", "_") if isinstance(name, str) else ""
    if plain in advice and not (rows and name in rows):
        raise ValueError(f"is {name!r}: {advice[plain]}. The integrators are {', '.join(known)}")
    return name


class MovedByScheme(Section):
    """A section with the keys `integrator` and `rotor`."""

    if TYPE_CHECKING:
        integrator: str
        rotor: Rotor | None

    _user_schemes: dict[str, Scheme] = PrivateAttr(default_factory=dict)

    def model_post_init(self, context: dict[str, Scheme] | None) -> None:
        self._user_schemes = context or {}

    @property
    def row(self) -> Scheme:
        """The row of the integrator, with the rotor that it needs."""
        return (SCHEMES | WITH_THERMOSTAT | self._user_schemes)[self.integrator]

    @property
    def scheme(self) -> Scheme:
        """The integrator with its rotor."""
        return self.row.with_rotor(self.rotor)

    @property
    def is_auto(self) -> bool:
        """Whether integrator and step are still to be chosen."""
        return self.integrator == AUTO

    @property
    def has_scheme(self) -> bool:
        """Whether the integrator is a row of flows: neither "auto" nor an ODE solver."""
        return self.integrator not in (AUTO, *SOLVERS)

    def _rotor_errors(self):
        if self.rotor == "split" and self.has_scheme and self.row.exact_rotor:
            yield (
                f"{self.integrator} needs rotor = 'exact': with the split rotor it would be of"
                " order 2"
            )
