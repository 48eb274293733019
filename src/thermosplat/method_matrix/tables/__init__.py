"""Finished cells as tables."""
