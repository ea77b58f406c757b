"""Pair potentials of users: the sites that they act on, their parameters and their cutoff
schemes."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, sqrt
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from rigidmd.assemble.user_code.cutoffs import (
    LARGEST_AT_CUTOFF,
    PairPotentialError,
    ValuesAtCutoff,
    check_cutoff,
    energy_scale,
    minimum_beyond,
)
from rigidmd.assemble.user_code.tables import Columns, read_columns
from rigidmd.engines.system import System
from rigidmd.forces.neighbors.pair_loop import PairForces, pair_forces
from rigidmd.forces.neighbors.sites import exclusion_groups, sites_of
from rigidmd.forces.parts import Tail, gather_per_molecule, inner_pairs, sites_named, sum_of_tails
from rigidmd.forces.potentials.custom import CustomPotential, tail_of_pair
from rigidmd.forces.potentials.formulas import (
    DISTANCE,
    Formula,
    FormulaError,
    formula_of_function,
    formula_of_table,
)
from rigidmd.forces.potentials.truncation import (
    TRUNCATIONS,
    TruncationName,
    default_switch_start,
    short_cutoff_note,
    truncation_of,
    truncation_terms,
)
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import did_you_mean, not_none

Rule = Literal["geometric", "arithmetic", "harmonic"]
RULES: tuple[str, ...] = get_args(Rule)
Parameters = Mapping[str, float]
#: Largest error of the spline of a table without a warning, relative to its deepest energy.
SPLINE_ERROR = 0.01


class BoundPotential(NamedTuple):
    """A pair potential between the sites of a system."""

    term: PairForces
    formula: Formula
    tail: Tail | None  # where the scene has forces.tail_correction
    notes: list[str]
    warnings: list[str]


@dataclass(frozen=True)
class PairLaw:
    """A pair potential for `Simulation(scene, forces=[...])`, made by `pair_law`."""

    energy: "str | Callable | None"
    table: Columns | None
    constants: Parameters
    of_sites: Mapping[str, Parameters] | None  # None: from the models
    sites: tuple[str, ...]
    pairs: Mapping[tuple[str, str], Parameters]
    mixing: Mapping[str, Rule]
    truncation: TruncationName | None
    cutoff_A: float | None
    switch_start_A: float | None
    name: str
    formula_of_function: Formula | None = field(default=None, repr=False)

    def formula(self, cutoff: float) -> Formula:
        """The formula that is compiled.

        Raises
        ------
        PairPotentialError
        """
        try:
            if self.table is not None:
                r, energy, force, name = self.table
                return formula_of_table(r, energy, cutoff, force, name)
            if isinstance(self.energy, str):
                from rigidmd.forces.potentials.text_formulas import (
                    formula_of_text,  # SymPy is slow to import
                )

                return formula_of_text(self.energy, self.constants)
        except FormulaError as error:
            raise PairPotentialError(str(error)) from None
        return not_none(self.formula_of_function)

    def bind(self, system: System) -> BoundPotential:
        """The potential between the sites of a system.

        Raises
        ------
        PairPotentialError
            With all errors.
        """
        forces = system.scene.forces
        cutoff = self.cutoff_A or system.cutoff
        check_cutoff(cutoff, system)
        name: TruncationName = self.truncation or forces.truncation
        switch_start = self.switch_start_A or (
            forces.switch_start_A if cutoff == system.cutoff else None
        )
        if self.switch_start_A is not None and "switch" not in name:
            raise PairPotentialError(f"switch_start_A would do nothing with truncation = {name!r}")
        start = (switch_start or default_switch_start(name, cutoff)) if "switch" in name else cutoff
        if not start <= cutoff:
            raise PairPotentialError(
                f"switch_start_A = {start:g} is beyond the cutoff of {cutoff:g} Å"
            )
        formula = self.formula(cutoff)
        types = _SiteTypes(self, formula, system.species)
        indices = [
            np.flatnonzero([entry is not None for entry in entries]) for entries in types.of_species
        ]
        if not any(len(sites) for sites in indices):
            raise PairPotentialError("no site of the scene has its parameters")
        index = system.model.species
        offsets = [
            m.positions_body[sites] for m, sites in zip(system.species, indices, strict=True)
        ]
        sites = sites_of(index, offsets, system.model.inverse_inertia)
        kinds = [
            np.array([types.all.index(entry) for entry in entries if entry], int)
            for entries in types.of_species
        ]
        kind = gather_per_molecule(kinds, index)
        shape = truncation_of(name, cutoff, start)
        count = len(types.all)
        numbers = np.zeros((len(formula.kind._fields), count, count))  # type: ignore[attr-defined]  # a NamedTuple
        ends, acts = np.zeros((4, count, count)), np.zeros((count, count))
        members, tails = np.bincount(kind, minlength=count), []
        inner = inner_pairs(kinds, offsets, np.bincount(index, minlength=len(system.species)))
        faults: list[str] = []
        short: list[tuple[float, str]] = []
        unfinished: list[tuple[float, str]] = []
        thermal, scale = energy_scale(system)
        for i, j, of_pair in types.pairs(faults):
            try:
                numbers[:, i, j], radial = formula.numbers(of_pair), formula.radial(of_pair)
                ends[:, i, j] = truncation_terms(name, shape, radial)
                values = [] if cutoff == inf else [*radial(cutoff), *radial(0.9 * cutoff)]
                if forces.tail_correction and formula.shared:
                    raise FormulaError(
                        "a table is finite, and forces.tail_correction needs its energy beyond"
                    )
                if forces.tail_correction:
                    part = tail_of_pair(
                        radial, tuple(ends[:, i, j].tolist()), shape, inner.between(i, j)
                    )
                    pairs = float(members[i] * members[j]) * (1.0 if i == j else 2.0)
                    tails.append(
                        Tail(
                            pairs * part.energy_volume, pairs * part.pressure_square, part.constant
                        )
                    )
                if not np.isfinite([*values, *numbers[:, i, j], *ends[:, i, j]]).all():
                    raise FormulaError("it has no finite value at the cutoff")
            except (FormulaError, ArithmeticError, ValueError, TypeError) as error:
                faults.append(f"between {types.example(i)} and {types.example(j)}: {error}")
            else:
                between = f"{types.example(i)} and {types.example(j)}"
                if minimum := minimum_beyond(cutoff, radial):
                    short.append((minimum, between))
                end = ValuesAtCutoff.of(radial, cutoff, ends_there=bool(formula.shared))
                if end.lost(name) > LARGEST_AT_CUTOFF * thermal:
                    unfinished.append((end.lost(name), end.describe(between, name, thermal, scale)))
            numbers[:, j, i], ends[:, j, i] = numbers[:, i, j], ends[:, i, j]
            acts[i, j] = acts[j, i] = 1.0
        if faults:
            raise PairPotentialError(*dict.fromkeys(faults))
        if not acts.any():
            raise PairPotentialError("no pair of sites of the scene has parameters")
        first = np.argwhere(acts)[0]
        potential = CustomPotential(
            cutoff,
            shape,
            formula.kind(*(float(x) for x in numbers[:, first[0], first[1]])),
            formula.shared,
            kind.astype(np.int32),
            np.where(acts > 0, numbers, numbers[:, first[0], first[1]][:, None, None]),
            ends,
            acts,
        )
        term = pair_forces(
            potential, sites, exclusion_groups(sites, (system.model.inverse_mass == 0)[index])
        )
        notes = [short_cutoff_note(cutoff, max(short)[1], max(short)[0])] if short else []
        warnings = [max(unfinished)[1]] if unfinished else []
        if formula.error > SPLINE_ERROR:
            advice = "use smaller intervals"
            warnings.append(
                f"the error of its spline is {formula.error:.1e} of its deepest energy: {advice}"
            )
        return BoundPotential(term, formula, sum_of_tails(tails), notes, warnings)


class _SiteTypes:
    """Types of sites: a type has the same parameters and is in the same entries of `pairs`."""

    def __init__(self, potential: PairLaw, formula: Formula, species: list[Molecule]):
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
        """Parameters of a site, and whether it is each site of `pairs`; None if the potential does
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
            b, usual = second[name], "arithmetic" if name.lower().startswith("sig") else "geometric"
            if a == b:
                mixed[name] = a
            elif (rule := self._potential.mixing.get(name, usual)) == "arithmetic":
                mixed[name] = (a + b) / 2
            elif rule == "geometric" and a * b >= 0:
                mixed[name] = sqrt(a * b) * (-1.0 if a < 0 or b < 0 else 1.0)
            elif rule == "harmonic" and a + b != 0:
                mixed[name] = 2 * a * b / (a + b)
            else:
                what = (
                    f"{name} of {self.example(i)} and {self.example(j)}, {a:g} and {b:g}, have no"
                    f" {rule} mean"
                )
                faults.append(
                    f"{what}: give {name} of that pair in pairs, or another rule in mixing"
                )
                return None
        return mixed


