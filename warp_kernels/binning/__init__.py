"""Which Gaussians touch which tile, in depth order."""
