"""The force field of a system as another program would see it: kinds of sites, and pair potentials
between kinds.

The engines LAMMPS and OpenMM and the exports to LAMMPS, OpenMM and GROMACS are made from this view.
It is read from the terms that rigidmd itself runs, so that mixing rules, special pairs and
truncation are decided once. `unknown_terms` lists what no other program can express.
"""

from collections.abc import Callable, Iterator, Mapping
from itertools import product
from math import inf
from typing import NamedTuple, TypeVar

import numpy as np

from rigidmd.engines.system import System
from rigidmd.features.potentials.expressions.slopes import function_of, slopes_of
from rigidmd.features.potentials.expressions.trace import Graph, Traced
from rigidmd.features.potentials.extra import body_pairs_of
from rigidmd.forces.ewald.corrections import Background, SurfaceDipole
from rigidmd.forces.ewald.direct_sum import EwaldSum
from rigidmd.forces.ewald.pme import Pme
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.parts import gather_per_molecule
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.lennard_jones import LennardJones
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce, ScreenedCoulomb
from rigidmd.forces.potentials.truncation import (
    ForceShifted,
    SmoothlySwitched,
    Switched,
    Truncation,
)
from rigidmd.forces.terms import trait
from rigidmd.scene import MolecularScene

#: Classes of the pair potentials and terms that the view describes.
DESCRIBED = (
    LennardJones,
    ReactionField,
    DampedShiftedForce,
    ScreenedCoulomb,
    EwaldSum,
    Pme,
    Background,
)
#: The switching function S of t = (r - start)/(cutoff - start), see `forces.potentials.truncation`.
SWITCHES: dict[type, str] = {
    Switched: "1-10*t^3+15*t^4-6*t^5",
    SmoothlySwitched: "1-126*t^5+420*t^6-540*t^7+315*t^8-70*t^9",
}


class SiteKind(NamedTuple):
    """Sites with the same element, mass, charge and Lennard-Jones parameters."""

    name: str  # species.site of the first one
    element: str
    mass: float  # u; 0 for a massless site
    charge: float  # e


class ForceFieldView(NamedTuple):
    """The sites of a system (s, in its order) and their pair potentials, independent of any
    engine."""

    system: System
    kinds: list[SiteKind]
    kind: np.ndarray  # (s,) index into `kinds`
    frozen: np.ndarray  # (n,) whether each molecule is frozen
    sigma: np.ndarray  # (kinds, kinds) Å
    epsilon: np.ndarray  # (kinds, kinds) u Å²/ps²; 0 where there is no Lennard-Jones force
    lennard_jones: LennardJones | None
    coulomb: ReactionField | DampedShiftedForce | ScreenedCoulomb | None

    @property
    def scene(self) -> MolecularScene:
        return self.system.scene

    @property
    def truncation(self) -> str:
        return self.scene.forces.truncation

    @property
    def is_truncated(self) -> bool:
        """Whether `truncation` matters."""
        return self.system.cutoff < inf and self.lennard_jones is not None

    @property
    def has_barostat(self) -> bool:
        return any(stage.has_barostat for stage in self.scene.stages)

    @property
    def electrostatics(self) -> str:
        """The electrostatics of the scene. "none" if no site has a charge."""
        return (self.scene.forces.electrostatics or "none") if self.coulomb else "none"

    @property
    def has_ewald_sum(self) -> bool:
        return isinstance(self.coulomb, ScreenedCoulomb)

    @property
    def is_periodic(self) -> bool:
        return self.system.space.volume < inf

    @property
    def charge(self) -> np.ndarray:
        """Charges (s,) in e."""
        return np.array([kind.charge for kind in self.kinds])[self.kind]

    @property
    def is_body(self) -> np.ndarray:
        """Whether each molecule (n,) is a rigid body that rotates. All others are points or
        frozen."""
        return (
            np.array([m.inertia.any() for m in self.system.species])[self.system.model.species]
            & ~self.frozen
        )


