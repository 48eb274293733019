"""Which sets of Gaussians a configuration asks for, each started from the capture's sparse points."""

from typing import TYPE_CHECKING

import torch

from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.scene.formations.formation import Formation
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture

SHARED = "shared"
"""Name of the set that renders all spectra."""


def initial_gaussians(config: TrainConfig, capture: "Capture", formations: Formations) -> dict[str, Gaussians]:
    """The sets of Gaussians at the start of training; the same for the same seed.

    Args:
        config: Says which sets there are, what they hold, and the seed of the random features.
        capture: Gives the sparse points.
        formations: Those of the model's spectra.

    Returns:
        On the CPU: "shared", or one set by the name of each spectrum.

    Raises:
        UserError: If there are too few points.
    """
    generator = torch.Generator().manual_seed(config.seed)
    return {
        name: Gaussians.from_points(
            capture.points,
            capture.point_colors,
            config=config.model,
            sh_degree=config.sh_degree,
            generator=generator,
            formations=rendered,
        )
        for name, rendered in sets_of(config.model, formations).items()
    }


def sets_of(config: ModelConfig, formations: Formations) -> dict[str, list[Formation]]:
    """The formations of the spectra that each set of Gaussians renders, by the set's name.

    Args:
        config: Says which sets there are.
        formations: Those of the model's spectra.
    """
    every = {name: formations[name] for name in formations.spectra}
    return {SHARED: list(every.values())} if config.gaussian_sets == SHARED else {name: [every[name]] for name in every}
