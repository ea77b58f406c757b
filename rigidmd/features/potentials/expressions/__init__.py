"""Expressions of users as graphs of numbers, with their slopes and their code.

`text` reads the text of an energy, `trace` records a function of NumPy, `slopes` differentiates
graphs and writes code, and `radial` arranges functions of one distance for a pair loop.
"""
