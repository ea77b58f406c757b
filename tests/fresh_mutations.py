"""Mutations chosen by someone who did not write the tests that should find them; the same form as in mutation_list.py."""

from mutation_list import Mutation

FRESH: list[Mutation] = []
