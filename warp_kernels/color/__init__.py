"""View-dependent colours from spherical harmonics, and the adjoint."""
