"""Binds user code to a system: forces and a thermostat become terms, and errors in their code
become messages."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from rigidmd.assemble.defaults import with_momentum_removal
from rigidmd.core.plain_text import did_you_mean, distinct
from rigidmd.core.quantities import QUANTITIES
from rigidmd.dynamics.model import count_degrees_of_freedom
from rigidmd.engines.cpu.compiled import LOAD
from rigidmd.engines.cpu.engine import BOX, EXTENSION, CompileError
from rigidmd.engines.system import System, TermMaker, ThermostatOfStages
from rigidmd.errors import SceneError, describe_error
from rigidmd.features.potentials.extra import UserExtra, with_extra
from rigidmd.features.potentials.keys import BodyForce, CustomForce
from rigidmd.features.potentials.user_code.body_pairs import (
    BodyPairPotential,
    bind_body_pairs,
    potential_of_scene,
)
from rigidmd.features.potentials.user_code.compiled import describe_compile_error
from rigidmd.features.potentials.user_code.cutoffs import check_cutoff
from rigidmd.features.potentials.user_code.force import (
    BoundTerm,
    Force,
    UserForceError,
    bind_force,
    changes_momentum,
)
from rigidmd.features.potentials.user_code.kernels import FORCES, THERMOSTATS
from rigidmd.features.potentials.user_code.pair_potential import PairPotential, pair_potential
from rigidmd.features.potentials.user_code.pair_terms import bind_pair_potential
from rigidmd.features.potentials.user_code.trust import trusted_module
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.parts import sum_of_tails
from rigidmd.scene import MolecularScene
from rigidmd.scene.added_forces import AddedForce
from rigidmd.scene.molecules import missing_user_code, name_of
from rigidmd.scene.validation import not_none

#: Names that a force cannot have, and what they are.
RESERVED = {
    **dict.fromkeys((LOAD, BOX, EXTENSION), "the name of a part of checkpoints"),
    **dict.fromkeys(
        ("tail", "lennard_jones_tail"), "the name of the energy of the tail correction"
    ),
    **dict.fromkeys(QUANTITIES, "a column of the log"),
}


def custom_forces(scene: MolecularScene) -> list[object]:
    """The objects of [[forces.custom]] and [[forces.bodies]]. Raises SceneError with all errors."""
    forces, faults = [], []
    for where, entry in scene.forces.added.items():
        try:
            forces.append(_custom(scene, entry, where))
        except (SceneError, ValueError) as error:
            module = entry.files.get("module") if isinstance(error, SceneError) else None
            faults += [(module, f"{where}: {fault}") for fault in getattr(error, "errors", [error])]
    if faults:  # each file once
        messages = {module or fault: fault for module, fault in reversed(faults)}
        raise SceneError(scene.source, list(messages.values())[::-1])
    return forces


def _custom(scene: MolecularScene, entry: AddedForce, key: str) -> object:
    if not isinstance(entry, CustomForce | BodyForce):
        return entry
    if entry.module is None and isinstance(entry, BodyForce):
        return potential_of_scene(entry, scene.path)
    if entry.module is None and isinstance(entry, CustomForce):
        pairs = {pair.sites: pair.parameters for pair in entry.pairs}
        table = None if entry.table is None else scene.path(entry.table)
        return pair_potential(
            entry.energy,
            entry.parameters or None,
            table=table,
            sites=entry.sites,
            pairs=pairs,
            mixing=entry.mixing,
            truncation=entry.truncation,
            cutoff_A=entry.cutoff_A,
            switch_start_A=entry.switch_start_A,
            name=entry.name,
        )
    module = trusted_module(scene.path(not_none(entry.module)), f"{key}.module")
    if not hasattr(module, entry.label):
        public_names = [name for name in vars(module) if not name.startswith("_")]
        hint = did_you_mean(entry.label, public_names) or ""
        raise ValueError(f"name: {entry.module} has no {entry.label}{hint}")
    made = getattr(module, entry.label)
    if isinstance(made, type) or (callable(made) and not isinstance(made, Force)):
        try:
            made = made(**entry.parameters)
        except (Exception, SystemExit) as error:  # user code may raise anything
            raise ValueError(f"{entry.label}(...) raised {describe_error(error)}") from error
    elif entry.parameters:
        raise ValueError(
            f"parameters would have no effect: {entry.label} is an object, which is not called"
        )
    return made


@contextmanager
def user_errors_explained(system: System) -> Iterator[None]:
    """Convert errors of user code before the first step, including Numba's, to a SceneError."""
    try:
        yield
    except UserForceError as error:
        raise SceneError(system.scene.source, [f"at the start: {error}"]) from error
    except CompileError as error:
        if not system.user_terms and system.thermostat is None:
            raise
        names = ", ".join(
            [*system.user_terms, *(["the thermostat"] if system.thermostat is not None else [])]
        )
        raise SceneError(
            system.scene.source, [f"{names}: cannot be compiled{describe_compile_error(error)}"]
        ) from None


