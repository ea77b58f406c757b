"""`rigidmd stability`: a battery of cases that try to break the engine, each a scene made in code."""