def pair_law(
    energy: "str | Callable | None" = None,
    parameters: Mapping[str, Any] | None = None,
    *,
    table: "tuple[Sequence[float], ...] | str | Path | None" = None,
    sites: Sequence[str] = (),
    pairs: Mapping[tuple[str, str], Any] | None = None,
    mixing: Mapping[str, Rule] | None = None,
    truncation: TruncationName | None = None,
    cutoff_A: float | None = None,
    switch_start_A: float | None = None,
    name: str = "",
) -> PairLaw:
    """A pair potential between sites of different molecules, for `Simulation(scene, forces=[...])`.

    rigidmd.pair_law("A*exp(-B*r) - C/r**6", {"Ar": {"A": 1.6e6, "B": 4.4, "C": 6.2e3}})

    Parameters
    ----------
    energy
        The energy in kJ/mol of the distance r in Å and of named parameters, as a text: + - * / **
        and exp, log, sqrt, sin, cos; its force is its derivative. Or a function f(p, r) that gives
        (energy, -dE/dr), where p has the parameters; it may also have the arguments r2 (r²) and
        inverse (1/r), and is compiled for vectors
    parameters
        Site -> parameters of sites of this kind, named by site, SPECIES.SITE or element: a
        dictionary, or the NamedTuple that a function expects. Or plain numbers, the same for all
        sites. Default: `parameters` of the sites in the models' files
    table
        Instead of an energy, distances in Å, energies in kJ/mol and perhaps forces -dE/dr in
        kJ/mol/Å, which a spline interpolates; or a file with these columns. Nearer than the first
        distance the energy rises as r⁻¹²
    sites
        The only sites that it acts on
    pairs
        (site, site) -> parameters of a pair, instead of mixed ones. Without `parameters`, it acts
        on them only
    mixing
        Parameter -> "geometric", "arithmetic" or "harmonic", the mean for unlike sites; default:
        arithmetic for names that begin with sig, else geometric
    truncation, switch_start_A, cutoff_A
        As in [forces] of the scene, which are the defaults
    name
        In the log and in messages

    Raises
    ------
    ValueError
    """
    if (energy is None) == (table is None):
        raise ValueError("needs an energy or a table")
    if truncation is not None and truncation not in TRUNCATIONS:
        hint = did_you_mean(truncation, TRUNCATIONS)
        raise ValueError(f"truncation is {truncation!r}{hint}; there are {', '.join(TRUNCATIONS)}")
    for what, table_of_names in (("mixing", mixing), ("pairs", pairs)):
        if table_of_names is not None and not isinstance(table_of_names, Mapping):
            raise ValueError(f"{what} is {table_of_names!r:.60}, must be a dictionary")
    columns = read_columns(Path(table)) if isinstance(table, str | Path) else None
    if columns is None and table is not None:
        if not (isinstance(table, tuple | list) and len(table) in (2, 3)):
            raise ValueError(
                "table must be a file, or lists: distances in Å, energies in kJ/mol, perhaps forces"
            )
        columns = Columns(table[0], table[1], table[2] if len(table) > 2 else None)
    if not isinstance(name, str):
        raise ValueError(f"name is {name!r:.60}, must be a text")
    for parameter, rule in (mixing or {}).items():
        if rule not in RULES:
            raise ValueError(f"mixing of {parameter} is {rule!r}; there are {', '.join(RULES)}")
    parameter_sets = [*([] if parameters is None else [parameters]), *(pairs or {}).values()]
    constants, of_sites, of_pairs = {}, {} if pairs else None, {}
    if parameters is not None:
        parameters = _mapping("parameters", parameters)
        parameter_sets[1:1] = parameters.values()
        flat = [
            key for key, value in parameters.items() if isinstance(value, int | float | np.number)
        ]
        if flat and len(flat) < len(parameters):
            others = ", ".join(str(key) for key in parameters if key not in flat)
            either = (
                "parameters are either numbers, the same for all sites, or tables of numbers by"
                " site"
            )
            raise ValueError(f"{either}; {flat[0]} is a number, and {others} is not")
        constants = _numbers("parameters", parameters) if flat else {}
        if flat:
            of_sites = {}
        else:
            of_sites = {key: _numbers(f"parameters of {key}", x) for key, x in parameters.items()}
    for key, value in (pairs or {}).items():
        if not (
            isinstance(key, tuple) and len(key) == 2 and all(isinstance(one, str) for one in key)
        ):
            raise ValueError(f"pairs: {key!r} is not a pair of names of sites")
        of_pairs[key] = _numbers(f"parameters of {'-'.join(key)}", value)
    for key, value in (("cutoff_A", cutoff_A), ("switch_start_A", switch_start_A)):
        if value is not None and (
            isinstance(value, bool) or not isinstance(value, int | float) or not value > 0
        ):
            raise ValueError(f"{key} is {value!r}, must be a number above 0")
    usual = "table" if table is not None else getattr(energy, "__name__", "pair_law")
    # a NamedTuple that a function expects
    kinds = [type(value) for value in parameter_sets if hasattr(value, "_asdict")]
    kind = kinds[-1] if kinds else None
    if energy is not None and not isinstance(energy, str):
        formula = formula_of_function(energy, kind)
    else:
        formula = None
    return PairLaw(
        energy,
        columns,
        constants,
        of_sites,
        tuple(sites),
        of_pairs,
        dict(mixing or {}),
        truncation,
        cutoff_A,
        switch_start_A,
        name or ("pair_law" if usual == "<lambda>" else usual),
        formula,
    )


def _mapping(where: str, table: Any) -> Mapping[str, Any]:
    """A dictionary, or the fields of a NamedTuple. Raises ValueError."""
    table = table._asdict() if hasattr(table, "_asdict") else table
    if not isinstance(table, Mapping):
        raise ValueError(f"{where}: {table!r:.60} is not a table of numbers")
    return table


def _numbers(where: str, table: Any) -> dict[str, float]:
    """Parameters as a dictionary of finite numbers. Raises ValueError."""
    table = _mapping(where, table)
    for key, value in table.items():
        if (
            not isinstance(value, int | float | np.number)
            or isinstance(value, bool)
            or not isfinite(value)
        ):
            raise ValueError(f"{where}: {key} is {value!r}, must be a finite number")
    if taken := [key for key in table if key in (DISTANCE, "pi")]:
        raise ValueError(
            f"{where}: {taken[0]} is the {'distance' if taken[0] == DISTANCE else 'number pi'};"
            " rename it"
        )
    return {str(key): float(value) for key, value in table.items()}
