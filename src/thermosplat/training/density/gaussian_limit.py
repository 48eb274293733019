"""How many Gaussians density control by sampling may make, where nobody said it: what the images have room for."""

from dataclasses import replace

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture

LEAST = 300_000
"""What images of 400x300 were tried with (benchmarks/records/thermosplat-plus-preset.md)."""
MOST = 3_000_000
"""About what 3DGS ends with for Mip-NeRF 360 in the mean: 734 MB of 236 bytes each. Kerbl et al. 2023, table 1."""


def with_limit(config: TrainConfig, capture: Capture) -> TrainConfig:
    """The configuration with a limit for MCMC, which grows until there is one.

    A limit that is given stays. Otherwise it is one Gaussian for each pixel of the largest training image, from
    ``LEAST`` to ``MOST``. For images of 1297x840 that is the million which gsplat's trainer has for Mip-NeRF 360.

    Args:
        config: The whole configuration.
        capture: Its training frames, of the size that is trained with.
    """
    densification = config.densification
    if densification.strategy != "mcmc" or densification.max_gaussians is not None:
        return config
    cameras = [view.camera for frame in capture.train for name, view in frame.views.items() if name in config.modelled]
    limit = min(max([LEAST, *(camera.width * camera.height for camera in cameras)]), MOST)
    return replace(config, densification=replace(densification, max_gaussians=limit))
