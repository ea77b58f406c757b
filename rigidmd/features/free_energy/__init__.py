"""Free energies: coupling, insertion, mean force and virial coefficients."""
