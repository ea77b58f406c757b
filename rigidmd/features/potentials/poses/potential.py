"""A potential of pairs of bodies as it is specified, before it is bound to a system."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from rigidmd.scene.molecules import UserForce

if TYPE_CHECKING:
    from rigidmd.features.potentials.poses.table import BodyTable

Parameters = Mapping[str, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class BodyPairPotential(UserForce):
    """A potential of pairs of bodies for `Simulation(scene, forces=[...])`, made by
    `body_pair_potential`."""

    function: "Callable | BodyTable"  # of (r, a, b), or a table
    parameters: Mapping[str, Parameters]  # by species
    species: tuple[str, ...]  # on which it acts; none: on all
    pairs: Mapping[tuple[str, str], Parameters]
    axis: Literal["x", "y", "z"] | None
    references: Mapping[str, Vector]
    truncation: Literal["switch", "plain"]
    cutoff_A: float | None
    switch_start_A: float | None
    name: str

    def acts_on(self, species: str) -> bool:
        """Whether a species takes part."""
        named = self.species or self.parameters
        return not named or species in named

    def parameters_of(self, one: str, other: str) -> tuple[Parameters, Parameters]:
        """The parameters of two species in a pair of them."""
        pairs = self.pairs
        of_pair = pairs.get((one, other)) or pairs.get((other, one)) or {}
        first, second = ({**self.parameters.get(name, {}), **of_pair} for name in (one, other))
        return first, second
