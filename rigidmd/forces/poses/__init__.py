"""Pair energies of bodies, as functions of their relative position and their orientations.

`trace` derives slopes of a user's function, `pairs` has the term and its neighbour list, and one
module each the shipped potentials.
"""
