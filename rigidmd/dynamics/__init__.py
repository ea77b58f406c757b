"""Steps in time: schemes are rows of coefficients, `advance` is the compiled loop, thermostats are flows of it."""
