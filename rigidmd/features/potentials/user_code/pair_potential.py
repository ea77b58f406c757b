"""Pair potentials of users: an energy with its parameters, mixing and cutoff scheme."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from rigidmd.features.potentials.sites.formulas import (
    DISTANCE,
    Formula,
    FormulaError,
    formula_of_function,
    formula_of_table,
    formula_of_text,
)
from rigidmd.features.potentials.user_code.cutoffs import PairPotentialError
from rigidmd.features.potentials.user_code.tables import Columns, read_columns
from rigidmd.forces.potentials.truncation import TRUNCATIONS
from rigidmd.scene.molecules import UserForce
from rigidmd.scene.truncation import TruncationName
from rigidmd.scene.validation import did_you_mean, not_none

Rule = Literal["geometric", "arithmetic", "harmonic"]
RULES: tuple[str, ...] = get_args(Rule)
Parameters = Mapping[str, float]
#: In the log, for the potential of a text or a lambda.
DEFAULT_NAME = "pair_potential"


@dataclass(frozen=True)
class PairPotential(UserForce):
    """A pair potential for `Simulation(scene, forces=[...])`, made by `pair_potential`.

    Attributes
    ----------
    energy : str, callable or None
        Energy as a function of the distance
    table : Columns or None
        Distances, energies and forces
    constants : dict of str to float
        Parameters that all sites have
    of_sites : dict or None
        Site -> parameters. None: from the models
    sites : tuple of str
        The only sites on which it acts. Empty for all
    pairs : dict
        (site, site) -> parameters of the pair
    mixing : dict of str to str
        Parameter -> mean for unlike sites
    truncation : str or None
        Cutoff scheme
    cutoff_A, switch_start_A : float or None
        Cutoff and start of the switch, Å
    name : str
        Name in the log and in messages
    """

    energy: "str | Callable | None"
    table: Columns | None
    constants: Parameters
    of_sites: Mapping[str, Parameters] | None
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

        Parameters
        ----------
        cutoff : float
            Cutoff, Å

        Returns
        -------
        Formula
            Energy and force as functions of the distance

        Raises
        ------
        PairPotentialError
            If the energy cannot be compiled.
        """
        try:
            if self.table is not None:
                r, energy, force, name = self.table
                return formula_of_table(r, energy, cutoff, force, name)
            if isinstance(self.energy, str):
                return formula_of_text(self.energy, self.constants)
        except FormulaError as error:
            raise PairPotentialError(str(error)) from None
        return not_none(self.formula_of_function)


def pair_potential(
    energy: "str | Callable | None" = None,
    parameters: Mapping[str, object] | None = None,
    *,
    table: "tuple[Sequence[float], ...] | str | Path | None" = None,
    sites: Sequence[str] = (),
    pairs: Mapping[tuple[str, str], object] | None = None,
    mixing: Mapping[str, Rule] | None = None,
    truncation: TruncationName | None = None,
    cutoff_A: float | None = None,
    switch_start_A: float | None = None,
    name: str = "",
) -> PairPotential:
    """A pair potential between sites of different molecules, for `Simulation(scene, forces=[...])`.

    Parameters
    ----------
    energy : str or callable, optional
        The energy in kJ/mol of the distance r in Å and of named parameters, as a text: + - * / **
        and exp, log, sqrt, sin, cos. Its force is its derivative. Or a function f(p, r) that gives
        (energy, -dE/dr), where p has the parameters. It may also have the arguments r2 (r²) and
        inverse (1/r), and is compiled for vectors
    parameters : dict, optional
        Site -> parameters of sites of this kind, named by site, SPECIES.SITE or element: a
        dictionary, or the NamedTuple that a function expects. Or plain numbers, the same for all
        sites. Default: `parameters` of the sites in the models' files
    table : tuple of arrays, str or Path, optional
        Instead of an energy, distances in Å, energies in kJ/mol and perhaps forces -dE/dr in
        kJ/mol/Å, which a spline interpolates, or a file with these columns. Nearer than the first
        distance the energy rises as r⁻¹²
    sites : sequence of str, optional
        The only sites that it acts on
    pairs : dict, optional
        (site, site) -> parameters of a pair, instead of mixed ones. Without `parameters`, it acts
        on them only
    mixing : dict of str to str, optional
        Parameter -> "geometric", "arithmetic" or "harmonic", the mean for unlike sites. Default:
        arithmetic for names that begin with sig, else geometric
    truncation : str, optional
        As in [forces] of the scene, which is the default
    cutoff_A, switch_start_A : float, optional
        As in [forces] of the scene, Å. Default: as there
    name : str, optional
        Name in the log and in messages. Default: the name of the function

    Returns
    -------
    PairPotential
        The potential

    Raises
    ------
    ValueError
        For arguments that contradict each other, or an energy that cannot be compiled.

    Examples
    --------
        rigidmd.pair_potential("A*exp(-B*r) - C/r**6", {"Ar": {"A": 1.6e6, "B": 4.4, "C": 6.2e3}})
    """
    if (energy is None) == (table is None):
        raise ValueError("needs an energy or a table")
    _check_names(name, truncation, mixing, pairs)
    for key, value in (("cutoff_A", cutoff_A), ("switch_start_A", switch_start_A)):
        if value is not None and (
            isinstance(value, bool) or not isinstance(value, int | float) or not value > 0
        ):
            raise ValueError(f"{key} is {value!r}, must be a number above 0")
    of_pairs = dict(pairs or {})
    parameter_sets = [parameters, *of_pairs.values()]
    if parameters is not None:
        parameter_sets[1:1] = _mapping("parameters", parameters).values()
    constants, of_sites = _constants_and_tables(parameters)
    formula = None
    if energy is not None and not isinstance(energy, str):
        # the NamedTuple that the function expects
        kinds = [type(value) for value in parameter_sets if hasattr(value, "_asdict")]
        formula = formula_of_function(energy, kinds[-1] if kinds else None)
    if not name:
        name = "table" if table is not None else getattr(energy, "__name__", DEFAULT_NAME)
    return PairPotential(
        energy=energy,
        table=None if table is None else _columns(table),
        constants=constants,
        of_sites={} if of_sites is None and of_pairs else of_sites,
        sites=tuple(sites),
        pairs={key: _numbers(f"parameters of {'-'.join(key)}", of_pairs[key]) for key in of_pairs},
        mixing=dict(mixing or {}),
        truncation=truncation,
        cutoff_A=cutoff_A,
        switch_start_A=switch_start_A,
        name=DEFAULT_NAME if name == "<lambda>" else name,
        formula_of_function=formula,
    )


