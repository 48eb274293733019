"""Density control as sampling: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024).

Gaussians are samples of where the scene is. Those that fade away are not deleted but moved onto others (relocation.py),
their number grows by a fixed share up to a budget, and after every step noise moves each of them,

    μ += λ σ(-k (o - t)) Σ η,  η ~ N(0, I), λ = position_noise · learning rate of the means / R², k = 100, t = 0.005,

within its own extent and only while it is faint: a clear Gaussian does not move. With several opacities o is the
largest one: a Gaussian that some spectrum sees is neither faint nor dead. R is the scene's extent: Σ has the square of
a length and the rate a length, so without R the same scene in other units would be shaken otherwise (the publication's
code leaves it out; gsplat trains in units in which cameras lie at about distance 1).

With ``split_apart`` what is doubled becomes two along its longest axis (long_axis_split.py), not two in one place.
"""

from typing import Any

import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.fused.position_noise import add_noise_to_means
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density.gaussian_ops import Optimizers
from thermosplat.training.density.gradient_control import DefaultStrategy
from thermosplat.training.density.long_axis_split import split, split_onto
from thermosplat.training.density.relocation import add, relocate
from thermosplat.training.density.strategy import Refinement

NOISE_STEEPNESS = 100.0
"""k of the noise's gate. 3DGS-MCMC."""
NOISE_OPACITY = 0.005
"""t of the noise's gate: opacity at which the noise has half its size. 3DGS-MCMC."""


class McmcStrategy(DefaultStrategy):
    """Density control by relocation, growth to a budget, and noise; arguments as ``DefaultStrategy``."""

    moves_gaussians = True

    @property
    def _by_gradient(self) -> bool:
        return self.config.sample_by != "opacity"

    def resets_at(self, step: int) -> bool:
        """Never: what the images do not need fades by ``loss.opacity_reg``."""
        return False

    def is_full(self, gaussians: Gaussians) -> bool:
        """Whether the budget is reached: from then on Gaussians only move."""
        number = len(gaussians) if self.block is None else self.block[1]
        return number >= (self.config.max_gaussians or 0)

    def replaces_tensors(self, gaussians: Gaussians) -> bool:
        """Unless Gaussians only move."""
        return self.growing and not self.is_full(gaussians)

    def step_pre_backward(self, infos: list[dict[str, Any]]) -> None:
        """Keep gradients, where they say what is doubled."""
        if self._by_gradient:
            super().step_pre_backward(infos)

    def observe(self, infos: list[dict[str, Any]], blocked: Tensor) -> None:
        """Add this step's gradients, where they say what is doubled."""
        if self._by_gradient:
            super().observe(infos, blocked)

    @torch.no_grad()
    def refine(
        self, gaussians: Gaussians, optimizers: Optimizers, step: int, generator: torch.Generator
    ) -> Refinement | None:
        """Move dead Gaussians and add new ones, where this step is the one to do so."""
        if not self.refines_at(step):
            return None
        config = self.config
        try:
            dead = gaussians.largest_opacities <= config.prune_opacity
            moved = torch.where(dead)[0]
            if len(moved) == len(gaussians):
                raise UserError(
                    f"No Gaussian is left to relocate to at step {step:,}: all {len(moved):,} were fainter than "
                    f"{config.prune_opacity}.",
                    "Check the camera poses, or lower --loss.opacity-reg.",
                )
            if len(moved):
                sources = self._drawn(gaussians, len(moved), generator)
                moved = moved[: len(sources)]
                if config.split_apart > 0:
                    split_onto(gaussians, optimizers, moved, sources, config.split_apart, config.prune_opacity)
                else:
                    relocate(gaussians, optimizers, moved, sources, config.prune_opacity)
            room = (self.most or 0) - len(gaussians)
            added = max(0, min(room, int(config.growth * len(gaussians)))) if self.growing else 0
            if added:
                sources = self._drawn(gaussians, added, generator)
                added = len(sources)
                if config.split_apart > 0:
                    split(gaussians, optimizers, sources, config.split_apart, config.prune_opacity)
                else:
                    add(gaussians, optimizers, sources, config.prune_opacity)
            return Refinement(cloned=added, relocated=len(moved))
        finally:
            self.forget(len(gaussians))

    @torch.no_grad()
    def move(self, gaussians: Gaussians, optimizers: Optimizers, blocked: Tensor, generator: torch.Generator) -> None:
        """Add the noise of a step to the means. Nothing here waits for the device."""
        means, rate = gaussians.means, optimizers["means"].param_groups[0]["lr"]
        first, total = self.block or (0, len(means))  # every rank draws for all, as one process would
        normals = torch.randn(total, 3, generator=generator, device=means.device, dtype=means.dtype)
        normals = normals[first : first + len(means)]
        strength = self.config.position_noise / self.scene_extent**2
        rate = torch.as_tensor(rate, dtype=torch.float32, device=means.device)
        stored = means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities
        add_noise_to_means(
            *stored,
            *gaussians.stored_second_opacity,
            normals=normals,
            strength=strength,
            rate=rate,
            gate=(NOISE_STEEPNESS, NOISE_OPACITY),
            blocked=blocked,
        )

    def _drawn(self, gaussians: Gaussians, count: int, generator: torch.Generator) -> Tensor:
        """Indices of those that are doubled, at most ``count``: one that is drawn twice splits once at a time."""
        drawn = _draw(self._weights(gaussians), count, generator)
        return drawn.unique() if self.config.split_apart > 0 else drawn

    def _weights(self, gaussians: Gaussians) -> Tensor:
        """What the probability to be doubled is proportional to, 0 for the dead, shape [N]."""
        opacities = gaussians.largest_opacities
        return self._preferences(opacities) * (opacities > self.config.prune_opacity)

    def _preferences(self, opacities: Tensor) -> Tensor:
        """Of all Gaussians, by their largest opacities, each [N]."""
        if not self._by_gradient:
            return opacities
        gradients = self.grad_norm_sum / self.observations.clamp(min=1.0)
        if self.config.sample_by == "gradient":
            return gradients + 1e-12 * opacities  # a trace of opacity keeps the sum of all weights above zero
        return opacities / opacities.sum() + gradients / gradients.sum().clamp(min=1e-12)


def _draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices drawn with replacement, with probabilities proportional to weights [N]; the same on every device."""
    ends = weights.double().cumsum(dim=0)
    places = torch.rand(count, generator=generator, dtype=torch.float64).to(ends.device) * ends[-1]
    return torch.searchsorted(ends, places, right=True).clamp(max=len(weights) - 1)
