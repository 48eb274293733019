"""Scenes of several dates in one frame: what became warmer or colder, what is gone or new."""
