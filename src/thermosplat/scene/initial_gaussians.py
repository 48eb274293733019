"""Which sets of Gaussians a configuration asks for, each started from the capture's sparse points.

Gaussians start as wide as their neighbours are far, as 3DGS has it. With 3DGS-MCMC's growth they start with a tenth of
that, as there, where neighbours lie close together in the images: there the small ones leave no holes, and what no view
shows stays empty (benchmarks/records/real-captures.md).
"""

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.datasets.parallax import point_spacing, seen_first
from thermosplat.scene.formations.formation import Formation
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians, check_points
from thermosplat.scene.neighbor_distances import neighbor_distances

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture

SHARED = "shared"
"""Name of the set that renders all spectra."""
CLOSE = 0.01
"""Median distance of neighbouring points [of an image's width] below which they lie close together, if it is less than
a pixel of the images that training begins with, too. Open choice: arco (0.005, 0.9 px) and yard (0.009, 0.9 px) gain by
small Gaussians; desk (0.013, 1.3 px), desk at half its size (0.013, 0.6 px) and a flight (0.004, 1.1 px) lose."""
AMONG_MANY = 0.1
"""Share of the distance to its neighbours that a Gaussian is wide where points lie close together. 3DGS-MCMC, which has
it everywhere. Elsewhere it is the distance, 3DGS's: smaller ones would leave holes, which have no gradients."""


def initial_gaussians(config: TrainConfig, capture: "Capture", formations: Formations) -> dict[str, Gaussians]:
    """The sets of Gaussians at the start of training; the same for the same seed.

    Args:
        config: Says which sets there are, what they hold, and the seed of the random features.

    Returns:
        On the CPU: "shared", or one set by the name of each spectrum.

    Raises:
        UserError: If there are too few points, or some are not finite.
    """
    check_points(capture.points)
    generator = torch.Generator().manual_seed(config.seed)
    distances = neighbor_distances(capture.points)
    sizes = AMONG_MANY * distances if _lie_close(config, capture, distances) else distances
    return {
        name: Gaussians.from_points(
            capture.points,
            capture.point_colors,
            sizes,
            config=config.model,
            sh_degree=config.sh_degree,
            generator=generator,
            formations=rendered,
        )
        for name, rendered in sets_of(config.model, formations).items()
    }


def _lie_close(config: TrainConfig, capture: "Capture", distances: NDArray[np.floating]) -> bool:
    """Whether points are so many that small Gaussians leave no holes between them."""
    if config.densification.strategy != "mcmc":
        return False
    seen = seen_first(capture.train)
    spacing = point_spacing(seen, capture.points, distances)
    first_width = np.median([one.width for one in seen]) / max(config.resolution.factors, default=1)
    return spacing is not None and spacing < CLOSE and bool(spacing * first_width < 1.0)


def sets_of(config: ModelConfig, formations: Formations) -> dict[str, list[Formation]]:
    """The formations of the spectra that each set of Gaussians renders, by the set's name."""
    every = {name: formations[name] for name in formations.spectra}
    return {SHARED: list(every.values())} if config.gaussian_sets == SHARED else {name: [every[name]] for name in every}
