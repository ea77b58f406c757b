"""Rigid molecules with ASE, both ways: see `features.calculators`."""

from rigidmd.features.calculators.calculator import CalculatorForce, RigidMD, read_rigidmd

__all__ = ["CalculatorForce", "RigidMD", "read_rigidmd"]
