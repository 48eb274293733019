"""Surfaces that a spectrum sees: depth, points, meshes."""
