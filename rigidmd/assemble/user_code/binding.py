"""Binds user code to a system: forces and a thermostat become terms, and errors in their code
become messages."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import inf
from typing import Any, NamedTuple

import numpy as np

from rigidmd.assemble.defaults import with_momentum_removal
from rigidmd.assemble.user_code.compiled import describe_compile_error
from rigidmd.assemble.user_code.cutoffs import check_cutoff
from rigidmd.assemble.user_code.force import BoundForce, Force, UserForceError, changes_momentum
from rigidmd.assemble.user_code.pair_potential import PairLaw, pair_law
from rigidmd.assemble.user_code.trust import trusted_module
from rigidmd.core.plain_text import did_you_mean, distinct
from rigidmd.dynamics.model import count_degrees_of_freedom
from rigidmd.dynamics.user_kernels import FORCES, THERMOSTATS
from rigidmd.engines.cpu.engine import BOX, LOAD, TRAJECTORY, CompileError
from rigidmd.engines.samples import IN_LOGS
from rigidmd.engines.system import System
from rigidmd.errors import SceneError, describe_error
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.parts import Tail, sum_of_tails
from rigidmd.scene import MolecularScene
from rigidmd.scene.forces import CustomForce
from rigidmd.scene.molecules import name_of

#: Names that a force cannot have, and what they are.
RESERVED = {
    **dict.fromkeys((LOAD, BOX, TRAJECTORY), "the name of a part of checkpoints"),
    **dict.fromkeys(
        ("tail", "lennard_jones_tail"), "the name of the energy of the tail correction"
    ),
    **dict.fromkeys(IN_LOGS, "a column of the log"),
}


def custom_forces(scene: MolecularScene) -> list[Any]:
    """The objects of [[forces.custom]]. Raises SceneError with all errors."""
    forces, faults = [], []
    for k, entry in enumerate(scene.forces.custom):
        try:
            forces.append(_custom(scene, entry, f"forces.custom.{k}"))
        except (SceneError, ValueError) as error:
            module = entry.module if isinstance(error, SceneError) else None
            faults += [
                (module, f"forces.custom.{k}: {fault}")
                for fault in getattr(error, "errors", [error])
            ]
    if faults:  # each file once
        messages = {module or fault: fault for module, fault in reversed(faults)}
        raise SceneError(scene.source, list(messages.values())[::-1])
    return forces


def _custom(scene: MolecularScene, entry: CustomForce, key: str) -> Any:
    if entry.module is None:
        pairs = {pair.sites: pair.parameters for pair in entry.pairs}
        table = None if entry.table is None else scene.path(entry.table)
        return pair_law(
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
    module = trusted_module(scene.path(entry.module), f"{key}.module")
    if not hasattr(module, entry.name):
        public_names = [name for name in vars(module) if not name.startswith("_")]
        hint = did_you_mean(entry.name, public_names) or ""
        raise ValueError(f"name: {entry.module} has no {entry.name}{hint}")
    made = getattr(module, entry.name)
    if isinstance(made, type) or (callable(made) and not isinstance(made, Force)):
        try:
            made = made(**entry.parameters)
        except (Exception, SystemExit) as error:  # user code may raise anything
            raise ValueError(f"{entry.name}(...) raised {describe_error(error)}") from error
    elif entry.parameters:
        raise ValueError(
            f"parameters would do nothing: {entry.name} is an object, which is not called"
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


def with_user_code(system: System) -> System:
    """The system with [[forces.custom]] and terms and thermostat from Python. Raises SceneError
    with all errors."""
    scene, (added, thermostat) = system.scene, system.scene.user_code
    forces = [*custom_forces(scene), *added]
    force_names = [*(entry.name for entry in scene.forces.custom), *map(name_of, added)]
    names = distinct(force_names, [*system.terms, *system.constants])
    bound = replace(
        system, python_forces={}, thermostat=thermostat, user_terms={}, notes=[*system.notes]
    )
    bound = replace(bound, warnings=[*system.warnings])
    terms, tails = {}, [] if system.tail is None else [system.tail]
    faults = [
        f"{name} is {RESERVED[name]}; name the force otherwise"
        for name in names
        if name in RESERVED
    ]
    changed = np.zeros(3, bool)  # whether they may change components of the total momentum
    for name, made in zip(names, forces, strict=True):
        try:
            term = _term(made, name, system, bound, tails)
            if not isinstance(term, PairForces):
                changed |= changes_momentum(term)
            terms[name] = term
        except (SceneError, UserForceError, ValueError) as error:
            faults += [f"{name}: {fault}" for fault in getattr(error, "errors", [error])]
    if thermostat is not None and not (
        type(thermostat) in THERMOSTATS or hasattr(thermostat, "for_stage")
    ):
        need = (
            "a NamedTuple of a class with rigidmd.compiled_thermostat nor has a method"
            " for_stage(system, k)"
        )
        faults.append(f"thermostat: {thermostat!r:.60} is neither {need}")
    if faults:
        raise SceneError(scene.source, faults)
    if thermostat is not None:
        bound.notes.append(
            f"thermostat: {name_of(thermostat)}, from Python, replaces the thermostats of all"
            " stages"
        )
    model = system.model._replace(keeps_momentum=system.model.keeps_momentum & ~changed)
    # Forces computed by Python come first: as long as they are missing, no other need be computed.
    terms = {name: terms[name] for name in bound.python_forces} | system.terms | terms
    return replace(
        bound,
        scene=with_momentum_removal(scene, model.keeps_momentum),
        terms=terms,
        model=model,
        freedom=count_degrees_of_freedom(model),
        tail=sum_of_tails(tails),
    )


def _term(made: Any, name: str, system: System, target: System, tails: list[Tail]) -> NamedTuple:
    """The term of one object for a system. Its function, description and notes are added to
    `target`, its tail correction to `tails`. Raises PairPotentialError, ValueError,
    UserForceError."""
    if isinstance(made, PairLaw):
        term, formula, tail, notes, warnings = made.bind(system)
        if formula.error:
            target.notes.append(
                f"{name}: the error of its spline is {formula.error:.1e} of its deepest energy"
            )
        target.notes.extend(f"{name}: {note}" for note in notes)
        target.warnings.extend(f"{name} {warning}" for warning in warnings)
        tails += [] if tail is None else [tail]
        cutoff = made.cutoff_A or system.cutoff
        truncation = made.truncation or system.scene.forces.truncation
        reach = f"cutoff {cutoff:g} Å, {truncation}" if cutoff < inf else "no cutoff"
        target.user_terms[name] = f"{formula.text}, {len(term.group)} sites, {reach}"
        return term
    if isinstance(made, Force):
        bound = BoundForce(made, name, target)
        target.python_forces[name] = bound
        target.user_terms[name] = f"{type(made).__qualname__}, computed by Python"
        return bound.term
    if hasattr(made, "term"):
        try:
            made = made.term(system)
        except (ValueError, SceneError):
            raise
        except (Exception, SystemExit) as error:  # user code may raise anything
            raise ValueError(f"term(system) raised {describe_error(error)}") from error
    if isinstance(made, PairForces):  # with a potential that is not a `PairLaw`
        check_cutoff(made.potential.cutoff, system)  # type: ignore[attr-defined]  # every pair potential has a cutoff
    if not (isinstance(made, PairForces) or type(made) in FORCES):
        compiled = (
            "a NamedTuple of a class with rigidmd.compiled_force, or an object whose term(system)"
            " makes one"
        )
        raise ValueError(
            f"{made!r:.80} is not a force: give a rigidmd.Force, a rigidmd.pair_law, {compiled}"
        )
    numbers = ", ".join(
        f"{key} = {x:.6g}" for key, x in made._asdict().items() if isinstance(x, int | float)
    )
    target.user_terms[name] = f"{type(made).__qualname__}{f' with {numbers}' if numbers else ''}"
    return made
