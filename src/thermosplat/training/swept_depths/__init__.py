"""Depths of training views by plane sweeps."""
