"""Energies of trial bodies with the bodies of a system: without a list, and without forces."""

from math import inf, isfinite, sqrt

import numpy as np

from rigidmd.compile import kernel
from rigidmd.core.state import State
from rigidmd.features.potentials.poses.pairs import BodyPairs, pair_slopes, switch
from rigidmd.forces.neighbors.space import nearest_image


def add_trial_energies(
    term: BodyPairs, host: State, position: np.ndarray, rotation: np.ndarray, energy: np.ndarray
) -> None:
    """Add the energies of trials of the last body of a term to `energy` (m,), u Å²/ps²; inf where
    it is not finite.

    host : state of the other bodies; position (m, 3) Å, rotation (m, 3, 3) of the trials
    """
    kind = int(term.kind[-1])
    others = np.flatnonzero((term.kind[:-1] >= 0) & (term.group[:-1] != term.group[-1]))
    if kind < 0 or not len(others):
        return
    kinds = term.kind[others]
    turned = host.rotation if len(host.rotation) else np.tile(np.eye(3), (len(host.position), 1, 1))
    arms = np.einsum("nij,nj->ni", turned[others], term.reference[kinds])
    _add_energies(
        term,
        kinds,
        host.position[others] + arms,
        turned[others] @ term.frame[kinds],
        position + rotation @ term.reference[kind],
        rotation @ term.frame[kind],
        host.cell,
        energy,
    )


@kernel(from_python=True)
def _add_energies(term, kinds, point, pose, trial_point, trial_pose, cell, energy):
    """Points (n, 3) and poses (n, 3, 3) of bodies with `kinds`, and those (m, ...) of trials."""
    trial_kind = term.kind[len(term.kind) - 1]  # the last body of the term is the trial
    for m in range(len(energy)):
        if energy[m] == inf:
            continue
        total = 0.0
        for j in range(len(kinds)):
            x, y, z = nearest_image(
                cell,
                point[j, 0] - trial_point[m, 0],
                point[j, 1] - trial_point[m, 1],
                point[j, 2] - trial_point[m, 2],
            )
            r = sqrt(x * x + y * y + z * z)
            if r >= term.cutoff:
                continue
            # Parameters are stored for (lower kind, higher kind) only: otherwise swap the bodies
            # and reverse the vector between them.
            if trial_kind <= kinds[j]:
                numbers = term.parameters[trial_kind, kinds[j]]
                value = pair_slopes(term.formula, numbers, (x, y, z), trial_pose[m], pose[j])[0]
            else:
                numbers = term.parameters[kinds[j], trial_kind]
                value = pair_slopes(term.formula, numbers, (-x, -y, -z), pose[j], trial_pose[m])[0]
            total += switch(term, r)[0] * value
        # nan and -inf become +inf, as an overlap has
        energy[m] = energy[m] + total if isfinite(total) else inf
