"""Scenes to measure on."""
