"""From a scene to what runs: species, start, terms (`system`); ASE reads structure files here and nowhere else."""
