"""Crystals: CIF and symmetry, and the formats that liquids do not need."""
