"""Thermal images of another hour: their places in the scene of the photographs."""
