"""Stress tests of the engine, each compared with a known answer."""

from rigidmd.studies.stability import bodies, molecules  # noqa: F401  (register builders)
