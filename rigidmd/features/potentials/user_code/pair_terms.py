"""The term of a user's pair potential in a system: its sites, the parameters of each pair of them,
and where it is cut off."""

import re
from collections.abc import Callable, Iterator
from functools import partial
from math import inf, nan, sqrt
from typing import NamedTuple, cast

import numpy as np

from rigidmd.engines.system import System
from rigidmd.features.potentials.sites.custom import CustomPotential, tail_of_pair
from rigidmd.features.potentials.sites.formulas import Formula, FormulaError, Radial
from rigidmd.features.potentials.user_code.cutoffs import (
    LARGEST_AT_CUTOFF,
    PairPotentialError,
    ValuesAtCutoff,
    check_cutoff,
    check_lengths,
    contact_of,
    energy_scale,
    minimum_beyond,
    not_finite,
    start_distances,
)
from rigidmd.features.potentials.user_code.force import BoundTerm
from rigidmd.features.potentials.user_code.pair_potential import PairPotential, Parameters
from rigidmd.forces.neighbors.pair_loop import PairForces, pair_forces
from rigidmd.forces.neighbors.sites import compute_site_positions, exclusion_groups, sites_of
from rigidmd.forces.parts import (
    InnerPairs,
    Tail,
    gather_per_molecule,
    inner_pairs,
    sites_named,
    sum_of_tails,
)
from rigidmd.forces.potentials.truncation import (
    Truncation,
    TruncationTerms,
    default_switch_start,
    short_cutoff_note,
    truncation_of,
    truncation_terms,
)
from rigidmd.scene.models import Molecule
from rigidmd.scene.truncation import TruncationName
from rigidmd.scene.validation import did_you_mean

#: Largest error of the spline of a table without a warning, relative to its deepest energy.
SPLINE_ERROR = 0.01


class CutoffScheme(NamedTuple):
    """Where a pair potential is cut off, and how."""

    distance: float  # Å
    name: TruncationName
    truncation: Truncation

    def __str__(self) -> str:
        return "no cutoff" if self.distance == inf else f"cutoff {self.distance:g} Å, {self.name}"


def cutoff_scheme(potential: PairPotential, system: System) -> CutoffScheme:
    """The cutoff scheme of the potential, or of the scene. Raises PairPotentialError."""
    forces = system.scene.forces
    cutoff = potential.cutoff_A or system.cutoff
    check_cutoff(cutoff, system)
    name: TruncationName = potential.truncation or forces.truncation
    if "switch" not in name:
        if potential.switch_start_A is not None:
            raise PairPotentialError(
                f"switch_start_A would have no effect with truncation = {name!r}"
            )
        return CutoffScheme(cutoff, name, truncation_of(name, cutoff, cutoff))
    of_scene = forces.switch_start_A if cutoff == system.cutoff else None
    start = potential.switch_start_A or of_scene or default_switch_start(name, cutoff)
    if not start <= cutoff:
        raise PairPotentialError(f"switch_start_A = {start:g} is beyond the cutoff of {cutoff:g} Å")
    return CutoffScheme(cutoff, name, truncation_of(name, cutoff, start))


class BoundPair(NamedTuple):
    """A pair potential between two types of sites."""

    radial: Radial
    numbers: tuple[float, ...]  # the fields of its formula
    terms: TruncationTerms
    tail: Tail | None  # of one pair of sites; where the scene has forces.tail_correction


def bound_pair(
    formula: Formula, parameters: Parameters, scheme: CutoffScheme, tail_without: InnerPairs | None
) -> BoundPair:
    """The potential with the parameters of a pair.

    tail_without : the pairs inside molecules, which a tail correction omits. None without a
        tail correction

    Raises FormulaError, ArithmeticError, ValueError or TypeError, from the formula.
    """
    numbers, radial = formula.numbers(parameters), formula.radial(parameters)
    terms = truncation_terms(scheme.name, scheme.truncation, radial)
    at_cutoff: list[float] = []
    if scheme.distance < inf:
        at_cutoff = [*radial(scheme.distance), *radial(0.9 * scheme.distance)]
    tail = None
    if tail_without is not None:
        if formula.shared:
            raise FormulaError(
                "a table is finite, and forces.tail_correction needs its energy beyond"
            )
        tail = tail_of_pair(radial, terms, scheme.truncation, tail_without)
    if not np.isfinite([*at_cutoff, *numbers, *terms]).all():
        raise FormulaError("it has no finite value at the cutoff")
    return BoundPair(radial, numbers, terms, tail)


