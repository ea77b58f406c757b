"""External engines: LAMMPS and OpenMM behind the protocol of engines, chosen by `engine.name` of a
scene.

What an engine can translate is a table. All that is not in the table is rejected with one kind of
message. Thermostats, potentials and fields do not know about other engines: a new one is rejected
until a table has it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.programs import Program
from rigidmd.core.state import NOW, State
from rigidmd.engines.observables import kinetic_energies, observe
from rigidmd.engines.protocol import Engine, NotFiniteError, Tally, keep_time
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.features.external.force_field import (
    ForceFieldView,
    force_field_of,
    unknown_terms,
)
from rigidmd.features.potentials.poses.potential import BodyPairPotential
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import KJ_PER_MOL


class Missing(str):
    """In place of a translation: why the engine has none, with advice."""


class Key(NamedTuple):
    """The values of a key of a scene that an engine can translate."""

    name: str  # of a scene, with a dot, or of a stage
    values: Mapping[object, str]  # value -> its translation, or `Missing`
    reason: str = ""  # why other values are refused, with advice; default: "ENGINE has ..."
    matters: Callable[[ForceFieldView], object] = lambda view: True

    def refusal(self, title: str, value: object) -> str | None:
        """The message on a value without a translation."""
        how = self.values.get(value, Missing(self.reason))
        if not isinstance(how, Missing):
            return None
        known = [name for name, how in self.values.items() if not isinstance(how, Missing)]
        names = sorted(map(str, filter(None, known)), key="none".__eq__)
        listed = " or ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))
        return f"{self.name} = {value!r}: {how or f'{title} has {listed}'}"


Subject = TypeVar("Subject", ForceFieldView, Stage)


class Limit(NamedTuple, Generic[Subject]):
    """A combination of settings that an engine lacks."""

    message: str  # with {} for what `applies` returns
    applies: Callable[[Subject], object]  # whether the settings have them


class Translations(NamedTuple):
    """The table of an engine. rigidmd itself performs minimisations, in which nothing is
    rejected."""

    title: str
    scene: tuple[Key, ...]
    stage: tuple[Key, ...]
    limits: tuple[Limit[ForceFieldView], ...]
    stage_limits: tuple[Limit[Stage], ...]
    #: Class of the function of a potential of two bodies -> messages on what is lacking of it
    body_pairs: Mapping[type, Callable[[BodyPairPotential, System], Iterator[str]]] = (
        MappingProxyType({})
    )

    def of(self, name: str) -> Mapping[object, str]:
        """The translations of a key."""
        return next(key.values for key in (*self.scene, *self.stage) if key.name == name)

    def refusals(self, view: ForceFieldView) -> Iterator[str]:
        """Messages on all that a system has and the engine lacks."""
        yield from unknown_terms(view.system, self.title, self.body_pairs)
        for key in self.scene:
            table, name = key.name.split(".")
            if key.matters(view) and (
                message := key.refusal(self.title, getattr(getattr(view.scene, table), name))
            ):
                yield message
        yield from _limits(self.limits, view)
        for k, stage in enumerate(view.scene.stages):
            messages = [key.refusal(self.title, getattr(stage, key.name)) for key in self.stage]
            if not stage.is_minimisation:
                yield from (
                    f"stages.{k}.{m}" for m in (*messages, *_limits(self.stage_limits, stage)) if m
                )


def _limits(limits: tuple[Limit[Subject], ...], subject: Subject) -> Iterator[str]:
    return (limit.message.format(value) for limit in limits if (value := limit.applies(subject)))


def checked_view(
    system: System, program: Program, where: str, more: Iterable[str] = ()
) -> ForceFieldView:
    """The view of a system for an external engine. Raises SceneError with all it lacks, and `more`,
    after `where`."""
    view = force_field_of(system)
    if refusals := [*program.load(program.translations).refusals(view), *more]:
        raise SceneError(system.scene.source, [f"{where}: {message}" for message in refusals])
    return view


def moves(title: str, bodies: str) -> tuple[Key, Limit[Stage]]:
    """What holds for all programs: one step, for `velocity_verlet` and baoab. One friction."""
    by = f"{title} moves {bodies} by velocity_verlet"
    return (
        Key("integrator", {"velocity_verlet": "", "baoab": ""}, by),
        Limit(
            f"friction_rotation_per_ps: {title} has one friction for translation and rotation",
            lambda stage: is_langevin(stage) and len(set(stage.thermostat_values.values())) > 1,
        ),
    )


def is_langevin(stage: Stage) -> bool:
    return stage.thermostat_kind == "langevin"


#: With constrained distances or split rotations, the exact flow of a free rotor does not exist.
SPLIT: Mapping[object, str] = {None: "", "split": ""}


class ExternalEngine(Engine, ABC):
    """Base of engines that run another program for one stage, which keeps the variables of its
    thermostat and barostat. The first tally of `evaluate` has the whole virial."""

    def __init__(self, system: System, stage: int):
        self._system = system
        self._view = force_field_of(system)
        self._stage = system.scene.stages[stage]
        self.conserves_energy = not (self._stage.has_thermostat or self._stage.has_barostat)
        self._known_state: State | None = None  # the current state of the program
        self._heat_offset = (
            0.0  # heat in the ledger of a state that was sent, less the heat of the program by then
        )

    def advance(
        self,
        state: State,
        integrator: Scheme | Solver,
        dt: float,
        until: int,
        observed: bool = False,
    ) -> None:
        keep_time(state, dt)
        self._send(state)
        steps = until - int(state.step[NOW])
        if steps <= 0:
            return
        self._run(state, steps, dt)
        self._receive(state)
        state.step[NOW] = until
        state.time[NOW] = state.time_of(until, dt)
        self._known_state = state.copy()

    def forget(self) -> None:
        self._known_state = None

    @abstractmethod
    def _send(self, state: State) -> None:
        """Set the program's state, unless it has it already."""

    @abstractmethod
    def _run(self, state: State, steps: int, dt: float) -> None:
        """Let the program take steps of dt (ps) from `state`."""

    @abstractmethod
    def _receive(self, state: State) -> None:
        """Write the program's state, and its heat, into `state`."""


