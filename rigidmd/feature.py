"""The interface of features: what a feature may add to the core.

A feature is a folder of `rigidmd/features/` and a row of the list there. The row has names and
words only, so that reading the list loads no feature. What a feature does is in the class of its
module `feature`, a subclass of `Feature`: the core calls its methods for scenes that use it. A
feature may be absent: its folder is not there, and a scene that needs it ends with one sentence.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TypeVar

from rigidmd.errors import RigidMDError

Scene = TypeVar("Scene")
System = TypeVar("System")


class MissingFeatureError(RigidMDError):
    """A scene or a command needs a feature that is absent."""


@dataclass(frozen=True)
class Row:
    """A feature in names and words."""

    name: str  # of its folder
    summary: str
    needs: tuple[str, ...] = ()  # features that it imports
    #: Keys of scenes that it adds, such as "forces.formulas" and "stages.lambda". A scene that has
    #: one uses the feature
    keys: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()  # modules of its folder `commands`
    formats: tuple[str, ...] = ()  # modules that register file formats
    analyses: tuple[str, ...] = ()  # modules that register analyses
    display: str = ""  # the module that registers functions of `core.display`

    @property
    def package(self) -> str:
        return f"rigidmd.features.{self.name}"

    @cached_property
    def is_installed(self) -> bool:
        return find_spec(self.package) is not None

    def module(self, name: str, needed_by: str = "this") -> ModuleType:
        """A module of the feature. Raises MissingFeatureError."""
        if not self.is_installed:
            raise MissingFeatureError(
                f"{needed_by} needs the feature {self.name} ({self.summary}), which is not"
                " installed: install rigidmd with all its features"
            )
        return import_module(f"{self.package}.{name}")

    def load(self, needed_by: str = "this") -> "Feature":
        """What the feature does. Raises MissingFeatureError."""
        return self.module("feature", needed_by).FEATURE


class Feature:
    """What a feature does. A method that a feature does not have adds nothing."""

    def resolve(self, scene: Scene) -> Scene:
        """The scene with the defaults of the feature. Raises SceneError."""
        return scene

    def extend(self, system: System) -> System:
        """The system of molecules with what the feature adds: terms, `extras`. Raises
        SceneError."""
        return system


def modules(rows: tuple[Row, ...], kind: str) -> Iterator[tuple[str, str]]:
    """(name, full name) of the modules of installed features that add "commands", "formats"
    or "analyses"."""
    for row in rows:
        if getattr(row, kind) and row.is_installed:
            folder = f"{row.package}.commands" if kind == "commands" else row.package
            yield from ((name, f"{folder}.{name}") for name in getattr(row, kind))
