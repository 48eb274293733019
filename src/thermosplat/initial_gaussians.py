"""Which sets of Gaussians a configuration asks for, each started from the capture's sparse points."""

from typing import TYPE_CHECKING, Literal

import torch

from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.gaussians import Gaussians

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture


def initial_gaussians(config: TrainConfig, capture: "Capture") -> dict[str, Gaussians]:
    """The sets of Gaussians at the start of training; the same for the same seed.

    Args:
        config: Says which sets there are, what they hold, and the seed of the random features.
        capture: Gives the sparse points.

    Returns:
        On the CPU: "shared", or "rgb" and/or "thermal".

    Raises:
        UserError: If the capture has no training image of a spectrum to be modelled, or too few points.
    """
    capture.require(rgb=config.model.rgb, thermal=config.model.thermal)
    generator = torch.Generator().manual_seed(config.seed)
    return {
        name: Gaussians.from_points(
            capture.points,
            capture.point_colors,
            config=config.model,
            sh_degree=config.sh_degree,
            generator=generator,
            modality=modality,
        )
        for name, modality in _sets(config.model).items()
    }


def _sets(config: ModelConfig) -> "dict[str, Literal['rgb', 'thermal'] | None]":
    """Names of the sets, each with the spectrum that is all it renders (None: whatever is modelled)."""
    if config.gaussian_sets == "shared":
        return {"shared": None if config.feature_dim > 0 or config.thermal else "rgb"}
    sets: dict[str, Literal["rgb", "thermal"] | None] = {}
    if config.rgb:
        sets["rgb"] = "rgb"
    if config.thermal:
        sets["thermal"] = "thermal"
    return sets
