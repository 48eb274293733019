"""Which sets of Gaussians a configuration asks for, each started from the capture's sparse points."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.scene.gaussians import Gaussians
from thermosplat.spectra import Spectrum

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture

SHARED = "shared"
"""Name of the set that renders all spectra."""


def initial_gaussians(config: TrainConfig, capture: "Capture", spectra: Sequence[Spectrum]) -> dict[str, Gaussians]:
    """The sets of Gaussians at the start of training; the same for the same seed.

    Args:
        config: Says which sets there are, what they hold, and the seed of the random features.
        capture: Gives the sparse points.
        spectra: The spectra of the model.

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
            spectra=rendered,
        )
        for name, rendered in sets_of(config.model, spectra).items()
    }


def sets_of(config: ModelConfig, spectra: Sequence[Spectrum]) -> dict[str, Sequence[Spectrum]]:
    """The spectra that each set of Gaussians renders, by the set's name.

    Args:
        config: Says which sets there are.
        spectra: The spectra of the model.
    """
    return {SHARED: spectra} if config.gaussian_sets == SHARED else {spectrum.name: [spectrum] for spectrum in spectra}
