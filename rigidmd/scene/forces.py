"""The table [forces] of a scene of molecules: forces between sites."""

from collections.abc import Iterator
from math import inf
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, Strict

from rigidmd.scene.models import Mixing
from rigidmd.scene.of_features import PotentialKeys
from rigidmd.scene.truncation import TruncationName
from rigidmd.scene.validation import (
    MOST_TABLES,
    Count,
    Cutoff,
    Flag,
    NonNegative,
    Positive,
    Section,
)

Permittivity = Annotated[float, Strict(), Field(ge=1)]
KIndex = Annotated[int, Strict(), Field(ge=0, le=1000)]
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


class UnlikePair(Section):
    """Lennard-Jones parameters for two kinds of sites, which replace the mixing rule."""

    sites: tuple[str, str]
    """The two kinds: a site name or else an element. `SPECIES.NAME` for sites of one species"""
    sigma_A: Positive
    """Lennard-Jones diameter"""
    epsilon_kJ_mol: NonNegative
    """Lennard-Jones well depth"""


class LennardJonesKeys(Section):
    """The keys of Lennard-Jones forces."""

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


class Forces(PotentialKeys, LennardJonesKeys):
    """Forces between sites of different molecules."""

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
            *self.added_not_summable,
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
