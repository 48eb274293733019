"""Numbers that projection, binning and blending must agree on. They are gsplat 1.5.3's."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian is not drawn at a pixel where its alpha is below this."""

ALPHA_MAX = 0.999
"""Alpha is clamped here, and its gradient is zero where it was."""

TRANSMITTANCE_MIN = 1.0e-4
"""The Gaussian that would bring a pixel's transmittance to this or below is not drawn, nor any behind it."""

EXTENT_MAX = 3.33
"""Largest extent of a Gaussian in standard deviations: exp(-3.33² / 2) < 1/255, so the cut is below ALPHA_MIN."""

EXTENT_MIN = 1.0e-3
"""Smallest extent in standard deviations: where the opacity rounds to ALPHA_MIN its logarithm is 0, and a Gaussian that
the blend would still draw at its centre must not be culled."""

RADIUS_MAX = 1.0e9
"""Largest radius of a Gaussian [px], which an int32 holds."""

FOV_MARGIN = 0.3
"""Share of the half field of view by which a mean may lie outside the image before its Jacobian is clamped."""

TILE_SIZES = (8, 16, 32)
"""Tile edges [px] the blending kernels can be compiled for. The image does not depend on the choice."""

SH_DEGREE_MAX = 4
"""Highest degree of spherical harmonics that the kernels evaluate; PLY files of 3DGS hold 3."""

CHANNELS_MAX = 32
"""Channels blended in one traversal; more are blended in several."""
