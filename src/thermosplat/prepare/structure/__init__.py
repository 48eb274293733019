"""Poses of the photographs by structure from motion, with COLMAP."""
