"""How many Gaussians density control may make: what was said, or what the images have room for."""

import math
from collections.abc import Sequence
from dataclasses import replace

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.spectra import listed

LEAST = 300_000
"""What images of 400x300 were tried with (benchmarks/records/thermosplat-plus-preset.md)."""
LEAST_OF_NOISY = 150_000
"""Likewise where they are noisy (benchmarks/records/low-light.md)."""
MOST = 3_000_000
"""About what 3DGS ends with for Mip-NeRF 360 in the mean: 734 MB of 236 bytes each. Kerbl et al. 2023, table 1."""


def with_limit(config: TrainConfig, capture: Capture, noisy: Sequence[str]) -> tuple[TrainConfig, tuple[str, ...]]:
    """The configuration with the limit of each scene, which MCMC needs: it grows until there is one.

    Of a limit that is given, each of several scenes has its part. Where none is, MCMC's is one Gaussian for each pixel
    of the largest training image, from ``LEAST`` to ``MOST``, or from ``LEAST_OF_NOISY`` where images are noisy. For
    images of 1297x840 that is the million which gsplat's trainer has for Mip-NeRF 360.

    Args:
        capture: Its training frames, of the size that is trained with.

    Returns:
        The configuration, and what to tell the user about it.
    """
    densification, limit = config.densification, config.densification.max_gaussians
    notes: tuple[str, ...] = ()
    if densification.strategy == "mcmc" and limit is None:
        frames = capture.train
        cameras = [view.camera for frame in frames for name, view in frame.views.items() if name in config.modelled]
        pixels = max((camera.width * camera.height for camera in cameras), default=0)
        limit = min(max(LEAST_OF_NOISY if noisy else LEAST, pixels), MOST)
        if limit < LEAST:
            notes = (f"At most {limit:,} Gaussians are made, since {listed(noisy)} images are noisy.",)
    if limit is None:
        return config, notes
    return replace(config, densification=replace(densification, max_gaussians=math.ceil(limit / config.scenes))), notes