def _check_names(
    name: str,
    truncation: TruncationName | None,
    mixing: Mapping[str, Rule] | None,
    pairs: Mapping[tuple[str, str], object] | None,
) -> None:
    """Raise ValueError for a name that is not a text, and for a choice that does not exist."""
    if not isinstance(name, str):
        raise ValueError(f"name is {name!r:.60}, must be a text")
    if truncation is not None and truncation not in TRUNCATIONS:
        hint = did_you_mean(truncation, TRUNCATIONS)
        raise ValueError(f"truncation is {truncation!r}{hint}; there are {', '.join(TRUNCATIONS)}")
    for what, table in (("mixing", mixing), ("pairs", pairs)):
        if table is not None and not isinstance(table, Mapping):
            raise ValueError(f"{what} is {table!r:.60}, must be a dictionary")
    for parameter, rule in (mixing or {}).items():
        if rule not in RULES:
            raise ValueError(f"mixing of {parameter} is {rule!r}; there are {', '.join(RULES)}")
    for key in pairs or {}:
        if not (isinstance(key, tuple) and [type(site) for site in key] == [str, str]):
            raise ValueError(f"pairs: {key!r} is not a pair of names of sites")


def _columns(table: object) -> Columns:
    """The table from a file, or from lists of numbers. Raises ValueError."""
    if isinstance(table, str | Path):
        return read_columns(Path(table))
    if not (isinstance(table, tuple | list) and len(table) in (2, 3)):
        raise ValueError(
            "table must be a file, or lists: distances in Å, energies in kJ/mol, perhaps forces"
        )
    return Columns(*table)


def _constants_and_tables(
    parameters: object,
) -> tuple[dict[str, float], dict[str, dict[str, float]] | None]:
    """Parameters of all sites, and parameters by site. None without either. Raises ValueError."""
    if parameters is None:
        return {}, None
    parameters = _mapping("parameters", parameters)
    numbers = [key for key, x in parameters.items() if isinstance(x, int | float | np.number)]
    if not numbers:
        return {}, {key: _numbers(f"parameters of {key}", x) for key, x in parameters.items()}
    if tables := [str(key) for key in parameters if key not in numbers]:
        raise ValueError(
            "parameters are either numbers, the same for all sites, or tables of numbers by site;"
            f" {numbers[0]} is a number, and {', '.join(tables)} is not"
        )
    return _numbers("parameters", parameters), {}


def _mapping(where: str, table: object) -> Mapping[str, object]:
    """A dictionary, or the fields of a NamedTuple. Raises ValueError."""
    as_dictionary = getattr(table, "_asdict", None)
    table = table if as_dictionary is None else as_dictionary()
    if not isinstance(table, Mapping):
        raise ValueError(f"{where}: {table!r:.60} is not a table of numbers")
    return table


def _numbers(where: str, table: object) -> dict[str, float]:
    """Parameters as a dictionary of finite numbers. Raises ValueError."""
    numbers: dict[str, float] = {}
    for key, value in _mapping(where, table).items():
        if (
            not isinstance(value, int | float | np.number)
            or isinstance(value, bool)
            or not isfinite(value)
        ):
            raise ValueError(f"{where}: {key} is {value!r}, must be a finite number")
        numbers[str(key)] = float(value)
    if taken := [key for key in numbers if key in (DISTANCE, "pi")]:
        raise ValueError(
            f"{where}: {taken[0]} is the {'distance' if taken[0] == DISTANCE else 'number pi'}."
            " Rename it"
        )
    return numbers