def force_field_of(system: System) -> ForceFieldView:
    """The force field of a system. It omits the terms that `unknown_terms` lists."""
    index = system.model.species
    per_species = zip(system.species, _lennard_jones_kinds(system), strict=True)
    parameters = [
        list(zip(m.elements, m.masses.tolist(), m.charges.tolist(), k, strict=True))
        for m, k in per_species
    ]
    first: dict[tuple, str] = {}  # parameters of a kind -> name of its first site
    for m, of_sites in zip(system.species, parameters, strict=True):
        for site, of_site in zip(m.site_names, of_sites, strict=True):
            first.setdefault(of_site, f"{m.name}.{site}")
    order = {of_kind: k for k, of_kind in enumerate(first)}
    kinds = [SiteKind(name, *of_kind[:3]) for of_kind, name in first.items()]
    of_species = [np.array([order[of_site] for of_site in of_sites]) for of_sites in parameters]
    lennard_jones = _potential(system, "lennard_jones", LennardJones)
    sigma, epsilon = np.ones((len(first), len(first))), np.zeros((len(first), len(first)))
    for (i, one), (j, other) in product(enumerate(of_kind[3] for of_kind in first), repeat=2):
        if lennard_jones and one >= 0 and other >= 0 and lennard_jones.c6[one, other] != 0:
            c12, c6 = lennard_jones.c12[one, other], lennard_jones.c6[one, other]
            sigma[i, j], epsilon[i, j] = (c12 / c6) ** (1 / 6), c6**2 / (4 * c12)
    coulomb = _potential(system, "coulomb", ReactionField) or _potential(
        system, "coulomb", DampedShiftedForce
    )
    return ForceFieldView(
        system,
        kinds,
        gather_per_molecule(of_species, index),
        (system.model.inverse_mass == 0)[index],
        sigma,
        epsilon,
        lennard_jones,
        coulomb or _potential(system, "coulomb_real", ScreenedCoulomb),
    )


def unknown_terms(
    system: System, title: str, body_pairs: Mapping[type, Callable[..., Iterator[str]]]
) -> Iterator[str]:
    """Messages on what acts on a system and is not in its view, for the engine with a title.

    body_pairs : see `external.Translations`
    """
    titles = {name: x for extra in system.extras.values() for name, x in extra.titles.items()}
    for name, term in system.terms.items():
        if potential := body_pairs_of(system).get(name):
            if limits := body_pairs.get(type(potential.function)):
                yield from (f"{name}: {message}" for message in limits(potential, system))
            else:
                yield f"{name}: a potential of two bodies has no translation for {title}"
            continue
        kind = type(term.potential if isinstance(term, PairForces) else term)
        what = "a user-defined force"
        if name not in system.user_terms:
            is_field = trait(term, "changes_momentum") is not None
            what = "a field" if is_field else f"the term {kind.__name__}"
            what = f"the pair potential {kind.__name__}" if isinstance(term, PairForces) else what
            what = titles.get(name, what)
            if kind is SurfaceDipole:
                what = "forces.ewald_slab or ewald_surface_permittivity"
        if name in system.user_terms or kind not in DESCRIBED:
            yield f"{name.replace('_', ' ')}: {what} has no translation for {title}"
    if system.thermostat is not None:
        yield f"a user-defined thermostat has no translation for {title}"


Potential = TypeVar("Potential")


def _potential(system: System, name: str, kind: type[Potential]) -> Potential | None:
    """The pair potential of a term if it is of a class, else None."""
    term = system.terms.get(name)
    if isinstance(term, PairForces) and isinstance(term.potential, kind):
        return term.potential
    return None


