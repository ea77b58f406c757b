"""`rigidmd stability`: a battery of cases that tries to break the engine, each a scene made in code."""
