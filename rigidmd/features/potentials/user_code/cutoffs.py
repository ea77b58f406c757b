"""Checks of users' pair potentials at their cutoff."""

from collections.abc import Callable
from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.plausibility import too_short
from rigidmd.engines.system import System
from rigidmd.features.potentials.expressions.text import FormulaError
from rigidmd.forces.potentials.truncation import MINIMUM_TOLERANCE
from rigidmd.formats.cells import pairs_within
from rigidmd.scene.truncation import TruncationName
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

#: Largest energy at the cutoff without a warning, in kT, see `ValuesAtCutoff.lost`. Lennard-Jones
#: forces with usual cutoffs have 0.02 to 0.05.
LARGEST_AT_CUTOFF = 0.2
#: Sites and bodies touch where their energy is above this multiple of kT, and falls as a power of
#: the distance that is above STEEP. Without a cutoff, contacts are searched around
#: LONGEST_CONTACT, Å.
HIGH, STEEP, LONGEST_CONTACT = 10.0, 6.0, 10.0
#: Neighbours at the start are searched within this multiple of their mean distance. Without a
#: cutoff, energies are tried up to this multiple of that.
NEIGHBOUR, FAR = 1.2, 10.0
#: A minimum is searched up to this multiple of the cutoff.
REACH = 20.0


class PairPotentialError(ValueError):
    """Errors of a pair potential in a scene."""

    def __init__(self, *errors: str):
        self.errors = list(errors)
        super().__init__("; ".join(errors))


class ValuesAtCutoff(NamedTuple):
    """A pair potential where it is cut off, u Å²/ps²."""

    cutoff: float  # Å
    energy: float
    force: float
    # largest change of the energy up to twice the cutoff; 0 if the potential ends at its cutoff
    change: float

    @classmethod
    def of(
        cls, radial: Callable[[float], tuple], cutoff: float, ends_there: bool
    ) -> "ValuesAtCutoff":
        """ends_there : whether the potential is not known beyond the cutoff"""
        if cutoff == inf:
            return cls(cutoff, 0.0, 0.0, 0.0)
        energy, force, _ = radial(cutoff)
        beyond = (
            [] if ends_there else [abs(radial(x * cutoff)[0] - energy) for x in (1.25, 1.5, 2.0)]
        )
        return cls(cutoff, energy, force, max([x for x in beyond if isfinite(x)], default=0.0))

    def lost(self, truncation: TruncationName) -> float:
        """What the truncation changes: the energy jump, the energy change beyond the cutoff, and
        the work over a tenth of the cutoff, whichever is largest."""
        jump = abs(self.energy) if truncation == "plain" else 0.0
        return max(jump, self.change, 0.1 * self.cutoff * abs(self.force))

    def describe(self, between: str, truncation: TruncationName, thermal: float, scale: str) -> str:
        """A sentence. scale : what `thermal` is, such as kT at 298 K"""
        energy, force = (f"{value / KJ_PER_MOL:.3g}" for value in (self.energy, self.force))
        text = (
            f"is {energy} kJ/mol ({self.energy / thermal:.2g} {scale}) at its cutoff of"
            f" {self.cutoff:g} Å with truncation = {truncation}, between {between}, and its force"
            f" is {force} kJ/mol/Å. Beyond it does not act"
        )
        if self.change > abs(self.energy):
            text += f", where it would change by {self.change / thermal:.2g} {scale}"
        return f"{text}. Use a longer cutoff, or an energy that vanishes there"


def energy_scale(system: System) -> tuple[float, str]:
    """The smallest kT of a scene, or else its deepest well between two sites (u Å²/ps²), and its
    name, 0 without."""
    scene = system.scene
    temperatures = [x for stage in scene.stages for x in stage.temperatures if x > 0]
    temperature = min(temperatures, default=scene.start.temperature_K or 0.0)
    if temperature:
        return BOLTZMANN * temperature, f"kT at {temperature:g} K"
    return (
        max((float(m.epsilon.max()) for m in system.species), default=0.0) or inf,
        "of the deepest well",
    )


