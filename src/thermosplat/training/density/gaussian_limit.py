"""How many Gaussians density control may make: what was said, or what the images have room for."""

import math
from dataclasses import replace

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture

LEAST = 300_000
"""What images of 400x300 were tried with (benchmarks/records/thermosplat-plus-preset.md)."""
MOST = 3_000_000
"""About what 3DGS ends with for Mip-NeRF 360 in the mean: 734 MB of 236 bytes each. Kerbl et al. 2023, table 1."""


def with_limit(config: TrainConfig, capture: Capture) -> TrainConfig:
    """The configuration with the limit of each scene, which MCMC needs: it grows until there is one.

    Of a limit that is given, each of several scenes has its part. Where none is, MCMC's is one Gaussian for each pixel
    of the largest training image, from ``LEAST`` to ``MOST``. For images of 1297x840 that is the million which gsplat's
    trainer has for Mip-NeRF 360.

    Args:
        config: The whole configuration.
        capture: Its training frames, of the size that is trained with.
    """
    densification, limit = config.densification, config.densification.max_gaussians
    if densification.strategy == "mcmc" and limit is None:
        frames = capture.train
        cameras = [view.camera for frame in frames for name, view in frame.views.items() if name in config.modelled]
        limit = min(max([LEAST, *(camera.width * camera.height for camera in cameras)]), MOST)
    if limit is None:
        return config
    return replace(config, densification=replace(densification, max_gaussians=math.ceil(limit / config.scenes)))
