"""`rigidmd stability`: a test suite of extreme cases for the engine, each a scene made in code."""
