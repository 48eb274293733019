"""Clocks, memory, peaks of a device and floors of its work: what every benchmark measures with."""