def tallies_of(energies: Mapping[str, float], virial: np.ndarray) -> dict[str, Tally]:
    """Energies of terms, the first with the whole virial."""
    return {
        name: Tally(float(energy), np.zeros((3, 3)) if k else virial)
        for k, (name, energy) in enumerate(energies.items())
    }


def not_finite(state: State) -> NotFiniteError:
    """The error of a program that moves a state to positions that are not finite."""
    return NotFiniteError(state._replace(position=np.full_like(state.position, np.nan)))


def same_state(one: State | None, other: State) -> bool:
    """Whether two states are equal to the bit, except for time and the energy ledger."""
    return one is not None and all(
        np.array_equal(a, b) for a, b in zip(one[:5], other[:5], strict=True)
    )


def external_engine(system: System, stage: int = 0) -> ExternalEngine:
    """The external engine for a stage. Raises SceneError with all that it lacks. EngineError if not
    installed."""
    program = supporting_program(system)
    return program.load(program.engine)(system, stage, **system.scene.engine.options)


def supporting_program(system: System) -> Program:
    """The external engine of a scene. Raises SceneError with all features that it lacks."""
    program = not_none(system.scene.engine.program)
    checked_view(system, program, f"engine.name = {program.name!r}")
    return program


# Comparison with rigidmd at one state, term by term, for `rigidmd verify` and before runs on
# external engines.

#: Tolerance of pair sums, relative to their size: engines have slightly different constants, such
#: as 332.06371. Energies of OpenMM in single precision differ by up to 3e-7.
PLAIN = 1e-6
#: Component of an observation that engines take from the system, so that it is not compared.
TAIL = "lennard_jones_tail"
#: Ratio of virial and energy of a 1/r¹² term. The energy may be smaller, where attraction cancels
#: repulsion.
STEEPEST = 12
#: Tolerance of forces with an Ewald sum, in estimated errors. Each engine has such an error.
ERRORS = 5.0
#: Tolerance of the energy of an Ewald sum per site, in (force error)/alpha. Measured: 0.003 (512
#: SPC/E, 1e-5).
PER_SITE = 0.02


