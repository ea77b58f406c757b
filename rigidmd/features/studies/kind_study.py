"""What studies need of a kind of scene that a feature adds."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import TYPE_CHECKING, ClassVar, Generic, NamedTuple, TypeVar, cast

from rigidmd.core.toml import Json
from rigidmd.run.kind import kind_of, kinds
from rigidmd.run.record import Record
from rigidmd.run.trials import TrialSystem
from rigidmd.scene import Scene

if TYPE_CHECKING:
    from rigidmd.features.studies.stability.cases import Trial

#: A value and its error, or None.
Measured = tuple[float, float | None]


class AccuracyStart(NamedTuple):
    """The start of a measurement of accuracy.

    base : time step of one force evaluation, in the middle of the default steps
    integrator : of the scene
    """

    trial_system: TrialSystem
    base: float
    integrator: str


SceneT = TypeVar("SceneT", bound=Scene)


class KindStudy(ABC, Generic[SceneT]):
    """What studies measure of the scenes of a kind.

    main_columns : of the table of a sweep, those that are printed and drawn
    """

    main_columns: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def summarise(self, record: Record) -> dict[str, Measured]:
        """The results of a run, for the table of a sweep."""

    @abstractmethod
    def accuracy_start(self, scene: SceneT, span: float | None) -> AccuracyStart:
        """What `rigidmd accuracy` measures for `span`. Raises SceneError."""

    @abstractmethod
    def method_name(self, name: str, scene: SceneT) -> str:
        """The full name of a method of `rigidmd accuracy`."""

    @abstractmethod
    def complete_trial(self, trial: "Trial", method: Json, step: float) -> Json:
        """The tables of the scene of a stability trial."""

    @abstractmethod
    def add_stability_cases(self) -> None:
        """Register cases of `rigidmd stability`."""


def study_of(scene: Scene) -> KindStudy | None:
    """The study of a kind of scene. None for molecules."""
    return cast("KindStudy | None", kind_of(scene).adds_to("studies"))


def studies() -> Iterator[tuple[str, KindStudy]]:
    """Kinds of scenes, by the table that only they have, and their studies."""
    for kind in kinds():
        if (study := kind.adds_to("studies")) is not None:
            yield kind.name, cast(KindStudy, study)
