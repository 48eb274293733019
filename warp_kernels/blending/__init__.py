"""Front-to-back blending of each tile's Gaussians, and the adjoint."""
