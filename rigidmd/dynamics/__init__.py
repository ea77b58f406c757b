"""Steps in time: `advance` is the compiled loop over a row of flows; kicks, drifts and baths are flows of it."""
