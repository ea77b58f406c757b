"""ASE calculators: an engine of rigid molecules for ASE, and forces from a calculator of ASE."""
