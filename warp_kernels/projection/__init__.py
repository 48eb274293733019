"""Gaussians to the image plane, and the adjoint."""