class Comparison(NamedTuple):
    name: str
    unit: str
    here: float
    there: float
    difference: float
    tolerance: float

    @property
    def agrees(self) -> bool:
        return bool(self.difference <= self.tolerance)


def compare_at(system: System, state: State, engine: Engine, other: Engine) -> list[Comparison]:
    """Compare energies by term, forces and torques on bodies, and the virial of two engines at a
    state."""
    ours, theirs = (observe(system, engine, state, energy_unit=1.0) for engine in (engine, other))
    virial = sum(abs(float(tally.virial.trace())) for tally in engine.evaluate(state)[1].values())

    kinetic = sum(kinetic_energies(system, state))
    size = (
        sum(abs(ours.components[name]) for name in system.terms if name in ours.components)
        + kinetic
    )
    size = max(size, virial / STEEPEST)
    plain = PLAIN + other.force_tolerance
    force_error = system.force_error or 0.0
    sites = system.site_count
    alpha = system.scene.forces.ewald_alpha_per_A
    ewald = (
        force_error * (1 / alpha if alpha else 0.0) * (PER_SITE * sites + ERRORS * np.sqrt(sites))
    )
    lines = []
    for name in {**ours.components, **theirs.components}:
        if name == TAIL:
            continue
        a, b = (observation.components.get(name, 0.0) for observation in (ours, theirs))
        tolerance = PLAIN * size + (ewald if name.startswith("coulomb") else 0.0)
        lines.append(_energy(name.replace("_", " "), a, b, tolerance))
    lines.append(
        _energy("potential energy", ours.potential, theirs.potential, PLAIN * size + ewald)
    )
    each = np.sqrt(sites / len(system.model.species)) * ERRORS * force_error
    radius = max(m.radius for m in system.species)
    for name, unit, k, tolerance in (
        ("force", "kJ/(mol Å)", 0, each),
        ("torque", "kJ/mol", 1, each * radius),
    ):
        if len(a := ours.load[k]):
            rms = [
                float(np.sqrt(np.mean(np.sum(x**2, axis=1))))
                for x in (a, theirs.load[k], theirs.load[k] - a)
            ]
            # the tolerance is relative to the rms, or to the energy of a body where it nearly
            # vanishes
            scale = max(
                rms[0],
                size / len(system.model.species) / (system.smallest_diameter if k == 0 else 1.0),
            )
            values = (x / KJ_PER_MOL for x in (*rms, plain * scale + tolerance))
            lines.append(Comparison(f"rms {name} on a molecule", unit, *values))
    if np.isfinite(ours.pressure) and np.isfinite(theirs.pressure):
        a, b = (float(observation.virial.trace()) for observation in (ours, theirs))
        lines.append(
            _energy(
                "virial", a, b, (plain + other.virial_tolerance) * max(size, virial) + 3 * ewald
            )
        )
    return lines


def _energy(name: str, ours: float, theirs: float, tolerance: float) -> Comparison:
    return Comparison(
        name, "kJ/mol", *(x / KJ_PER_MOL for x in (ours, theirs, abs(theirs - ours), tolerance))
    )


def describe_comparison(lines: list[Comparison], name: str) -> str:
    """A table of comparisons. `name` : of the other engine."""
    wide = max(len(line.name) for line in lines)
    rows = [f"  {'':<{wide}}  {'rigidmd':>20}  {name:>20}  {'difference':>10}  {'tolerance':>9}"]
    for line in lines:
        values = (
            f"{line.here:>20.10g}  {line.there:>20.10g}  {line.difference:>10.2g} "
            f" {line.tolerance:>9.2g}"
        )
        rows.append(
            f"  {line.name:<{wide}}  {values}  {line.unit}{'' if line.agrees else '   <- differs'}"
        )
    return "\n".join(rows)
