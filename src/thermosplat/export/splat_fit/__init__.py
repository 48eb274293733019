"""Splats that are fitted to the exact render."""
