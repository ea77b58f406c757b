"""The other engine of a scene, by name, and what it cannot do."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from rigidmd.assemble.system import System
from rigidmd.dynamics.advance import Model
from rigidmd.engines import Engine
from rigidmd.errors import SceneError
from rigidmd.peers.portrait import Portrait, portrait


class OtherEngine(Engine, Protocol):
    """An `Engine` of another program."""

    made_by: str  # its name and version
    moves: tuple[int, int]  # of the box, tried and accepted; (0, 0) where it does not tell
    lengths_to: float  # relative error of lengths in its molecules
    counts_heat: bool  # whether it counts what its thermostat and barostat take out; if not, heat is what energy gains

    def rotor(self, model: Model) -> "NamedTuple | None":
        """The rotor that turns bodies in its very steps; None if its method is another one."""
        ...

    def close(self) -> None:
        """End what it has started."""
        ...


def other_engine(system: System, stage: int = 0) -> OtherEngine:
    """The engine that the scene names, for one of its stages.

    Raises SceneError with all that it cannot do, EngineError if it is not here.
    """
    refuse(system)
    choice = system.scene.engine
    if choice.name == "lammps":
        from rigidmd.peers.lammps import LammpsEngine

        return LammpsEngine(system, stage, choice.ranks or 1)
    from rigidmd.peers.openmm import OpenmmEngine

    return OpenmmEngine(system, stage, choice.platform or "CPU")


def refuse(system: System) -> None:
    """Raise SceneError with all that the engine of a scene cannot do."""
    choice = system.scene.engine
    if not choice.is_other:
        return
    if found := _faults_of(choice.name)(portrait(system)):
        raise SceneError(system.scene.source, [f"engine.name = {choice.name!r}: {fault}" for fault in found])


def _faults_of(name: str) -> Callable[[Portrait], list[str]]:
    if name == "lammps":
        from rigidmd.peers.lammps_files import faults
    else:
        from rigidmd.peers.openmm_system import faults
    return faults
