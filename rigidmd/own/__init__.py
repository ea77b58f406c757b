"""What users add to the engine: forces, pair laws and thermostats of their own, and the check of their files."""
