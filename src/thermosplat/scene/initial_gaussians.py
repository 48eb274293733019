"""Which sets of Gaussians a configuration asks for, each started from the capture's sparse points.

Gaussians start as wide as their neighbours are far, as 3DGS has it, or a tenth of that, as 3DGS-MCMC has it, where
neighbours lie less than a pixel apart in the images that training begins with: there the small ones leave no holes, and
what no view shows stays empty (benchmarks/records/real-captures.md).
"""

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.scene.formations.formation import Formation
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians, check_points
from thermosplat.scene.neighbor_distances import neighbor_distances

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture

SHARED = "shared"
"""Name of the set that renders all spectra."""
AMONG_MANY = 0.1
"""Share of the distance to its neighbours that a Gaussian is wide where points lie close together. 3DGS-MCMC, which has
it everywhere. Elsewhere it is the distance, 3DGS's: smaller ones would leave holes, which have no gradients."""


def initial_gaussians(config: TrainConfig, capture: "Capture", formations: Formations) -> dict[str, Gaussians]:
    """The sets of Gaussians at the start of training; the same for the same seed.

    Args:
        config: Says which sets there are, what they hold, and the seed of the random features.
        capture: Gives the sparse points.
        formations: Those of the model's spectra.

    Returns:
        On the CPU: "shared", or one set by the name of each spectrum.

    Raises:
        UserError: If there are too few points, or some are not finite.
    """
    check_points(capture.points)
    generator = torch.Generator().manual_seed(config.seed)
    distances = neighbor_distances(capture.points)
    closest = median_spacing(capture, distances) < max(config.resolution.factors, default=1)
    sizes = AMONG_MANY * distances if closest else distances
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


def median_spacing(capture: "Capture", distances: NDArray[np.float32]) -> float:
    """How far apart neighbouring points lie in the training images [px], the median over what all images show.

    Points that something hides count, too. An image that a lens has distorted counts as if it were not.

    Args:
        capture: Gives points and cameras.
        distances: Of each point to its neighbours [world units], shape [M].

    Returns:
        The median; infinity where no image shows a point.
    """
    homogeneous = np.concatenate([capture.points, np.ones_like(capture.points[:, :1])], axis=1).astype(np.float64)
    found = []
    for frame in capture.train:
        view = next(iter(frame.views.values()))
        camera = view.camera
        x, y, depth = camera.K @ (homogeneous @ view.viewmat.T)[:, :3].T
        shown = (depth > 0) & (x > 0) & (x < camera.width * depth) & (y > 0) & (y < camera.height * depth)
        found.append(camera.fx * distances[shown] / depth[shown])
    spacings = np.concatenate(found) if found else np.zeros(0)
    return float(np.median(spacings)) if len(spacings) else float("inf")


def sets_of(config: ModelConfig, formations: Formations) -> dict[str, list[Formation]]:
    """The formations of the spectra that each set of Gaussians renders, by the set's name.

    Args:
        config: Says which sets there are.
        formations: Those of the model's spectra.
    """
    every = {name: formations[name] for name in formations.spectra}
    return {SHARED: list(every.values())} if config.gaussian_sets == SHARED else {name: [every[name]] for name in every}