def minimum_beyond(cutoff: float, radial: Callable[[float], tuple]) -> float | None:
    """The distance (Å) of the minimum of an energy, if it lies beyond the cutoff, within which
    sites only repel."""
    if cutoff == inf:
        return None

    def attracts(r: float) -> bool:
        try:
            return radial(r)[1] < 0
        except (FormulaError, ArithmeticError, ValueError):
            return False

    if any(attracts(cutoff * x) for x in np.linspace(0.5, 1 - MINIMUM_TOLERANCE, 32)):
        return None
    return next((cutoff * x for x in np.geomspace(1, REACH, 400)[1:] if attracts(cutoff * x)), None)


def contact_of(energy: Callable[[np.ndarray], np.ndarray], cutoff: float, system: System) -> float:
    """The distance (Å) up to which two sites or bodies repel strongly, 0 without one or without a
    temperature: the energy is high and steep there.

    energy : u Å²/ps² at distances (k,) Å; NaN where it has none
    """
    scene = system.scene
    temperatures = [x for stage in scene.stages for x in stage.temperatures]
    hottest = max([*temperatures, scene.start.temperature_K or 0.0])
    r = np.geomspace(0.01, 10, 100) * (LONGEST_CONTACT if cutoff == inf else cutoff)
    with np.errstate(all="ignore"):
        values = energy(r)
        steepness = -np.gradient(np.log(values), np.log(r))
        repels = (values > HIGH * BOLTZMANN * hottest) & (steepness > STEEP)
    return float(r.max(where=repels, initial=0.0)) if hottest else 0.0


def start_distances(
    position: np.ndarray, kind: np.ndarray, group: np.ndarray, cutoff: float, system: System
) -> dict[tuple[int, int], np.ndarray]:
    """Distances (Å) from the nearest neighbours at the start to the cutoff, of each pair of kinds
    that has neighbours there.

    position (n, 3), kind (n,), group (n,) : of sites or bodies; those of one group do not interact
    """
    cell = system.state.cell if system.space.volume < inf else None
    extent = np.ptp(position, axis=0).clip(1.0).prod() if cell is None else system.space.volume
    reach = min(cutoff, NEIGHBOUR * (extent / len(position)) ** (1 / 3))
    i, j, step = pairs_within(position, cell, reach)
    acts = group[i] != group[j]
    lengths = np.linalg.norm(step[acts], axis=1)
    order = np.argsort(lengths)
    pairs = np.sort([kind[i[acts]], kind[j[acts]]], axis=0)[:, order]
    kinds, at = np.unique(pairs, axis=1, return_index=True)
    last = FAR * reach if cutoff == inf else cutoff * (1 - 1e-9)
    return {
        (int(one), int(other)): np.geomspace(r, max(r, last), 20)
        for (one, other), r in zip(kinds.T, lengths[order][at], strict=True)
        if r > 0
    }


def not_finite(between: str, r: float) -> str:
    """The message on a distance (Å) of `start_distances` without a finite energy."""
    return (
        f"its energy or force is not a finite number between {between} at {r:.4g} Å: that is"
        " between the nearest ones of the start and the cutoff"
    )


def check_lengths(contact: float, touching: str, cutoff: float, switch_start: float | None) -> None:
    """Raise PairPotentialError for lengths (Å) of a potential that are far within a contact."""
    lengths = {"cutoff_A": cutoff, "switch_start_A": switch_start}
    if errors := too_short(lengths, contact, touching):
        raise PairPotentialError(*errors)


def check_cutoff(cutoff: float, system: System) -> None:
    """Raise PairPotentialError unless the box is large enough for a cutoff (Å)."""
    half = min(system.space.edges) / 2
    if cutoff == inf and system.space.volume < inf:
        raise PairPotentialError("it has no cutoff, and the box is periodic: set cutoff_A")
    if not cutoff <= half:
        raise PairPotentialError(
            f"its cutoff of {cutoff:g} Å is longer than half an edge of the box, {half:.3f} Å"
        )
