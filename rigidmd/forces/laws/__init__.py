"""Laws between pairs of sites, one file each, and how they end at a cut-off."""
