"""Thermal values: palettes and their inverse, intensities, units."""
