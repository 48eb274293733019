"""Temperatures of a scene: recalculated, measured, kept, and how far they can be trusted."""
