"""Slopes of the energy of a state by differences: oracles of forces, torques and virials."""

import numpy as np

from rigidmd.mechanics.rotation import from_vector


def energy_of(engine, state):
    """The sum over the terms of an engine, u Å²/ps²."""
    return sum(tally.energy for tally in engine.evaluate(state)[1].values())


def slope(energy, state, move, h):
    """The derivative of `energy(state)` by the step of `move(state, step)`, with an error of order h⁴."""

    def at(step):
        moved = state.copy()
        move(moved, step)
        return energy(moved)

    return (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)


def force_on(m, energy, state, h):
    """The force (3,) on a molecule."""

    def shift(k):
        def move(moved, step):
            moved.position[m, k] += step

        return move

    return -np.array([slope(energy, state, shift(k), h) for k in range(3)])


def torque_on(m, energy, state, h):
    """The torque (3,) on a molecule, in its own frame."""

    def rotate(k):
        def move(moved, step):
            moved.rotation[m] = moved.rotation[m] @ from_vector(step * np.eye(3)[k])

        return move

    return -np.array([slope(energy, state, rotate(k), h) for k in range(3)])


def virial_of(energy, state, h, component):
    """The slope with the strain that gives a component (i, j) of the virial, of centres of mass and cell."""
    i, j = component

    def strain(moved, step):
        moved.position[:, i] += step * moved.position[:, j]
        if np.isfinite(moved.cell).all():
            moved.cell[:, i] += step * moved.cell[:, j]

    return -slope(energy, state, strain, h)


def trace_of_virial(energy, state, h):
    """The slope with the logarithm of the edges."""

    def scale(moved, step):
        moved.position[:] *= 1 + step
        moved.cell[:] *= 1 + step

    return -slope(energy, state, scale, h)
