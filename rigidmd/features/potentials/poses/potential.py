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
    `body_pair_potential`.

    Attributes
    ----------
    function : callable or BodyTable
        Energy of (r, a, b), or a table
    parameters : dict of str to dict
        Species -> parameters
    species : tuple of str
        Species on which it acts. Empty for all
    pairs : dict
        (species, species) -> parameters of the pair
    axis : str or None
        Axis of the models' files along which unit vectors are
    references : dict of str to tuple
        Species -> reference point (3,), Å
    truncation : str
        "switch" or "plain"
    cutoff_A, switch_start_A : float or None
        Cutoff and start of the switch, Å
    name : str
        Name in the log and in messages
    """

    function: "Callable | BodyTable"
    parameters: Mapping[str, Parameters]
    species: tuple[str, ...]
    pairs: Mapping[tuple[str, str], Parameters]
    axis: Literal["x", "y", "z"] | None
    references: Mapping[str, Vector]
    truncation: Literal["switch", "plain"]
    cutoff_A: float | None
    switch_start_A: float | None
    name: str

    def acts_on(self, species: str) -> bool:
        """Whether a species takes part.

        Parameters
        ----------
        species : str
            Name of the species

        Returns
        -------
        bool
            True if the potential acts on it
        """
        named = self.species or self.parameters
        return not named or species in named

    def parameters_of(self, one: str, other: str) -> tuple[Parameters, Parameters]:
        """The parameters of two species in a pair of them.

        Parameters
        ----------
        one, other : str
            Names of the species

        Returns
        -------
        tuple of dict
            Parameters of the first and of the second species
        """
        pairs = self.pairs
        of_pair = pairs.get((one, other)) or pairs.get((other, one)) or {}
        first, second = ({**self.parameters.get(name, {}), **of_pair} for name in (one, other))
        return first, second
