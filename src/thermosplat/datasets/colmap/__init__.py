"""Captures with a COLMAP model: its files, and the layouts that stand on it."""
