"""The keys of scenes of a body."""
