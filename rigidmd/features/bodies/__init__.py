"""A single rigid body: tops, gyroscopes, bodies in a fluid, satellites."""