def bind_pair_potential(potential: PairPotential, system: System) -> BoundTerm:
    """The potential between the sites of a system.

    Raises
    ------
    PairPotentialError
        With all errors.
    """
    scheme = cutoff_scheme(potential, system)
    formula = potential.formula(scheme.distance)
    types = SiteTypes(potential, formula, system.species)
    indices = [np.flatnonzero([one is not None for one in sites]) for sites in types.of_species]
    if not any(len(sites) for sites in indices):
        raise PairPotentialError("no site of the scene has its parameters")
    index = system.model.species
    offsets = [m.positions_body[k] for m, k in zip(system.species, indices, strict=True)]
    sites = sites_of(index, offsets, system.model.inverse_inertia)
    kinds = [
        np.array([types.all.index(one) for one in of_sites if one], int)
        for of_sites in types.of_species
    ]
    kind = gather_per_molecule(kinds, index)
    pairs = _bound_pairs(types, formula, scheme, system, (kinds, offsets))
    contacts = [
        contact_of(_energies(pair.radial), scheme.distance, system) for pair in pairs.values()
    ]
    check_lengths(min(contacts), "its sites", scheme.distance, potential.switch_start_A)
    term = pair_forces(
        _compiled_potential(pairs, formula, scheme, kind, len(types.all)),
        sites,
        exclusion_groups(sites, (system.model.inverse_mass == 0)[index]),
    )
    notes, warnings = _findings_at_cutoff(types, pairs, formula, scheme, system)
    members = np.bincount(kind, minlength=len(types.all))
    return BoundTerm(
        term,
        f"{formula.text}, {len(term.group)} sites, {scheme}",
        tail=sum_of_tails(list(_tails(pairs, members))),
        notes=notes,
        warnings=warnings,
        errors_at=partial(_errors_at, term, pairs, types),
    )


def _errors_at(
    term: PairForces, pairs: dict[tuple[int, int], BoundPair], types: "SiteTypes", system: System
) -> list[str]:
    """Messages on types of sites without a finite energy and force between their nearest ones and
    the cutoff."""
    potential = cast(CustomPotential, term.potential)
    position = np.empty((len(potential.kind), 3))
    compute_site_positions(term.sites, system.state, position)
    start = start_distances(position, potential.kind, term.group, potential.cutoff, system)
    errors = []
    for (i, j), distances in start.items():
        if (i, j) not in pairs:
            continue
        for r in distances.tolist():
            try:
                is_finite = np.isfinite(pairs[i, j].radial(r)[:2]).all()
            except (FormulaError, ArithmeticError, ValueError):
                is_finite = False
            if not is_finite:
                errors.append(not_finite(f"{types.example(i)} and {types.example(j)}", r))
                break
    return errors


def _bound_pairs(
    types: "SiteTypes",
    formula: Formula,
    scheme: CutoffScheme,
    system: System,
    of_species: tuple[list[np.ndarray], list[np.ndarray]],
) -> dict[tuple[int, int], BoundPair]:
    """The potential of each pair of types that interact. Raises PairPotentialError with all errors.

    of_species : the types and the positions of the sites of each species
    """
    inside = None
    if system.scene.forces.tail_correction:
        counts = np.bincount(system.model.species, minlength=len(system.species))
        inside = inner_pairs(*of_species, counts)
    pairs = {}
    errors = list[str]()
    for i, j, parameters in types.pairs(errors):
        try:
            tail_without = None if inside is None else inside.between(i, j)
            pairs[i, j] = bound_pair(formula, parameters, scheme, tail_without)
        except (FormulaError, ArithmeticError, ValueError, TypeError) as error:
            errors.append(f"between {types.example(i)} and {types.example(j)}: {error}")
    if errors:
        raise PairPotentialError(*dict.fromkeys(errors))
    if not pairs:
        raise PairPotentialError("no pair of sites of the scene has parameters")
    return pairs


def _energies(radial: Radial) -> Callable[[np.ndarray], np.ndarray]:
    """The energy as a function of distances; NaN where it has none."""

    def energy(r: float) -> float:
        try:
            return radial(r)[0]
        except (FormulaError, ArithmeticError, ValueError):
            return nan

    return lambda distances: np.array([energy(r) for r in distances.tolist()])


