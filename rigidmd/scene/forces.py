"""The table [forces] of a scene of molecules: forces between sites."""

from collections.abc import Iterator
from math import inf
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, Strict

from rigidmd.core.toml import Json, shorten_repr
from rigidmd.scene.models import Mixing
from rigidmd.scene.validation import (
    MOST_TABLES,
    Count,
    Cutoff,
    Flag,
    Line,
    NonNegative,
    Number,
    Positive,
    Section,
)

Permittivity = Annotated[float, Strict(), Field(ge=1)]
KIndex = Annotated[int, Strict(), Field(ge=0, le=1000)]
TruncationName = Literal["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
GridSize = Annotated[int, Strict(), Field(ge=8, le=4096)]


class Method(NamedTuple):
    """A method of electrostatics."""

    # in `forces`: its function `interactions`, and `setting_errors` and `settings` if it needs them
    module: str = ""
    keys: tuple[str, ...] = ()  # of `Forces`, which have no effect with other methods
    sums_images: bool = False  # whether charges act on all periodic images
    conserves_momentum: bool = True


_EWALD = (
    "ewald_accuracy",
    "ewald_cutoff_A",
    "ewald_alpha_per_A",
    "ewald_surface_permittivity",
    "ewald_slab",
    "ewald_truncation",
)
_K_VECTORS = ("ewald_k_max", "ewald_k2_max", "ewald_k_radius_per_A")
#: Value of `electrostatics` -> the method.
ELECTROSTATICS = {
    "reaction_field": Method(
        "potentials.coulomb", ("reaction_field_permittivity", "reaction_field_truncation")
    ),
    "ewald": Method("ewald.interactions", (*_EWALD, *_K_VECTORS), sums_images=True),
    "pme": Method(
        "ewald.interactions",
        (*_EWALD, "pme_order", "pme_grid"),
        sums_images=True,
        conserves_momentum=False,
    ),
    "damped_shifted_force": Method("potentials.screened_coulomb", ("damping_per_A",)),
    "coulomb": Method("potentials.coulomb"),
    "none": Method(),
}
#: Defaults of `electrostatics` where sites have charges, in a periodic box and in an open one.
PERIODIC, OPEN = "pme", "coulomb"
#: Pair potentials that are not of charges: key of `Forces`, which also names the term and the
#: module in `forces.potentials` with the function `interactions` -> its name among the unused
#: interactions, and why.
POTENTIALS = {"lennard_jones": ("Lennard-Jones", "lennard_jones is false")}


class UnlikePair(Section):
    """Lennard-Jones parameters for two kinds of sites, which replace the mixing rule."""

    sites: tuple[str, str]
    """The two kinds: a site name or else an element. `SPECIES.NAME` for sites of one species"""
    sigma_A: Positive
    """Lennard-Jones diameter"""
    epsilon_kJ_mol: NonNegative
    """Lennard-Jones well depth"""


class PairParameters(Section):
    """Parameters of a custom pair potential between two kinds of sites."""

    sites: tuple[str, str]
    """The two kinds, by site, SPECIES.SITE or element"""
    parameters: dict[str, Number] = Field(default={}, max_length=MOST_TABLES)
    """Parameters by name. A table needs none"""


#: Keys of a custom force that name a file.
FORCE_FILES = ("module", "table")


class CustomForce(Section):
    """A custom force: a formula of the distance between sites, a table, or an object in a Python
    file."""

    name: Annotated[str, Field(pattern=r"^[^\W\d]\w*$", max_length=40)]
    """Name in the log. With `module` it is also the name of the object in this file"""
    module: Line | None = None
    """Python file in the folder of the scene. Its code runs only with --trust FILE"""
    energy: Annotated[str, Field(min_length=1, max_length=2000)] | None = None
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

    def _errors(self):
        if sum(source is not None for source in (self.module, self.energy, self.table)) != 1:
            kinds = (
                "a module, a Python file with the force, an energy, a formula of r, or a table, a"
                " file of energies"
            )
            yield f"give {kinds}"
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


class BodyForce(Section):
    """A potential of two bodies: a function of the vector between them and of their
    orientations."""

    name: Annotated[str, Field(pattern=r"^[^\W\d]\w*$", max_length=40)] | None = None
    """Name in the log. Default: the name of the potential. With `module` it is also the name of the
    object in this file"""
    potential: Literal["gay_berne", "dipole", "quadrupole", "patch"] | None = None
    """gay_berne: ellipsoids. dipole and quadrupole: at a point. patch: spheres with an attractive
    patch"""
    energy: Annotated[str, Field(min_length=1, max_length=2000)] | None = None
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


class Forces(Section):
    """Forces between sites of different molecules."""

    cutoff_A: Cutoff | None = None
    """Cutoff between sites. Default: 9 Å in a periodic box, none without a box"""
    truncation: TruncationName = "shift"
    """Cutoff scheme of Lennard-Jones forces. Use smooth_switch with integrators of order 4 and
    more, which lose their order if forces jump at the cutoff. Charges follow
    reaction_field_truncation and ewald_truncation"""
    switch_start_A: Positive | None = None
    """Distance at which a switch starts. Default for force_switch and switch: 1 Å before the
    cutoff, or 0.9 of it if that is larger. Default for smooth_switch: 0.6 of the cutoff"""
    lennard_jones: Flag = True
    """Whether Lennard-Jones sites interact. Use false if `custom` replaces Lennard-Jones forces"""
    mixing: Mixing = "lorentz-berthelot"
    """Mixing rule of Lennard-Jones parameters between unlike sites"""
    pairs: tuple[UnlikePair, ...] = Field(default=(), max_length=MOST_TABLES)
    """Lennard-Jones parameters of particular pairs, which replace the mixing rule"""
    custom: tuple[CustomForce, ...] = Field(default=(), max_length=MOST_TABLES)
    """Custom forces"""
    bodies: tuple[BodyForce, ...] = Field(default=(), max_length=MOST_TABLES)
    """Pair potentials between bodies"""
    tail_correction: Flag | None = None
    """Add the Lennard-Jones energy and pressure beyond the cutoff. `pressure` includes the
    correction, `virial` does not. Default: true in a periodic box that the molecules fill evenly,
    false with walls, frozen molecules, custom forces or empty space"""
    dispersion: Literal["cutoff", "ewald", "pme"] = "cutoff"
    """Attraction -C6/r⁶ of Lennard-Jones sites: within the cutoff, or also of all periodic images
    beyond it, by a sum over k-vectors (ewald) or on a grid (pme), with the geometric mixing rule
    for C6 there"""
    dispersion_accuracy: Annotated[float, Strict(), Field(gt=0, le=0.1)] | None = None
    """With dispersion = ewald or pme: rms force error on a site, relative to the largest 24
    epsilon/sigma of a site, the attraction at sigma. It determines the keys below. Default: 5e-5"""
    dispersion_beta_per_A: Positive | None = None
    """With dispersion = ewald or pme: splitting parameter"""
    dispersion_order: Annotated[int, Strict(), Field(ge=3, le=8)] | None = None
    """With dispersion = pme: order of the B-splines"""
    dispersion_grid: tuple[GridSize, GridSize, GridSize] | None = None
    """With dispersion = pme: grid points, as for pme_grid"""
    electrostatics: Literal[tuple(ELECTROSTATICS)] | None = None  # type: ignore[valid-type]
    """Coulomb forces. ewald and pme act on all periodic images, reaction_field and
    damped_shifted_force act within the cutoff, and coulomb acts on all pairs without a periodic
    box. none ignores charges. Default: pme in a periodic box, coulomb in an open box"""
    reaction_field_permittivity: Permittivity = inf
    """Permittivity of the continuum beyond the cutoff. inf is a conductor"""
    reaction_field_truncation: TruncationName | None = None
    """Cutoff scheme of charges with a reaction field. With a conductor the force at the cutoff is
    0, so that a shifted energy suffices. switch and smooth_switch multiply the shifted energy. They
    make the random walk of the energy smaller and steps slower. Default: plain or smooth_switch if
    `truncation` is, else shift"""
    damping_per_A: Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)] = 0.2
    """Damping of damped_shifted_force, 0 for none"""
    ewald_accuracy: Annotated[float, Strict(), Field(gt=0, le=0.1)] | None = None
    """With ewald and pme: rms force error on a site, relative to the force between two charges e at
    1 Å. It determines the keys below. Default: 5e-5, somewhat better than the defaults of GROMACS
    and OpenMM"""
    ewald_cutoff_A: Cutoff | None = None
    """With ewald and pme: cutoff of the real-space part. Default: with pme the cutoff for which a
    cost model predicts the fastest step, else cutoff_A"""
    ewald_alpha_per_A: Positive | None = None
    """Splitting parameter: charges are screened by erfc(alpha r)"""
    ewald_k_max: KIndex | tuple[KIndex, KIndex, KIndex] | None = None
    """With ewald: largest |n| of k = 2 pi n/L, one number for all axes or one for each axis, for
    the cell of the box or file"""
    ewald_k2_max: Count | None = None
    """With ewald: also largest n_x² + n_y² + n_z²"""
    ewald_k_radius_per_A: Positive | None = None
    """With ewald: largest length of k"""
    ewald_truncation: Literal["plain", "shift"] | None = None
    """With ewald and pme: whether the real-space energy erfc(alpha r)/r is shifted to 0 at the
    cutoff. Forces do not change. Default: plain if `truncation` is plain, else shift. With shift,
    coulomb_self also includes -erfc(alpha R)/(2 R) times the square of each molecule's charge, with
    the cutoff R. This is 0 for neutral molecules"""
    ewald_surface_permittivity: Permittivity = inf
    """Permittivity of the medium around all periodic images. inf, a conductor, adds no surface
    term"""
    ewald_slab: Literal["x", "y", "z"] | None = None
    """With ewald and pme: the normal of a slab between empty parts of the box. Images along this
    axis then do not act"""
    pme_order: Annotated[int, Strict(), Field(ge=3, le=8)] | None = None
    """With pme: order of the B-splines. 4 is cubic"""
    pme_grid: tuple[GridSize, GridSize, GridSize] | None = None
    """With pme: number of grid points along each edge of the cell of the box or file. Use three
    equal numbers if its tilt is more than half an edge, because an equivalent cell then replaces
    it"""
    skin_A: Annotated[float, Strict(), Field(gt=0, le=100)] = 1.9
    """Extra radius of the neighbour list. It affects only the speed"""

    @property
    def added(self) -> dict[str, CustomForce | BodyForce]:
        """The tables of custom forces and pair potentials of bodies, by their keys."""
        tables = {"custom": self.custom, "bodies": self.bodies}
        return {
            f"forces.{key}.{k}": entry
            for key, entries in tables.items()
            for k, entry in enumerate(entries)
        }

    def _errors(self):
        if (
            self.switch_start_A is not None
            and "switch" not in f"{self.truncation} {self.reaction_field_truncation}"
        ):
            yield (
                f"switch_start_A would have no effect with truncation = {self.truncation!r}: add"
                " truncation = 'switch'"
            )
        if self.dispersion == "cutoff":
            names = (f"dispersion_{key}" for key in ("accuracy", "beta_per_A", "order", "grid"))
            idle = [key for key in names if getattr(self, key) is not None]
            yield from (
                f"{key} would have no effect with dispersion = 'cutoff' (the default)"
                for key in idle
            )
        else:
            yield from (
                f"dispersion = {self.dispersion!r}: {why}"
                for why, wrong in self._not_summable
                if wrong
            )
        yield from self.idle_key_errors(self.electrostatics or PERIODIC)
        if self.ewald_k2_max is not None and self.ewald_k_max is None:
            yield "ewald_k2_max needs ewald_k_max too"
        if self.ewald_k2_max is not None and self.ewald_k_radius_per_A is not None:
            yield "give ewald_k2_max or ewald_k_radius_per_A, not both"
        if self.ewald_slab is not None and self.ewald_surface_permittivity < inf:
            yield "give ewald_slab or ewald_surface_permittivity, not both"
        determined = self.sets_k_vectors or (
            self.pme_grid is not None and self.pme_order is not None
        )
        if determined and self.ewald_alpha_per_A is not None and self.ewald_accuracy is not None:
            yield "ewald_accuracy would have no effect: alpha and k-vectors or grid are given"

    @property
    def _not_summable(self) -> tuple[tuple[str, object], ...]:
        """Messages on keys that exclude a sum of dispersion, and whether they are set."""
        grid = self.dispersion_order or self.dispersion_grid
        return (
            (
                "only Lennard-Jones forces have such a sum. lennard_jones is false",
                not self.lennard_jones,
            ),
            (
                (
                    "custom forces have no such sum, so that a part of the dispersion would end at"
                    " the cutoff"
                ),
                self.custom,
            ),
            (
                "tail_correction would count what lies beyond the cutoff twice. Leave it out",
                self.tail_correction,
            ),
            (
                f"truncation = {self.truncation!r} would change the sum. Take 'shift' or 'plain'",
                self.truncation not in ("shift", "plain"),
            ),
            (
                "dispersion_order and dispersion_grid belong to 'pme'",
                self.dispersion == "ewald" and grid,
            ),
        )

    @property
    def idle_keys(self) -> list[str]:
        """The keys that have no effect with the method of electrostatics."""
        return _idle_keys(self.electrostatics or PERIODIC)

    def idle_key_errors(self, method: str) -> Iterator[str]:
        """Messages on keys that have no effect with a method of electrostatics."""
        default = "" if self.electrostatics else " (the default)"
        for key in _idle_keys(method):
            if getattr(self, key) != type(self).model_fields[key].default:
                yield f"{key} would have no effect with electrostatics = {method!r}{default}"

    @property
    def sets_k_vectors(self) -> bool:
        """Whether the scene sets the k-vectors of an Ewald sum."""
        return self.ewald_k_max is not None or self.ewald_k_radius_per_A is not None


def _idle_keys(method: str) -> list[str]:
    """Keys of [forces] that have no effect with a method of electrostatics."""
    keys = dict.fromkeys(key for other in ELECTROSTATICS.values() for key in other.keys)
    return [key for key in keys if key not in ELECTROSTATICS[method].keys]
