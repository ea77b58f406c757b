"""The keys of [forces] for potentials of users: of sites and of pairs of bodies."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field, create_model

from rigidmd.core.toml import Json, shorten_repr
from rigidmd.scene.added_forces import AddedForce, AddedForces
from rigidmd.scene.table_in_file import TableInFile
from rigidmd.scene.truncation import TruncationName
from rigidmd.scene.validation import MOST_TABLES, Cutoff, Line, Number, Positive, Section


def closed_brackets(energy: str) -> str:
    """A formula whose brackets are pairs. Raises ValueError."""
    left = list[int]()
    for position, character in enumerate(energy, 1):
        if character == "(":
            left.append(position)
        elif character == ")" and not left:
            raise ValueError(f"a bracket is closed at position {position} that is not open")
        elif character == ")":
            left.pop()
    if left:
        raise ValueError(f"the bracket at position {left[-1]} is not closed: {energy!r}")
    return energy


#: The formula of an energy.
Energy = Annotated[str, Field(min_length=1, max_length=2000), AfterValidator(closed_brackets)]


class PairParameters(Section):
    """Parameters of a custom pair potential between two kinds of sites."""

    sites: tuple[str, str]
    """The two kinds, by site, SPECIES.SITE or element"""
    parameters: dict[str, Number] = Field(default={}, max_length=MOST_TABLES)
    """Parameters by name. A table needs none"""


class CustomForce(AddedForce):
    """A custom force: a formula of the distance between sites, a table, or an object in a Python
    file."""

    name: Annotated[str, Field(pattern=r"^[^\W\d]\w*$", max_length=40)]
    """Name in the log. With `module` it is also the name of the object in this file"""
    module: Line | None = None
    """Python file in the folder of the scene. Its code runs only with --trust FILE"""
    energy: Energy | None = None
    """Without a module: energy of a pair of sites (kJ/mol) as a function of their distance r (Å)
    and named parameters, such as A*exp(-B*r) - C/r**6. The functions exp, log, sqrt, sin and cos
    can be used"""
    table: Line | None = None
    """Instead of an energy: a file in the folder of the scene with the columns r_A, energy_kJ_mol
    and optionally force_kJ_mol_A (-dE/dr), in lines of ascending r up to the cutoff. All keys of an
    energy can also be used with a table. Its only parameter is scale, a factor of the energy.
    Default: 1"""
    parameters: Json = Field(default={}, max_length=MOST_TABLES)
    """With a module: arguments with which its object is called. With an energy: numbers, which
    apply to all sites, or a table of numbers for each kind of site, by site, SPECIES.SITE or
    element. Default: `parameters` in the models' files"""
    sites: tuple[str, ...] = Field(default=(), max_length=MOST_TABLES)
    """With an energy: the sites that it acts on. Default: all sites with parameters"""
    pairs: tuple[PairParameters, ...] = Field(default=(), max_length=MOST_TABLES)
    """With an energy: parameters of particular pairs, which replace mixed parameters"""
    mixing: dict[str, Literal["geometric", "arithmetic", "harmonic"]] = Field(
        default={}, max_length=MOST_TABLES
    )
    """With an energy: the mean of each parameter for unlike sites. Default: arithmetic for names
    that start with sig, else geometric"""
    truncation: TruncationName | None = None
    """With an energy: its cutoff scheme. Default: forces.truncation"""
    cutoff_A: Cutoff | None = None
    """With an energy: its cutoff. Default: forces.cutoff_A"""
    switch_start_A: Positive | None = None
    """With an energy: distance at which a switch starts. Default: forces.switch_start_A"""

    @property
    def label(self) -> str:
        return self.name

    @property
    def files(self) -> dict[str, str | None]:
        return {"module": self.module, "table": self.table}

    def _errors(self):
        if sum(source is not None for source in (self.module, self.energy, self.table)) != 1:
            yield (
                "give a module, a Python file with the force, an energy, a formula of r, or a"
                " table, a file of energies"
            )
        if self.module is not None:
            of_energy = ("sites", "pairs", "mixing", "truncation", "cutoff_A", "switch_start_A")
            idle = [key for key in of_energy if getattr(self, key) not in (None, (), {})]
            if idle:
                yield (
                    f"{', '.join(idle)} would have no effect with a module: its object has"
                    " `parameters`"
                )
            if not self.module.endswith(".py"):
                yield f"module = {shorten_repr(self.module)} must be a Python file (.py)"


class SpeciesPair(Section):
    """Parameters of a potential of two bodies for two species."""

    species: tuple[str, str]
    """Names of the two species"""
    parameters: dict[str, Number] = Field(default={}, max_length=MOST_TABLES)
    """Parameters by name, which replace the parameters of both species"""


