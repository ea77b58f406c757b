"""Sums over periodic images: Ewald's, wave by wave and on a mesh."""
