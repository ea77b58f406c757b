"""Pair energies of bodies, as functions of their relative position and their orientations.

`formulas` compiles a user's function with its slopes, `pairs` has the term, and one module each the
shipped potentials.
"""