class BodyForce(AddedForce):
    """A potential of two bodies: a function of the vector between them and of their
    orientations."""

    name: Annotated[str, Field(pattern=r"^[^\W\d]\w*$", max_length=40)] | None = None
    """Name in the log. Default: the name of the potential. With `module` it is also the name of the
    object in this file"""
    potential: Literal["gay_berne", "dipole", "quadrupole", "patch"] | None = None
    """gay_berne: ellipsoids. dipole and quadrupole: at a point. patch: spheres with an attractive
    patch"""
    energy: Energy | None = None
    """Instead of a potential: the energy (kJ/mol) as a function of the distance r (Å), the cosines
    a_r and b_r, the cosine a_b and named parameters. a_r and b_r belong to the angles between the
    axes of the first and the second body and the vector from the first to the second body. a_b
    belongs to the angle between the two axes"""
    table: Line | None = None
    """Instead of a potential: .npz file in the folder of the scene with the pair energies of linear
    bodies"""
    species: tuple[str, ...] = Field(default=(), max_length=MOST_TABLES)
    """With a table: the species that it acts on. Default: all"""
    module: Line | None = None
    """Instead of a potential: Python file in the folder of the scene with a
    `rigidmd.body_pair_potential`. Its code runs only with --trust FILE"""
    parameters: dict[str, dict[str, Number]] = Field(default={}, max_length=MOST_TABLES)
    """Species -> parameters by name. The potential acts on these species"""
    pairs: tuple[SpeciesPair, ...] = Field(default=(), max_length=MOST_TABLES)
    """Parameters of particular pairs of species"""
    mixing: dict[str, Literal["geometric", "arithmetic", "harmonic"]] = Field(
        default={}, max_length=MOST_TABLES
    )
    """With an energy: the mean of each parameter for unlike species. Default: arithmetic for names
    that start with sig, else geometric"""
    options: dict[str, Number] = Field(default={}, max_length=MOST_TABLES)
    """gay_berne: upsilon (default: 1), mu (2), gamma (1). dipole: reaction_field_A, the radius of
    the reaction field of a conductor (default: none)"""
    axis: Literal["x", "y", "z"] = "z"
    """Axis of the bodies, in the coordinates of the models' files"""
    references: dict[str, tuple[Number, Number, Number]] = Field(default={}, max_length=MOST_TABLES)
    """Species -> the reference point of the body for distances, in the coordinates of the model's
    file, Å. Default: the centre of mass"""
    truncation: Literal["switch", "plain"] = "switch"
    """switch: from switch_start_A onwards the energy is switched to 0 at the cutoff. plain: the
    energy jumps at the cutoff"""
    cutoff_A: Cutoff | None = None
    """Cutoff of the distance between the reference points. Default: forces.cutoff_A"""
    switch_start_A: Positive | None = None
    """Distance at which the switch starts. Default: 0.9 of the cutoff"""

    def _errors(self):
        sources = [self.potential, self.energy, self.table, self.module]
        if sum(source is not None for source in sources) != 1:
            yield "give one of potential, energy, table and module"
        if self.module is not None and self.name is None:
            yield "name is missing: with a module it is the name of the object in it"
        given = {
            "mixing": self.energy is None and self.mixing,
            "options": self.potential is None and self.options,
            "species": self.table is None and self.species,
        }
        if self.module is not None:
            keys = ("parameters", "pairs", "references", "cutoff_A", "switch_start_A")
            given |= {key: getattr(self, key) for key in keys}
        if idle := [key for key, value in given.items() if value]:
            yield f"{', '.join(idle)} would have no effect here"
        if self.truncation == "plain" and self.switch_start_A is not None:
            yield "switch_start_A would have no effect with truncation = 'plain'"

    @property
    def label(self) -> str:
        return self.name or self.potential or "body_pairs"

    @property
    def files(self) -> dict[str, str | None]:
        return {"module": self.module, "table": self.table}

    @property
    def more_lengths(self) -> dict[str, float | None]:
        return {"options.reaction_field_A": self.options.get("reaction_field_A")}


#: Names of the pair potentials in `pairs`, each of which is a key.
PAIRS = sorted(file.stem for file in Path(__file__).with_name("pairs").glob("[a-z]*.py"))
_of_pairs = {
    name: (Annotated[object, TableInFile(f"rigidmd.features.potentials.pairs.{name}")], None)
    for name in PAIRS
}
if TYPE_CHECKING:
    _PairKeys = AddedForces
else:  # as many keys as there are files
    _PairKeys = create_model("_PairKeys", __base__=AddedForces, __module__=__name__, **_of_pairs)


class PotentialKeys(_PairKeys):
    """The keys of custom forces, of pair potentials of bodies and of those with a key each."""

    custom: tuple[CustomForce, ...] = Field(default=(), max_length=MOST_TABLES)
    """Custom forces"""
    bodies: tuple[BodyForce, ...] = Field(default=(), max_length=MOST_TABLES)
    """Pair potentials between bodies"""

    @property
    def added(self) -> dict[str, AddedForce]:
        """The tables of all these, by their keys."""
        tables = {"custom": self.custom, "bodies": self.bodies}
        lists = {
            f"forces.{key}.{k}": entry
            for key, entries in tables.items()
            for k, entry in enumerate(entries)
        }
        return lists | {f"forces.{name}": force for name in PAIRS if (force := getattr(self, name))}

    @property
    def added_not_summable(self) -> tuple[tuple[str, object], ...]:
        why = (
            "custom forces have no such sum, so that a part of the dispersion would end at the"
            " cutoff"
        )
        return ((why, len(self.added) > len(self.bodies)),)
