"""Pair energies of bodies, as functions of their relative position and their orientations.

`trace` records a user's function, `slopes` derives its slopes and writes its code, and `formulas`
compiles it. `pairs` has the term, `pair_list` its neighbour list, `trials` energies of trial
molecules, and one module each the shipped potentials.
"""
