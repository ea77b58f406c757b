"""Stress tests of the engine, each compared with a known answer."""

from rigidmd.features.bodies import stability  # noqa: F401
from rigidmd.features.studies.stability import molecules  # noqa: F401  (register builders)
