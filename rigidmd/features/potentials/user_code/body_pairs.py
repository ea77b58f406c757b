"""Potentials of pairs of bodies in a system: the parameters of each pair of species, and where they
are cut off."""

from collections.abc import Callable, Mapping
from functools import partial
from itertools import combinations_with_replacement
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from rigidmd.core.plain_text import did_you_mean
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.features.potentials.keys import BodyForce
from rigidmd.features.potentials.poses.bodies import reference_of
from rigidmd.features.potentials.poses.potential import BodyPairPotential, Parameters, Vector
from rigidmd.features.potentials.tables import reach_errors
from rigidmd.features.potentials.user_code.cutoffs import (
    PairPotentialError,
    check_cutoff,
    check_lengths,
    contact_of,
    energy_scale,
    not_finite,
    start_distances,
)
from rigidmd.features.potentials.user_code.force import BoundTerm
from rigidmd.forces.neighbors.sites import sites_of
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import not_none
from rigidmd.units import KJ_PER_MOL

if TYPE_CHECKING:
    from rigidmd.features.potentials.poses.formulas import PoseFormula
    from rigidmd.features.potentials.poses.pairs import BodyPairs

#: In the log, for a function without a name, or with the name of a column.
DEFAULT_NAME = "body_pairs"
UNNAMED = ("", "<lambda>", "energy")
#: The switch begins at this fraction of the cutoff.
SWITCH_START = 0.9
#: Energy in kT at the first distance of a table that bodies do not come nearer than.
KEEPS_APART = 10.0


def body_pair_potential(
    function: Callable[..., object] | str | Path,
    parameters: Mapping[str, Parameters] | None = None,
    *,
    species: tuple[str, ...] = (),
    pairs: Mapping[tuple[str, str], Parameters] | None = None,
    axis: Literal["x", "y", "z"] | None = None,
    references: Mapping[str, Vector] | None = None,
    truncation: Literal["switch", "plain"] = "switch",
    cutoff_A: float | None = None,
    switch_start_A: float | None = None,
    name: str = "",
) -> BodyPairPotential:
    """An energy of pairs of bodies as a function of their relative position and orientations, for
    `Simulation(scene, forces=[...])`.

    The function is function(r, a, b) or function(r, a, b, p, q). r is the vector (3,) in Å between
    the reference points, from the first body to the second. a and b are their rotation matrices (3,
    3) from the coordinates of the models' files to the lab, p and q their parameters. It gives the
    energy in kJ/mol. Force and torques are derived from it, so that it may have arithmetic and
    functions of NumPy such as numpy.exp and numpy.where, but no branches. Or it gives a tuple of
    the energy, the force (3,) on the second body in kJ/mol/Å, and the torques (3,) on the first and
    on the second body in kJ/mol, along the axes of the lab. An exchange of both bodies must not
    change the energy. If their species differ, the one that is first in the scene is a.

    Parameters
    ----------
    function : callable, str or Path
        The energy, or the path of a table of linear bodies, an .npz file with the arrays r_A,
        theta_1_deg, theta_2_deg, phi_deg and energy_kJ_mol
    parameters : dict of str to dict, optional
        Species -> numbers by name, the attributes of p and q. It acts on these species
    species : tuple of str, optional
        Without `parameters`, the species that it acts on. Default: all
    pairs : dict, optional
        (species, species) -> parameters of the pair, in place of those of p and q
    axis : {"x", "y", "z"}, optional
        An axis of the models' files: a and b are then unit vectors (3,) along it
    references : dict of str to tuple, optional
        Species -> reference point (3,) in the coordinates of its model's file, Å. Default: the
        centre of mass
    truncation : {"switch", "plain"}, optional
        switch: from `switch_start_A` the energy is switched to 0 at the cutoff, with two continuous
        derivatives. plain: it jumps
    cutoff_A : float, optional
        Cutoff, Å. Default: the cutoff of the scene
    switch_start_A : float, optional
        Start of the switch, Å. Default: 0.9 of the cutoff
    name : str, optional
        Name in the log and in messages. Default: the name of the function

    Returns
    -------
    BodyPairPotential
        The potential

    Raises
    ------
    ValueError
        For arguments that contradict each other.

    Examples
    --------
        def dipoles(r, u, v):
            s = np.sqrt(r @ r)
            return 20 * (u @ v / s**3 - 3 * (u @ r) * (v @ r) / s**5)

        rigidmd.body_pair_potential(dipoles, axis="z")
    """
    if isinstance(function, str | Path):
        from rigidmd.features.potentials.poses.table import read_body_table

        if parameters or pairs:
            raise ValueError("parameters and pairs would have no effect on a table: give species")
        energy = read_body_table(Path(function))
        name = name or DEFAULT_NAME
    elif not callable(function):
        raise ValueError(f"{function!r:.60} is not a function of (r, a, b)")
    else:
        energy = function
    if axis not in (None, "x", "y", "z"):
        raise ValueError(f"axis is {axis!r}, must be 'x', 'y' or 'z'")
    if truncation not in ("switch", "plain"):
        raise ValueError(f"truncation is {truncation!r}, must be 'switch' or 'plain'")
    if truncation == "plain" and switch_start_A is not None:
        raise ValueError("switch_start_A would have no effect with truncation = 'plain'")
    for key, value in (("cutoff_A", cutoff_A), ("switch_start_A", switch_start_A)):
        if value is not None and not (isinstance(value, int | float) and value > 0):
            raise ValueError(f"{key} is {value!r}, must be a number above 0")
    for key in pairs or {}:
        if not (isinstance(key, tuple) and [type(one) for one in key] == [str, str]):
            raise ValueError(f"pairs: {key!r} is not a pair of names of species")
    called = getattr(energy, "__name__", "")
    return BodyPairPotential(
        function=energy,
        parameters=dict(parameters or {}),
        species=tuple(species),
        pairs=dict(pairs or {}),
        axis=axis,
        references=dict(references or {}),
        truncation=truncation,
        cutoff_A=cutoff_A,
        switch_start_A=switch_start_A,
        name=name or (DEFAULT_NAME if called in UNNAMED else called),
    )


