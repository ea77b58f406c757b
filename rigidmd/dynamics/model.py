"""The constant part of a system of molecules. The counterpart of `State`, which is everything that
changes."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.state import State
from rigidmd.forces.terms import trait
from rigidmd.mechanics.free_rotor import ExactRotor, NoRotor, SplitRotor
from rigidmd.units import BOLTZMANN

if TYPE_CHECKING:
    from rigidmd.forces.parts import Masses


class Model(NamedTuple):
    """What never changes during a run of molecules."""

    species: np.ndarray  # (n,) species of each molecule
    mass: np.ndarray  # (species,) u
    inverse_mass: np.ndarray  # (species,) 1/u; 0 for a frozen species
    inertia: np.ndarray  # (species, 3) principal moments, u Å²; 0 about an axis without inertia
    inverse_inertia: np.ndarray  # (species, 3); 0 where the moment is 0
    rotor: SplitRotor | ExactRotor | NoRotor
    # (3,) whether each component of the total momentum is conserved
    keeps_momentum: np.ndarray = np.ones(3, bool)


#: A total momentum below this fraction of the sum of |m v| is rounding.
AT_REST = 1e-9


class DegreesOfFreedom(NamedTuple):
    """Degrees of freedom. Conserved components of the total momentum are zero and not counted."""

    translation: int
    rotation: int

    @property
    def total(self) -> int:
        return self.translation + self.rotation


def count_degrees_of_freedom(model: Model) -> DegreesOfFreedom:
    """Degrees of freedom of all molecules together."""
    turning = (model.inertia > 0).sum(axis=1)
    free = 3 * int(mobile(model).sum()) - int(model.keeps_momentum.sum())
    return DegreesOfFreedom(free, int(turning[model.species].sum()))


def conserved_momentum(model: "Masses", terms: Mapping[str, NamedTuple]) -> np.ndarray:
    """Whether each component (3,) of the total momentum is conserved, as in `Model.keeps_momentum`.
    None is conserved if there are frozen molecules. `changes_momentum` of a term lists the
    components that it changes."""
    conserved = np.full(3, bool(mobile(model).all()))
    for term in terms.values():
        if (changed := trait(term, "changes_momentum")) is not None:
            conserved &= ~changed
    return conserved


def mobile(model: "Masses") -> np.ndarray:
    """Whether each molecule (n,) can move, that is, is not frozen."""
    return model.inverse_mass[model.species] > 0


def remove_momentum(model: Model, velocity: np.ndarray) -> float:
    """Subtract one velocity from all molecules, in place, so that conserved components of the total
    momentum are zero. Returns the kinetic energy that this removes, u Å²/ps², 0 if the momentum was
    zero already."""
    mass = model.mass[model.species]
    each = mass[:, None] * velocity
    momentum = np.where(model.keeps_momentum, each.sum(axis=0), 0.0)
    if np.abs(momentum).max() <= AT_REST * np.abs(each).sum():
        return 0.0
    velocity -= momentum / mass.sum()
    return float(momentum @ momentum / (2 * mass.sum()))


def draw_momenta(model: Model, state: State, temperature: float, rng: np.random.Generator) -> None:
    """Draw Maxwell-Boltzmann momenta, in place, and scale them to exactly `temperature` (K),
    T_trans and T_rot. The conserved components of the total momentum are zero."""
    thermal = BOLTZMANN * temperature
    mass = model.mass[model.species]
    freedom = count_degrees_of_freedom(model)
    spread = np.sqrt(thermal * model.inverse_mass[model.species])
    state.velocity[:] = rng.standard_normal(state.velocity.shape) * spread[:, None]
    remove_momentum(model, state.velocity)
    kinetic = 0.5 * mass @ (state.velocity**2).sum(axis=1)
    scales = kinetic > 0 and freedom.translation
    state.velocity[:] *= np.sqrt(0.5 * freedom.translation * thermal / kinetic) if scales else 0.0
    if len(state.angular_momentum_body):
        spread = np.sqrt(thermal * model.inertia[model.species])
        state.angular_momentum_body[:] = rng.standard_normal(spread.shape) * spread
        kinetic = (
            0.5 * (state.angular_momentum_body**2 * model.inverse_inertia[model.species]).sum()
        )
        if kinetic > 0:
            state.angular_momentum_body[:] *= np.sqrt(0.5 * freedom.rotation * thermal / kinetic)
