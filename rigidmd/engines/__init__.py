"""Engines, which move systems: the protocol, the compiled CPU engine, the ODE solver of SciPy, and
other programs."""
