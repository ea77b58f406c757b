"""The kinds of scenes, as commands and runs use them: molecules, and those that features add."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

import numpy as np

from rigidmd.core.toml import Json
from rigidmd.errors import SceneError
from rigidmd.io.folder import LOG
from rigidmd.scene.base import AnyScene, Scene
from rigidmd.scene.kinds import ADDED, MOLECULES

if TYPE_CHECKING:
    from rigidmd.engines.samples import SampleTable
    from rigidmd.engines.sites import AnySystem
    from rigidmd.engines.system import System
    from rigidmd.io.run_files import Columns
    from rigidmd.run.part import RunPart
    from rigidmd.run.record import Record
    from rigidmd.run.simulation import Simulation
    from rigidmd.scene import MolecularScene


SceneT = TypeVar("SceneT", bound=Scene)
SystemT = TypeVar("SystemT", bound="AnySystem")


class Kind(ABC, Generic[SceneT, SystemT]):
    """A kind of scene: what becomes of its scenes. Modules are imported when they are used.

    name : the table that only its scenes have
    takes : names of the arguments of `Simulation` with user-defined code that its scenes take
    takes_instead : the end of the message on other such arguments
    lacks : what its scenes do not have, such as an option -> the message
    energy_unit : the default unit of `rigidmd energy`
    samples_file : the file of samples of a run
    next_command : the command that `rigidmd run` names at the end of a run
    """

    name: ClassVar[str]
    takes: ClassVar[tuple[str, ...]] = ()
    takes_instead: ClassVar[str]
    lacks: ClassVar[Mapping[str, str]] = {}
    energy_unit: ClassVar[str]
    samples_file: ClassVar[str]
    next_command: ClassVar[str] = "report"

    @abstractmethod
    def build(self, scene: SceneT, *, user_code: bool = True) -> SystemT:
        """The system of a scene. Raises SceneError, and errors of files that the scene reads.

        user_code : whether its user-defined code is loaded
        """

    @abstractmethod
    def describe(self, system: SystemT, *, verbose: bool = False) -> str:
        """How the scene of a system would run. Raises SceneError if it would not.

        verbose : with what is compiled in and what is omitted, and the reasons
        """

    @abstractmethod
    def step_errors(self, system: SystemT) -> list[str]:
        """Error messages on the unstable time steps of a system."""

    @abstractmethod
    def step_warnings(self, system: SystemT) -> list[str]:
        """Warnings on the other time steps."""

    @abstractmethod
    def run_part(self, simulation: "Simulation", scene: SceneT, user_code: Json) -> "RunPart":
        """The part of a simulation that depends on the kind of scene."""

    @abstractmethod
    def energy_lines(self, name: str, energies: Json, unit: str) -> list[str]:
        """Energies of the start as text."""

    @abstractmethod
    def read_samples(self, path: Path) -> "Columns | None":
        """The file of samples, its columns by headers. None without a file. Raises OutputError."""

    @abstractmethod
    def columns_of_run(
        self, folder: Path, system: SystemT, missing: list[str]
    ) -> dict[str, np.ndarray]:
        """The samples of a run by the names of `results[...]`. Empty before the first one.

        missing : gets sentences about missing data
        """

    @abstractmethod
    def samples_of(self, record: "Record") -> "SampleTable":
        """The samples of a stored run."""

    def adds_to(self, feature: str) -> object:
        """What it adds to a feature, as an object of a class of that feature. None for scenes of
        molecules, which the features treat themselves."""
        return None

    def check_has(self, scene: Scene, what: str, **values: object) -> None:
        """Raise SceneError if its scenes lack something. `values` are inserted in the message."""
        if message := self.lacks.get(what):
            raise SceneError(scene.source, [message.format(**values)])


class Molecules(Kind["MolecularScene", "System"]):
    name = MOLECULES
    takes = ("forces", "thermostat")
    takes_instead = "for a single body. Molecules take forces=[...]"
    energy_unit = "kJ/mol"
    samples_file = LOG
    next_command = "analyse"

    def build(self, scene: "MolecularScene", *, user_code: bool = True) -> "System":
        from rigidmd.assemble.build import build

        return build(scene, user_code)

    def describe(self, system: "System", *, verbose: bool = False) -> str:
        from rigidmd.assemble.describe import describe_system

        return describe_system(system, verbose=verbose)

    def step_errors(self, system: "System") -> list[str]:
        from rigidmd.assemble.time_step import step_errors

        return step_errors(system.scene)

    def step_warnings(self, system: "System") -> list[str]:
        from rigidmd.assemble.time_step import step_warnings

        return step_warnings(system.scene)

    def run_part(
        self, simulation: "Simulation", scene: "MolecularScene", user_code: Json
    ) -> "RunPart":
        from rigidmd.run.molecular import MolecularRun

        return MolecularRun(simulation, scene, **user_code)

    def energy_lines(self, name: str, energies: Json, unit: str) -> list[str]:
        from rigidmd.run.report import energy_lines

        return energy_lines(name, energies, unit)

    def read_samples(self, path: Path) -> "Columns | None":
        from rigidmd.io.run_files import read_columns

        return read_columns(path)

    def columns_of_run(
        self, folder: Path, system: "System", missing: list[str]
    ) -> dict[str, np.ndarray]:
        from rigidmd.run.stored_log import read_log

        return read_log(folder, system)

    def samples_of(self, record: "Record") -> "SampleTable":
        return record.log


def kind_named(name: str) -> Kind:
    """The kind of scenes with a table. Raises MissingFeatureError."""
    if name == MOLECULES:
        return Molecules()
    return ADDED[name].load(f"a scene with [{name}]").kind()


def kind_of(scene: Scene) -> Kind:
    """The kind of a scene."""
    return kind_named(scene.kind)


def kinds() -> list[Kind]:
    """All kinds of scenes that are installed."""
    return [
        Molecules(),
        *(kind_named(name) for name, row in ADDED.items() if row.is_installed),
    ]


def with_defaults(scene: AnyScene) -> AnyScene:
    """The same scene with all defaults, which runs to the same bits.

    The integrator "auto" stays until a run has chosen one.

    Parameters
    ----------
    scene : Scene
        The scene

    Returns
    -------
    Scene
        A scene of the same kind

    Raises
    ------
    SceneError
        If the scene has errors.
    StructureError, MoleculeError
        For molecules, if a file of a structure or of a model has errors.
    """
    return kind_of(scene).build(scene).scene


def describe(scene: Scene, *, user_code: bool = True, verbose: bool = False) -> str:
    """How a scene would run. Raises the errors of `Kind.build`."""
    kind = kind_of(scene)
    return kind.describe(kind.build(scene, user_code=user_code), verbose=verbose)