def _compiled_potential(
    pairs: dict[tuple[int, int], BoundPair],
    formula: Formula,
    scheme: CutoffScheme,
    kind: np.ndarray,
    count: int,
) -> CustomPotential:
    """What the pair loop reads: tables by two of the `count` types of sites."""
    first = next(iter(pairs.values()))
    # a type without interaction has the numbers of any other, so that its energy is finite
    numbers = np.tile(np.array(first.numbers)[:, None, None], (count, count))
    terms = np.zeros((4, count, count))
    interacts = np.zeros((count, count))
    for (i, j), pair in pairs.items():
        for one, other in ((i, j), (j, i)):
            numbers[:, one, other] = pair.numbers
            terms[:, one, other] = pair.terms
            interacts[one, other] = 1.0
    return CustomPotential(
        scheme.distance,
        scheme.truncation,
        formula.kind(*map(float, first.numbers)),
        formula.shared,
        kind.astype(np.int32),
        numbers,
        terms,
        interacts,
    )


def _tails(pairs: dict[tuple[int, int], BoundPair], members: np.ndarray) -> Iterator[Tail]:
    """The tail correction of each pair of types; members : the sites of each type."""
    for (i, j), pair in pairs.items():
        if (tail := pair.tail) is not None:
            count = float(members[i] * members[j]) * (1.0 if i == j else 2.0)
            yield Tail(count * tail.energy_volume, count * tail.pressure_square, tail.constant)


def _findings_at_cutoff(
    types: "SiteTypes",
    pairs: dict[tuple[int, int], BoundPair],
    formula: Formula,
    scheme: CutoffScheme,
    system: System,
) -> tuple[list[str], list[str]]:
    """Notes and warnings: a minimum beyond the cutoff, an energy that is not small there, and the
    error of a spline."""
    thermal, scale = energy_scale(system)
    minima: list[tuple[float, str]] = []
    losses: list[tuple[float, str]] = []
    for (i, j), pair in pairs.items():
        between = f"{types.example(i)} and {types.example(j)}"
        if minimum := minimum_beyond(scheme.distance, pair.radial):
            minima.append((minimum, between))
        values = ValuesAtCutoff.of(pair.radial, scheme.distance, ends_there=bool(formula.shared))
        if (lost := values.lost(scheme.name)) > LARGEST_AT_CUTOFF * thermal:
            losses.append((lost, values.describe(between, scheme.name, thermal, scale)))
    spline = f"the error of its spline is {formula.error:.1e} of its deepest energy"
    notes = [spline] if formula.error else []
    if minima:
        minimum, between = max(minima)
        notes.append(short_cutoff_note(scheme.distance, between, minimum))
    warnings = [max(losses)[1]] if losses else []
    if formula.error > SPLINE_ERROR:
        warnings.append(f"{spline}: use smaller intervals")
    return notes, warnings


