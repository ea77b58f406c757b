"""The interface of features: what a feature may add to the core.

A feature is a folder of `rigidmd/features/` and a row of the list there. The row has names and
words only, so that reading the list loads no feature. What a feature does is in the class of its
module `feature`, a subclass of `Feature`: the core calls its methods for scenes that use it. A
feature may be absent: its folder is not there, and a scene that needs it ends with one sentence.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from rigidmd.errors import RigidMDError

Scene = TypeVar("Scene")
Parts = TypeVar("Parts")
System = TypeVar("System")


class MissingFeatureError(RigidMDError):
    """A scene or a command needs a feature that is absent."""


@dataclass(frozen=True)
class Row:
    """A feature in names and words."""

    name: str  # of its folder
    summary: str
    needs: tuple[str, ...] = ()  # features that it imports
    #: Keys of scenes that belong to it, such as "forces.custom", or "stages.thermostat=NAME" for
    #: one value. A scene in which one has a value uses the feature
    keys: tuple[str, ...] = ()
    file_keys: str = ""  # pattern of its keys that name a file
    acts: bool = False  # whether it changes the systems of scenes that use it
    is_optional: bool = False  # whether these run without it, with fewer files
    #: Methods of its `Feature` that are called by their name, and not for scenes with its keys
    provides: tuple[str, ...] = ()
    #: Kind of scenes that it adds, by the table that only these have, such as "body". A module of
    #: this name in its folder `keys` has their class as `SCENE`
    kind: str = ""
    kind_title: str = ""  # of its examples
    commands: tuple[str, ...] = ()  # modules of its folder `commands`
    formats: tuple[str, ...] = ()  # modules that register file formats, and the extensions of these
    analyses: tuple[str, ...] = ()  # modules that register analyses
    #: Modules that have the name of an analysis which needs no run, with `results_of_scene`
    scene_analyses: tuple[str, ...] = ()
    #: Modules with an analysis of all points of a sweep, SWEEP_ANALYSIS
    sweep_analyses: tuple[str, ...] = ()
    programs: tuple[str, ...] = ()  # folders with a program, see `core.programs`
    thermostats: tuple[str, ...] = ()  # modules with a METHOD, see `scene.ensemble_methods`
    barostats: tuple[str, ...] = ()  # the same
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
            raise self.missing(needed_by)
        return import_module(f"{self.package}.{name}")

    def missing(self, needed_by: str) -> MissingFeatureError:
        return MissingFeatureError(
            f"{needed_by} needs the feature {self.name} ({self.summary}), which is not installed:"
            " install rigidmd with all its features"
        )

    def load(self, needed_by: str = "this"):
        """Its `Feature`, which adds nothing without a module `feature`. Raises
        MissingFeatureError."""
        if self.is_installed and find_spec(f"{self.package}.feature") is None:
            return import_module(__name__).FEATURE
        return self.module("feature", needed_by).FEATURE


class Feature:
    """What a feature does for scenes of molecules that use it. A method that a feature does not
    have adds nothing."""

    def kind(self) -> object:
        """The kind of scene that it adds, a `run.kind.Kind`. None without one."""
        return None

    def resolve(self, scene: Scene, species: list) -> tuple[Scene, list[str]]:
        """The scene with the defaults of the feature, and error messages.

        species : those of [[molecules]] first, then further ones of the structure
        """
        return scene, []

    def acting(self, parts: Parts) -> Parts:
        """The parts of a system as they interact, such as species with other charges."""
        return parts

    def potentials(self, scene: object) -> dict[str, Callable]:
        """Pair potentials in place of the core's, by keys of [forces]: functions `interactions` of
        the parts of a system."""
        return {}

    def extend(self, system: System, parts: object, *, user_code: bool) -> System:
        """The system with what the feature adds: terms, notes, `extras`. Raises SceneError.

        parts : of the system, before `acting`
        user_code : see `assemble.build.build`
        """
        return system

    def observers(self, system: object) -> list:
        """The observers (`run.observers`) that write the files of the feature in a run."""
        return []

    def explained(self, system: object) -> AbstractContextManager:
        """Errors in a block as errors of the scene, where the system is compiled or observed."""
        return nullcontext()

    def check_start(self, system: object, state: object) -> list[str]:
        """Notes on the system at the start of a run, before anything is compiled. Raises
        SceneError."""
        return []

    def check_forces(self, system: object, state: object) -> None:
        """Check the forces of the feature at the start of a run, where no molecules overlap. Raises
        SceneError."""

    def notes_on_start(self, system: object, state: object) -> list[str]:
        """Notes on the start of a run, after everything is compiled."""
        return []

    def warning_at(self, system: object, state: object) -> str:
        """A warning at a state in a run, which is given once. Empty without one."""
        return ""

    def axes(self, system: object) -> Iterator[tuple[str, str]]:
        """(species, "x", "y" or "z") of axes of bodies, in the coordinates of the models' files."""
        return iter(())

    def shapes(self, system: object) -> Iterator[tuple[str, list[tuple]]]:
        """(species, its ellipsoids) for species that are drawn with a shape. An ellipsoid has the
        index of its molecule, offset (3,) and frame (3, 3) in the body, semi-axes (3,) in Å and
        colour (3,), NaN for one by the direction of its axis."""
        return iter(())

    def step_biases(
        self, system: object, stage: object, columns: dict
    ) -> dict[str, tuple[float, float, float]] | str:
        """Means of columns of the log less those at a time step of zero, their errors, and the
        errors of the means at zero, by name, or why they are not known.

        columns : the samples (l,) of the production of a stage, by name
        """
        return {}

    def page_parts(self, record: object) -> Iterator[tuple[str, Iterator[str]]]:
        """(title, HTML texts) of parts of the page of a run."""
        return iter(())

    def trust(self, path: str | Path) -> None:
        """Allow scenes to run a Python file with these contents. Raises SceneError."""
        raise NotImplementedError

    def unused_files(self, scene: object, paths: Sequence[str]) -> list[str]:
        """The trusted files that a scene does not run."""
        raise NotImplementedError

    def check_trusted(self, scene: object, paths: Sequence[str]) -> None:
        """Raise SceneError for a trusted file that a scene does not run."""
        raise NotImplementedError

    def draw_model(self, path: Path, molecule: object, *, force: bool) -> None:
        """Write a picture of a molecular model."""
        raise NotImplementedError

    def engine(self, system: object, stage: int) -> object:
        """The engine of a program of the feature, for a stage. Raises SceneError with all that it
        lacks. EngineError if the program is not installed."""
        raise NotImplementedError

    def describe_engine(self, system: object) -> str:
        """What is installed of the program of a system. Raises SceneError."""
        raise NotImplementedError

    def compare_start(self, system: object, state: object, other: object) -> None:
        """Compare rigidmd with the engine of a program at the start. Raises EngineError."""
        raise NotImplementedError


FEATURE = Feature()  # of folders without a module `feature`
