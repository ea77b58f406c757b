"""Code of users in a scene: forces, pair potentials, thermostats, and which files may be imported."""
