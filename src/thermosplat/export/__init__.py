"""Trained scenes as files that other programs open."""
