"""Types of the keywords of simulations, for type checkers and editors."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypedDict

if TYPE_CHECKING:
    from rigidmd.assemble.user_code.force import Force, HasStage, HasTerm
    from rigidmd.assemble.user_code.pair_potential import PairLaw
    from rigidmd.engines.body_system import Pose
    from rigidmd.run.observers import Observer


class Options(TypedDict, total=False):
    """Keywords of a `Simulation`."""

    observers: "Observer | Sequence[Observer]"
    say: Callable[[str], object] | None
    warn: Callable[[str], object]
    resume: bool
    walltime: float | None


class BodyOptions(Options, total=False):
    """Keywords of a `BodySimulation`."""

    applied: "Mapping[str, Callable[[Pose], tuple]] | None"


class MolecularOptions(Options, total=False):
    """Keywords of a `MolecularSimulation`."""

    forces: "Force | PairLaw | HasTerm | NamedTuple | Sequence[Force | PairLaw | HasTerm | NamedTuple]"
    thermostat: "NamedTuple | HasStage | None"


class AnyOptions(MolecularOptions, BodyOptions, total=False):
    """Keywords of a `Simulation` of any scene."""