def _lennard_jones_kinds(system: System) -> list[list[int]]:
    """The Lennard-Jones kind of each site of each species. -1 for sites without Lennard-Jones
    forces."""
    kinds = [[-1] * len(m.masses) for m in system.species]
    term = system.terms.get("lennard_jones")
    potential = _potential(system, "lennard_jones", LennardJones)
    if potential is None or not isinstance(term, PairForces):
        return kinds
    sites = term.sites
    for k, member in zip(*np.unique(system.model.species, return_index=True), strict=True):
        of_member = slice(sites.first[member], sites.first[member + 1])
        positions = system.species[k].positions_body
        for kind, offset in zip(potential.kind[of_member], sites.offsets()[of_member], strict=True):
            kinds[k][int(np.linalg.norm(positions - offset, axis=1).argmin())] = int(kind)
    return kinds


# Pair potentials as formulas and tables of r, for engines that lack the potential with its
# truncation. Formulas are in the syntax of Lepton, OpenMM's parser: x^2, max, erfc, and definitions
# after semicolons.


def lennard_jones_formula(potential: LennardJones, c12: float, c6: float, unit: float) -> str:
    """Energy of two sites with c12/r¹² - c6/r⁶, r in Å, in units of `unit` u Å²/ps²."""
    twelve, six = float(c12 / unit), float(c6 / unit)
    end = tuple(
        twelve * of12 - six * of6
        for of12, of6 in zip(potential.terms12, potential.terms6, strict=True)
    )
    return _truncated(f"{twelve!r}/r^12-{six!r}/r^6", potential.truncation, end)


def coulomb_formula(potential: ReactionField | DampedShiftedForce, strength: float) -> str:
    """Energy of two charges that is strength/r without truncation, r in Å."""
    strength = float(strength)
    if isinstance(potential, DampedShiftedForce):
        slope, shift = float(potential.slope), float(potential.shift)
        return f"{strength!r}*(erfc({potential.alpha!r}*r)/r+{slope!r}*r+({shift!r}))"
    end = tuple(strength * part for part in potential.terms)
    return _truncated(
        f"{strength!r}/r+({strength * potential.field!r})*r^2", potential.truncation, end
    )


def _truncated(formula: str, truncation: Truncation, end: tuple[float, ...]) -> str:
    """A formula with a truncation and its terms, see `forces.potentials.truncation`."""
    constant, linear, quadratic, cubic = (float(part) for part in end)
    shifted = f"{formula}+({constant!r})" if constant else formula
    if isinstance(truncation, ForceShifted):
        added = f"x*({linear!r})+x^3*({quadratic / 3!r})+x^4*({cubic / 4!r})"
        return f"{shifted}-({added}); x=max(0,r-{float(truncation.start)!r})"
    if isinstance(truncation, Switched | SmoothlySwitched):
        width = float(truncation.cutoff - truncation.start)
        return (
            f"({shifted})*({SWITCHES[type(truncation)]});"
            f" t=max(0,(r-{float(truncation.start)!r})/{width!r})"
        )
    return shifted


def table(formula: str, first: float, last: float, entries: int) -> str:
    """A table for LAMMPS' pair style `table`, even in r² from `first` to `last` Å: number, r,
    energy, force."""
    r = Graph().leaf("r")
    energy = _traced(formula, r)
    x = np.sqrt(np.linspace(first**2, last**2, entries))
    columns = function_of([energy, -slopes_of(energy, [r])[0]], "r", np)(x)
    rows = zip(*np.broadcast_arrays(x, *columns), strict=True)
    head = f"N {entries} RSQ {first:.17g} {last:.17g}\n\n"
    return head + "".join(
        f"{k} {x:.15g} {u:.15g} {f:.15g}\n" for k, (x, u, f) in enumerate(rows, 1)
    )


def _traced(formula: str, r: Traced) -> Traced:
    """A formula as a function of r."""
    text, *definitions = (part.strip() for part in formula.replace("^", "**").split(";"))
    names = {"r": r, "max": np.maximum, "erfc": Traced.erfc}
    for definition in reversed(definitions):
        name, _, value = definition.partition("=")
        names[name] = eval(value, names)
    return eval(text, names)