class SiteTypes:
    """Types of sites: a type has the same parameters and is in the same entries of `pairs`."""

    def __init__(self, potential: PairPotential, formula: Formula, species: list[Molecule]):
        self._potential, self._formula = potential, formula
        known = dict.fromkeys(
            name for m in species for site in m.site_names for name in (site, f"{m.name}.{site}")
        )
        known |= dict.fromkeys(e for m in species for e in m.elements)
        listed = [
            *(potential.of_sites or {}),
            *potential.sites,
            *(name for pair in potential.pairs for name in pair),
        ]
        self._named = {name: sites_named(species, name) for name in listed}
        unknown = [
            name for name, sites in self._named.items() if not any(mask.any() for mask in sites)
        ]
        known_names = f"; there are {', '.join(known)}"
        faults = [
            f"no site is {name!r}{did_you_mean(name, known) or known_names}" for name in unknown
        ]
        self._needed = [
            name
            for name in formula.parameters
            if name not in potential.constants and not formula.shared
        ]
        of_pairs = [("-".join(pair), parameters) for pair, parameters in potential.pairs.items()]
        for where, parameters in [*(potential.of_sites or {}).items(), *of_pairs]:
            faults += [
                f"{where}: there is no {name}" for name in self._needed if name not in parameters
            ]
            faults += [
                f"{where}: {self._unknown(name)}"
                for name in parameters
                if name not in formula.parameters
            ]
        if potential.of_sites == {} and not potential.pairs:
            faults += [f"there is no {name} among its parameters" for name in self._needed]
        # the formula may have the number of a constant in place of its name
        text = potential.energy if isinstance(potential.energy, str) else ""
        usable_names = {*formula.parameters, *re.findall(r"[^\W\d]\w*", text)}
        faults += [self._unknown(name) for name in potential.constants if name not in usable_names]
        faults += [
            f"mixing: {self._unknown(name)}"
            for name in potential.mixing
            if name not in formula.parameters
        ]
        twice = [
            pair for pair in potential.pairs if pair[0] < pair[1] and pair[::-1] in potential.pairs
        ]
        faults += [f"pairs: {'-'.join(pair)} is given twice" for pair in twice]
        if faults:
            raise PairPotentialError(*faults)
        self.of_species = [
            [self._kind(k, m, i) for i in range(len(m.masses))] for k, m in enumerate(species)
        ]
        self.all = sorted(
            {entry for sites in self.of_species for entry in sites if entry is not None}, key=repr
        )
        self._first = {
            entry: f"{m.name}.{m.site_names[i]}"
            for m, sites in reversed(list(zip(species, self.of_species, strict=True)))
            for i, entry in reversed(list(enumerate(sites)))
            if entry is not None
        }

    def _unknown(self, name: str) -> str:
        known = ", ".join(self._formula.parameters) or "none"
        return f"{name} is not a parameter of {self._formula.text!r}; there are {known}"

    def example(self, k: int) -> str:
        """A site of a type, for messages."""
        return self._first[self.all[k]]

    def _kind(self, k: int, m: Molecule, i: int) -> tuple | None:
        """Parameters of a site, and whether it is each site of `pairs`. None if the potential does
        not act on it."""
        parameters = self._parameters(k, m, i)
        sides = tuple(
            bool(self._named[name][k][i]) for pair in self._potential.pairs for name in pair
        )
        acts = parameters is not None or any(sides)
        if acts:
            return None if parameters is None else tuple(sorted(parameters.items())), sides
        return None

    def _parameters(self, k: int, m: Molecule, i: int) -> Parameters | None:
        potential = self._potential
        if potential.sites and not any(self._named[name][k][i] for name in potential.sites):
            return None
        if potential.of_sites is None and not self._formula.shared:
            parameters = m.parameters[i]
            if all(name in parameters for name in self._needed):
                return {name: parameters[name] for name in self._needed}
            return None
        if not potential.of_sites:
            return None if potential.pairs else {"scale": 1.0} if potential.of_sites is None else {}
        named = [name for name in potential.of_sites if self._named[name][k][i]]
        ranked = (
            f"{m.name}.{m.site_names[i]}",
            f"{m.name}.{m.elements[i]}",
            m.site_names[i],
            m.elements[i],
        )
        return next((potential.of_sites[name] for name in ranked if name in named), None)

    def pairs(self, faults: list[str]) -> Iterator[tuple[int, int, dict[str, float]]]:
        """Numbers i <= j of two types that interact, and the parameters between them."""
        for i, (parameters, sides) in enumerate(self.all):
            for j, (other_parameters, others) in enumerate(self.all[i:], i):
                mixed = None
                for n, values in enumerate(self._potential.pairs.values()):
                    if (sides[2 * n] and others[2 * n + 1]) or (sides[2 * n + 1] and others[2 * n]):
                        mixed = ({"scale": 1.0} if self._formula.shared else {}) | dict(values)
                if mixed is None and parameters is not None and other_parameters is not None:
                    mixed = self._mixed(dict(parameters), dict(other_parameters), i, j, faults)
                if mixed is not None:
                    yield i, j, dict(self._potential.constants) | mixed

    def _mixed(
        self, first: dict, second: dict, i: int, j: int, faults: list[str]
    ) -> dict[str, float] | None:
        mixed = {}
        for name, a in first.items():
            b = second[name]
            usual = "arithmetic" if name.lower().startswith("sig") else "geometric"
            if a == b:
                mixed[name] = a
            elif (rule := self._potential.mixing.get(name, usual)) == "arithmetic":
                mixed[name] = (a + b) / 2
            elif rule == "geometric" and a * b >= 0:
                mixed[name] = sqrt(a * b) * (-1.0 if a < 0 or b < 0 else 1.0)
            elif rule == "harmonic" and a + b != 0:
                mixed[name] = 2 * a * b / (a + b)
            else:
                faults.append(
                    f"{name} of {self.example(i)} and {self.example(j)}, {a:g} and {b:g}, have no"
                    f" {rule} mean: give {name} of that pair in pairs, or another rule in mixing"
                )
                return None
        return mixed
