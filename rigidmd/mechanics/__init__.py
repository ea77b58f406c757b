"""The rigid body itself: orientation, inertia and the flows that turn it. Knows nothing of molecules."""