def potential_of_scene(
    entry: BodyForce, path: Callable[[str], Path] | None = None
) -> BodyPairPotential:
    """The potential of one of [[forces.bodies]] without a module. Raises ValueError.

    path : of the file of a table; None for a stored run, of which no energy is computed
    """
    from rigidmd.features.potentials.poses.shipped import function_of_text, shipped_function

    pairs = {pair.species: pair.parameters for pair in entry.pairs}
    if entry.potential is not None:
        function = shipped_function(entry.potential, entry.options, entry.parameters, pairs)
    elif path is None:
        function = _not_computed
    elif entry.table is not None:
        function = path(entry.table)
    else:
        function = function_of_text(not_none(entry.energy), entry.mixing)
    return body_pair_potential(
        function,
        entry.parameters,
        species=entry.species,
        pairs=pairs,
        axis=entry.axis,
        references=entry.references,
        truncation=entry.truncation,
        cutoff_A=entry.cutoff_A,
        switch_start_A=entry.switch_start_A,
        name=entry.label,
    )


def _not_computed(r: object, a: object, b: object) -> object:
    """The energy of a text or a table in a stored run."""
    raise NotImplementedError


def potentials_of_stored_run(scene: MolecularScene) -> dict[str, BodyPairPotential]:
    """The potentials of [[forces.bodies]] with bodies, axes and shapes. Texts and tables have no
    energies, and modules are left out. Raises SceneError."""
    potentials = {}
    for where, entry in scene.forces.added.items():
        if not isinstance(entry, BodyForce) or entry.module is not None:
            continue
        try:
            potentials[where] = potential_of_scene(entry)
        except ValueError as error:
            raise SceneError(scene.source, [f"{where}: {error}"]) from None
    return potentials


def bind_body_pairs(potential: BodyPairPotential, system: System) -> BoundTerm:
    """The potential between the bodies of a system.

    Raises
    ------
    PairPotentialError
        With all errors.
    """
    # for such scenes only
    from rigidmd.features.potentials.poses.pairs import BodyPairs
    from rigidmd.features.potentials.poses.table import BodyTable
    from rigidmd.features.potentials.user_code.pose_checks import lowest_energy, unresisted_torques

    species = [m.name for m in system.species]
    faults = _unknown_species(potential, list(dict.fromkeys(species)))
    kinds = [name for name in dict.fromkeys(species) if potential.acts_on(name)]
    if not len(system.state.rotation):
        faults.append("no body of the scene rotates: rigidmd.pair_potential is for points")
    if faults:
        raise PairPotentialError(*faults)
    cutoff = potential.cutoff_A or system.cutoff
    check_cutoff(cutoff, system)
    if isinstance(table := potential.function, BodyTable):
        for message in reach_errors("the table", table.first, table.last, cutoff):
            raise PairPotentialError(message)
    start = cutoff
    if potential.truncation == "switch" and cutoff < inf:
        start = potential.switch_start_A or SWITCH_START * cutoff
    if not start <= cutoff:
        raise PairPotentialError(f"switch_start_A = {start:g} is beyond the cutoff of {cutoff:g} Å")
    formula, rows = _rows(potential, kinds)
    if not isinstance(potential.function, BodyTable):
        contact = min(
            contact_of(lowest_energy(formula, rows[i, j]), cutoff, system)
            for i, j in combinations_with_replacement(range(len(kinds)), 2)
        )
        check_lengths(contact, "its bodies", cutoff, potential.switch_start_A)
    models = {m.name: m for m in system.species}
    acting = [models[name] for name in kinds]
    if faults := [*unresisted_torques(potential, formula, rows, acting, system)]:
        raise PairPotentialError(*faults)
    of_species = np.array([kinds.index(name) if name in kinds else -1 for name in species])
    kind = of_species[system.model.species]
    body = np.arange(len(kind))
    frozen = (system.model.inverse_mass == 0)[system.model.species]
    reference = np.array([reference_of(potential, m) for m in acting], float).reshape(-1, 3)
    points = [reference[k : k + 1] if k >= 0 else reference[:0] for k in of_species.tolist()]
    term = BodyPairs(
        formula=formula.kind(),
        sites=sites_of(system.model.species, points, system.model.inverse_inertia),
        kind=kind,
        group=np.where(frozen, len(body), body).astype(np.int32),
        reference=reference,
        frame=np.ascontiguousarray([m.axes.T for m in acting]),
        parameters=rows,
        switch_start=float(start),
        cutoff=float(cutoff),
    )
    ends = "no cutoff" if cutoff == inf else f"cutoff {cutoff:g} Å, {potential.truncation}"
    source = "derived from its energy" if formula.is_derived else "as given"
    text = (
        f"pairs of {', '.join(kinds)}, {formula.operations} operations, force and torques {source},"
        f" {ends}"
    )
    warnings = _low_start(potential.function, acting, system)
    return BoundTerm(
        term,
        text,
        warnings=warnings,
        body_pairs=potential,
        errors_at=partial(_errors_at, term, formula, kinds),
    )


