"""Orthomosaics: maps of a scene seen from above."""
