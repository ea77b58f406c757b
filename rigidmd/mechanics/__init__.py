"""The rigid body: orientation, inertia and the flows that rotate it. Nothing here depends on
molecules."""