def _errors_at(
    term: "BodyPairs", formula: "PoseFormula", kinds: list[str], system: System
) -> list[str]:
    """Messages on kinds of bodies without finite values between the nearest ones and the cutoff."""
    from rigidmd.features.potentials.poses.pairs import reference_points
    from rigidmd.features.potentials.user_code.pose_checks import not_finite_at

    bodies, point = reference_points(term, system.state)
    kind, group = term.kind[bodies], term.group[bodies]
    start = start_distances(point, kind, group, term.cutoff, system)
    errors = []
    for (i, j), distances in start.items():
        r = not_finite_at(formula, term.parameters[i, j], distances)
        if r is not None:
            errors.append(not_finite(f"{kinds[i]} and {kinds[j]} in some orientations", r))
    return errors


def _low_start(function: object, kinds: list[Molecule], system: System) -> list[str]:
    """A warning of a table with low energies at its first distance, where no sites repel."""
    from rigidmd.features.potentials.poses.table import BodyTable

    if not isinstance(function, BodyTable) or any(m.epsilon.any() for m in kinds):
        return []
    thermal, scale = energy_scale(system)
    lowest = float(function.energy[0].min())
    if lowest > KEEPS_APART * thermal:
        return []
    return [
        f"begins at {function.first:g} Å with an energy of {lowest / KJ_PER_MOL:.3g} kJ/mol"
        f" ({lowest / thermal:.2g} {scale}) at some angles: bodies come nearer, where the energy is"
        " a guess. Begin the table at shorter distances"
    ]


def _unknown_species(potential: BodyPairPotential, species: list[str]) -> list[str]:
    named = {
        "parameters": potential.parameters,
        "species": potential.species,
        "references": potential.references,
        "pairs": [name for pair in potential.pairs for name in pair],
    }
    return [
        f"{key}: there is no {name}{did_you_mean(name, species) or ''}; there are"
        f" {', '.join(species)}"
        for key, names in named.items()
        for name in dict.fromkeys(names)
        if name not in species
    ]


def _rows(potential: BodyPairPotential, kinds: list[str]) -> "tuple[PoseFormula, np.ndarray]":
    """The formula, and its numbers (kinds, kinds, numbers) for each pair of kinds. Raises
    PairPotentialError."""
    from rigidmd.features.potentials.expressions.trace import TraceError
    from rigidmd.features.potentials.poses.formulas import formula_of_poses

    sets = [*potential.parameters.values(), *potential.pairs.values()]
    names = list(dict.fromkeys(key for values in sets for key in values))
    try:
        formula = formula_of_poses(potential.function, names, potential.axis)
        rows = [
            [formula.numbers(*_complete(potential, names, one, other)) for other in kinds]
            for one in kinds
        ]
    except TraceError as error:
        raise PairPotentialError(str(error)) from None
    return formula, np.array(rows, float).reshape(len(kinds), len(kinds), -1)


def _complete(
    potential: BodyPairPotential, names: list[str], one: str, other: str
) -> tuple[Parameters, Parameters]:
    """The parameters of two species. Raises PairPotentialError if one is missing."""
    both = potential.parameters_of(one, other)
    for name, values in zip((one, other), both, strict=True):
        if missing := [key for key in names if key not in values]:
            raise PairPotentialError(f"{name} has no parameter {', '.join(missing)}")
    return both
