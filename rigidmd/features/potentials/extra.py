"""What users add to a system."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rigidmd.engines.system import Extra, System
from rigidmd.features.potentials.poses.potential import BodyPairPotential

NAME = "potentials"


@dataclass(frozen=True)
class UserExtra(Extra):
    """Terms and a thermostat of users."""

    #: Name of a term that is a potential of pairs of bodies -> the potential
    body_pairs: Mapping[str, BodyPairPotential] = field(default_factory=dict)


def with_extra(system: System, extra: UserExtra) -> System:
    return replace(system, extras=system.extras | {NAME: extra})


def body_pairs_of(system: System) -> Mapping[str, BodyPairPotential]:
    """The potentials of pairs of bodies in a system, by the names of their terms."""
    extra = system.extras.get(NAME)
    return extra.body_pairs if isinstance(extra, UserExtra) else {}
