"""From a scene to what runs: species, start, terms (`system`). Only this room uses ASE, to read structure files."""
