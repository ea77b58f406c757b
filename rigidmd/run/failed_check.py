"""The error that a failed check raises, and limits that are common to the checks of molecules and
bodies."""

from math import sqrt

import numpy as np

from rigidmd.errors import SimulationError

#: A moment of inertia is suspiciously small below this fraction of mass times the square of the
#: distance of the outermost site (for a body: of its largest moment). For water the fraction is
#: 0.05.
MIN_INERTIA_FRACTION = 0.01
#: Rounding may change a potential energy by this fraction, half of its digits.
ROUNDING = sqrt(np.finfo(float).eps)
#: A larger relative error of the energy of a run without heat means that its motion is wrong.
LARGE_ENERGY_ERROR = 1e-3


class FailedCheck(SimulationError):
    """A failed check. Its message is a sentence.

    molecule : index of the molecule concerned
    factor : by which the step would have to be shorter to stay within the limit, if known
    rotation_not_orthogonal : whether Q is wrong; evaporated : whether the box has grown too large
    """

    def __init__(
        self,
        message: str,
        molecule: int | None = None,
        factor: float | None = None,
        *,
        rotation_not_orthogonal: bool = False,
        evaporated: bool = False,
    ):
        super().__init__(message)
        self.molecule, self.factor = molecule, factor
        self.rotation_not_orthogonal, self.evaporated = rotation_not_orthogonal, evaporated
