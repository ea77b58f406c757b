"""What an external engine can translate, as a table. All that is not in the table is refused with one kind of message.

Thermostats, potentials and fields do not know about other engines: a new one is refused until a table has it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from rigidmd.engines.force_field import ForceFieldView, force_field_of, unknown_terms
from rigidmd.engines.registry import Program
from rigidmd.engines.system import System
from rigidmd.errors import SceneError


class Missing(str):
    """In place of a translation: why the engine has none, with advice."""


class Key(NamedTuple):
    """The values of a key of a scene that an engine can translate."""

    name: str  # of a scene, with a dot, or of a stage
    values: Mapping[Any, Any]  # value -> its translation, or `Missing`
    reason: str = ""  # why other values are refused, with advice; default: "ENGINE has ..."
    matters: Callable[[ForceFieldView], Any] = lambda view: True

    def refusal(self, title: str, value: Any) -> str | None:
        """The message on a value without a translation."""
        how = self.values.get(value, Missing(self.reason))
        if not isinstance(how, Missing):
            return None
        known = " and ".join(str(name) for name, how in self.values.items() if name and not isinstance(how, Missing))
        return f"{self.name} = {value!r}: {how or f'{title} has {known}'}"


class Limit(NamedTuple):
    """A combination of settings that an engine lacks."""

    message: str  # with {} for what `applies` returns
    applies: Callable[[Any], Any]  # whether a `ForceFieldView` or a `Stage` has them


class Translations(NamedTuple):
    """The table of an engine. rigidmd itself performs minimisations, in which nothing is refused."""

    title: str
    scene: tuple[Key, ...]
    stage: tuple[Key, ...]
    limits: tuple[Limit, ...]  # of a `ForceFieldView`
    stage_limits: tuple[Limit, ...]

    def of(self, name: str) -> Mapping[Any, Any]:
        """The translations of a key."""
        return next(key.values for key in (*self.scene, *self.stage) if key.name == name)

    def refusals(self, view: ForceFieldView) -> Iterator[str]:
        """Messages on all that a system has and the engine lacks."""
        yield from unknown_terms(view.system)
        for key in self.scene:
            table, name = key.name.split(".")
            if key.matters(view) and (message := key.refusal(self.title, getattr(getattr(view.scene, table), name))):
                yield message
        yield from _limits(self.limits, view)
        for k, stage in enumerate(view.scene.stages):
            if not stage.is_minimisation:
                messages = (key.refusal(self.title, getattr(stage, key.name)) for key in self.stage)
                yield from (f"stages.{k}.{message}" for message in messages if message)
                yield from (f"stages.{k}.{message}" for message in _limits(self.stage_limits, stage))


def _limits(limits: tuple[Limit, ...], subject: Any) -> Iterator[str]:
    return (limit.message.format(found) for limit in limits if (found := limit.applies(subject)))


def checked_view(system: System, program: Program, where: str, more: Iterable[str] = ()) -> ForceFieldView:
    """The view of a system for an external engine. Raises SceneError with all that the engine lacks, and `more`
    messages; `where` begins each."""
    view = force_field_of(system)
    if found := [*program.load(program.translations).refusals(view), *more]:
        raise SceneError(system.scene.source, [f"{where}: {message}" for message in found])
    return view


def moves(title: str, bodies: str) -> tuple[Key, Limit, Limit]:
    """What holds for all programs: `velocity_verlet`, or baoab with langevin; one friction."""
    by = f"{title} moves {bodies} by velocity_verlet"
    return (
        Key("integrator", {"velocity_verlet": "", "baoab": ""}, by),
        Limit(f"integrator = 'baoab': {by}", lambda stage: stage.integrator == "baoab" and not is_langevin(stage)),
        Limit(
            f"friction_rotation_per_ps: {title} has one friction for translation and rotation",
            lambda stage: is_langevin(stage) and len(set(stage.frictions)) > 1,
        ),
    )


def is_langevin(stage: Any) -> bool:
    return stage.thermostat_kind == "langevin"


#: With constrained distances or split rotations, the exact flow of a free rotor does not exist.
SPLIT = {None: "", "split": ""}
