"""The table [coupling]: a species whose interactions are scaled, for free energies."""

from typing import TYPE_CHECKING, Annotated, TypedDict

from pydantic import Field, Strict, create_model

from rigidmd.core.toml import Json
from rigidmd.scene.validation import MOST_TABLES, Section, ShortName

Fraction = Annotated[float, Strict(), Field(ge=0, le=1)]
if TYPE_CHECKING:
    _WithLambda = Section
else:  # `lambda` is a word of Python, which no class body can have as a name
    _about = "0: the species is absent, 1: it is complete"
    _lambda = {"lambda": (Fraction, Field(1.0, description=_about))}
    _WithLambda = create_model("_WithLambda", __base__=Section, **_lambda)


class Coupling(_WithLambda):
    """A species whose interactions with all molecules and with its own images are scaled. Its
    Lennard-Jones forces grow first, with a soft core, then its charges."""

    species: ShortName
    """Name of the species, usually of one molecule"""
    charges_from: Annotated[float, Strict(), Field(gt=0, le=1)] | None = None
    """lambda at which the charges begin to grow, and Lennard-Jones forces are complete. Default:
    0.5, and 1 for a species without charges"""
    lambdas: tuple[Fraction, ...] = Field(default=(), max_length=MOST_TABLES)
    """Values of lambda at which the log also has the energy, for `rigidmd analyse SWEEP
    free_energy`: all values of the sweep"""

    @property
    def value(self) -> float:
        """lambda"""
        return getattr(self, "lambda")

    @property
    def lennard_jones(self) -> float:
        """The lambda of Lennard-Jones forces, in a resolved scene."""
        return min(1.0, self.value / (self.charges_from or 1.0))

    @property
    def charges(self) -> float:
        """Factor of the charges, in a resolved scene."""
        begin = self.charges_from or 1.0
        return max(0.0, (self.value - begin) / (1 - begin)) if begin < 1 else float(self.value == 1)

    @property
    def in_short(self) -> str:
        """What is scaled, in a resolved scene."""
        factors = f"Lennard-Jones at {self.lennard_jones:g}, charges times {self.charges:g}"
        return f"lambda {self.value:g} of {self.species}: {factors}"

    def at(self, value: float) -> "Coupling":
        return self.model_copy(update={"lambda": value})


class CouplingKeys(Section):
    """The table [coupling] of a scene."""

    coupling: Coupling | None = None


class CouplingSettings(TypedDict, total=False):
    """The keyword of `scene_from_atoms`."""

    coupling: Json