def with_user_code(system: System, *, is_start: bool = True) -> System:
    """The system with [[forces.custom]] and terms and thermostat from Python. Raises SceneError
    with all errors.

    is_start : whether it starts in its state, in which energies must be finite
    """
    scene, (added, thermostat) = system.scene, system.scene.user_code
    if scene.from_python != scene.user_code.names:
        missing = missing_user_code(scene.from_python, scene.user_code.names)
        raise SceneError(scene.source, [missing])
    in_stages = cast("ThermostatOfStages | None", thermostat)  # checked below
    forces = [*custom_forces(scene), *added]
    force_names = [*(entry.label for entry in scene.forces.added.values()), *map(name_of, added)]
    names = distinct(force_names, [*system.terms, *system.constants])
    reserved = RESERVED | dict.fromkeys(system.quantities, "a column of the log")
    errors = [
        f"{name} is {reserved[name]}. Name the force otherwise"
        for name in names
        if name in reserved
    ]
    # a force may add notes in `begin`
    target = replace(system, notes=[*system.notes], warnings=[*system.warnings])
    target = with_extra(target, UserExtra(thermostat=in_stages))
    bound: dict[str, BoundTerm] = {}
    changed = np.zeros(3, bool)  # whether they may change components of the total momentum
    for name, force in zip(names, forces, strict=True):
        try:
            bound[name] = bind(force, target, name)
            if is_start:
                errors += [f"{name}: {message}" for message in bound[name].errors_at(target)]
            if not isinstance(bound[name].term, PairForces):
                changed |= changes_momentum(bound[name].term)
        except (SceneError, UserForceError, ValueError) as error:
            errors += [f"{name}: {message}" for message in getattr(error, "errors", [error])]
    if not (thermostat is None or is_thermostat(thermostat)):
        errors.append(
            f"thermostat: {thermostat!r:.60} is neither a NamedTuple of a class with"
            " rigidmd.compiled_thermostat nor has a method for_stage(system, k)"
        )
    if errors:
        raise SceneError(scene.source, errors)
    for name, term in bound.items():
        target.notes.extend(f"{name}: {note}" for note in term.notes)
        target.warnings.extend(f"{name} {warning}" for warning in term.warnings)
    if thermostat is not None:
        target.notes.append(
            f"thermostat: {name_of(thermostat)}, from Python, replaces the thermostats of all"
            " stages"
        )
    model = system.model._replace(keeps_momentum=system.model.keeps_momentum & ~changed)
    functions = {name: one.function for name, one in bound.items() if one.function is not None}
    terms = {name: one.term for name, one in bound.items()}
    tails = [tail for tail in (system.tail, *(one.tail for one in bound.values())) if tail]
    extra = UserExtra(
        user_terms={name: one.description for name, one in bound.items()},
        python_forces=functions,
        thermostat=in_stages,
        body_pairs={name: one.body_pairs for name, one in bound.items() if one.body_pairs},
    )
    made = replace(
        target,
        scene=with_momentum_removal(scene, model.keeps_momentum),
        # Forces computed by Python come first: as long as they are missing, no other need be
        # computed.
        terms={name: terms[name] for name in functions} | system.terms | terms,
        model=model,
        freedom=count_degrees_of_freedom(model),
        tail=sum_of_tails(tails),
    )
    return with_extra(made, extra)


def is_thermostat(thermostat: object) -> bool:
    """Whether an object is a compiled thermostat of the user, or makes one for each stage."""
    return type(thermostat) in THERMOSTATS or hasattr(thermostat, "for_stage")


def bind(force: object, system: System, name: str) -> BoundTerm:
    """A force of the user in a system. Raises PairPotentialError, ValueError, UserForceError,
    SceneError."""
    if isinstance(force, PairPotential):
        return bind_pair_potential(force, system)
    if isinstance(force, BodyPairPotential):
        return bind_body_pairs(force, system)
    if isinstance(force, Force):
        return bind_force(force, system, name)
    return _bind_term(force, system)


def _bind_term(force: object, system: System) -> BoundTerm:
    """A finished term, or an object whose method `term` makes it for a system."""
    made = force
    if isinstance(force, TermMaker):
        try:
            made = force.term(system)
        except (ValueError, SceneError):
            raise
        except (Exception, SystemExit) as error:  # user code may raise anything
            raise ValueError(f"term(system) raised {describe_error(error)}") from error
    if isinstance(made, PairForces):  # with a potential that is not a `PairPotential`
        check_cutoff(made.potential.cutoff, system)  # type: ignore[attr-defined]  # every pair potential has a cutoff
    elif type(made) not in FORCES:
        raise ValueError(
            f"{made!r:.80} is not a force: give a rigidmd.Force, a rigidmd.pair_potential, a"
            " NamedTuple of a class with rigidmd.compiled_force, or an object whose term(system)"
            " makes one"
        )
    term = cast(NamedTuple, made)
    if isinstance(force, AddedForce):
        return BoundTerm(term, ", ".join(f"{key} = {x}" for key, x in force))
    numbers = ", ".join(
        f"{key} = {x:.6g}" for key, x in term._asdict().items() if isinstance(x, int | float)
    )
    kind = type(term).__qualname__
    return BoundTerm(term, f"{kind} with {numbers}" if numbers else kind)
