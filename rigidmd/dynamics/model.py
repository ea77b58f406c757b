"""The constant part of a system of molecules; the counterpart of `State`, which is everything that changes."""

from typing import NamedTuple

import numpy as np

from rigidmd.mechanics.free_rotor import ExactRotor, NoRotor, SplitRotor


class Model(NamedTuple):
    """What never changes during a run of molecules."""

    species: np.ndarray  # (n,) species of each molecule
    mass: np.ndarray  # (species,) u
    inverse_mass: np.ndarray  # (species,) 1/u; 0 for a frozen species
    inertia: np.ndarray  # (species, 3) principal moments, u Å²; 0 about an axis without inertia
    inverse_inertia: np.ndarray  # (species, 3); 0 where the moment is 0
    rotor: SplitRotor | ExactRotor | NoRotor
    keeps_momentum: np.ndarray = np.ones(3, bool)  # (3,) whether each component of the total momentum is conserved
