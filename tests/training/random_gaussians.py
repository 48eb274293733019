"""Random Gaussians with optimizers that have moments, for tests of densification."""

import torch

from thermosplat.config import OptimizerConfig
from thermosplat.gaussians import Gaussians
from thermosplat.training.gaussian_ops import Optimizers
from thermosplat.training.optimizers import gaussian_optimizers, set_learning_rates


def random_gaussians(count: int, *, thermal: bool = True, seed: int = 0) -> Gaussians:
    """Gaussians of all sizes and opacities; thermal: with features and thermal opacity offsets."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    parameters = {
        "means": normal(count, 3),
        "quats": normal(count, 4),
        "log_scales": normal(count, 3) - 4.0,
        "logit_opacities": 3.0 * normal(count) - 2.0,
        "sh0": normal(count, 1, 3),
        "shN": normal(count, 3, 3),
    }
    if thermal:
        parameters |= {"features": normal(count, 8), "thermal_opacity_offsets": 2.0 * normal(count)}
    return Gaussians(parameters)


def stepped_optimizers(gaussians: Gaussians) -> Optimizers:
    """Adam after one step with random gradients, so that every Gaussian has moments of its own."""
    optimizers = gaussian_optimizers(gaussians, OptimizerConfig())
    set_learning_rates(optimizers, OptimizerConfig(), 0.0, 1.0)
    generator = torch.Generator().manual_seed(1)
    for parameter in gaussians.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad()
    return optimizers
