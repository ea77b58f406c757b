"""User code: forces, pair potentials, thermostats, and which files may be imported."""
