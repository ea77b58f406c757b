"""Fixtures of the tests of sweeps."""

from support.sweeps import argon, copied, finished  # noqa: F401
