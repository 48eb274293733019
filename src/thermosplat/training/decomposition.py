"""Density control that divides a Gaussian between two spectra which pull it in different directions. MMOne.

A Gaussian that both spectra see has two gradients of means2d. Where their means over the views since the last
refinement differ by more than a threshold, the Gaussian becomes two at the same place: one that only RGB sees and one
that only thermal sees. Seen by nobody means an opacity below 1/255, which the renderer skips, so it stays that way.
"""

import math
from typing import Any

import torch
from torch import Tensor

from thermosplat.gaussians import Gaussians
from thermosplat.training.densification import DefaultStrategy, Refinement
from thermosplat.training.gaussian_ops import Optimizers, clone

VISIBLE_OPACITY = 1.0 / 255.0
"""Opacity from which on the renderer draws a Gaussian. MMOne takes 1/256."""

_MODALITIES = ("rgb", "thermal")


class DecomposingStrategy(DefaultStrategy):
    """``DefaultStrategy`` with decomposition by spectrum, of a set with two opacities stored apart.

    Gradients of the two spectra are added as vectors. Where their cameras differ, their image axes are taken to be
    parallel, as those of a camera pair nearly are.
    """

    separates_modalities = True

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.gradient_sums = self._no_gradients(len(self.grad_norm_sum))
        """Gradients of means2d since the last refinement, in units of half the image, by spectrum, shape [2, N, 2]."""
        self._spared = torch.zeros(0, dtype=torch.bool)

    @torch.no_grad()
    def observe(self, infos: list[dict[str, Any]], blocked: Tensor) -> None:
        """Add this step's gradients. Nothing here waits for the device.

        Args:
            infos: One for each spectrum, whose name it holds under "modality".
            blocked: Scalar, 1 where this step's gradients must not be noted.
        """
        finite = blocked == 0
        total = torch.zeros_like(self.gradient_sums[0])
        visible = torch.zeros_like(self.observations)
        for info in infos:
            gradient = info["means2d"].grad
            if gradient is None:  # nothing of this call reached the loss
                continue
            # one axis after the other: a captured step cannot make a tensor of two numbers from the host
            axes = [gradient[..., axis] * (info[side] / 2.0) for axis, side in enumerate(("width", "height"))]
            seen = (info["radii"] > 0).all(dim=-1).reshape(-1)
            vectors = torch.where(seen[:, None], torch.stack(axes, dim=-1).reshape(-1, 2), 0.0)
            self.gradient_sums[_MODALITIES.index(info["modality"])] += torch.where(finite, vectors, 0.0)
            total += vectors
            visible = torch.maximum(visible, seen.to(visible.dtype))
        self.grad_norm_sum += torch.where(finite, total.norm(dim=-1), 0.0)
        self.observations += torch.where(finite, visible, 0.0)

    def refine(
        self, gaussians: Gaussians, optimizers: Optimizers, step: int, generator: torch.Generator
    ) -> Refinement | None:
        """As ``DefaultStrategy.refine``; Gaussians that conflict are divided, and not grown or removed this time."""
        if self.refines_at(step) and self.growing:
            self._divide(gaussians, optimizers)
        return super().refine(gaussians, optimizers, step, generator)

    @torch.no_grad()
    def _divide(self, gaussians: Gaussians, optimizers: Optimizers) -> None:
        conflicting = self._conflicting(gaussians)
        number = int(conflicting.sum())
        if number:
            clone(gaussians, optimizers, conflicting)
        off = _logit(self.config.off_opacity)
        gaussians.logit_thermal_opacities[: len(conflicting)][conflicting] = off
        gaussians.logit_opacities[len(conflicting) :] = off
        none = self.grad_norm_sum.new_zeros(number)
        self.grad_norm_sum = torch.cat([self.grad_norm_sum.masked_fill(conflicting, 0.0), none])
        self.observations = torch.cat([self.observations, none])
        # what is spared, as it will lie after growth: clones are appended, split ones leave and two halves are appended
        spared = torch.cat([conflicting, torch.ones_like(none, dtype=torch.bool)])
        cloned, halved = self._growing(gaussians)
        grown = int(cloned.sum()) + 2 * int(halved.sum())
        self._spared = torch.cat([spared[~halved], spared.new_zeros(grown)])

    def _conflicting(self, gaussians: Gaussians) -> Tensor:
        """Mask of the Gaussians that both spectra see and pull apart, shape [N]."""
        views = self.observations.clamp(min=1.0)
        apart = (self.gradient_sums[0] - self.gradient_sums[1]).norm(dim=-1) / views
        fainter = torch.minimum(gaussians.opacities, gaussians.thermal_opacities)
        threshold = self.config.decompose_threshold or 0.0
        return (apart >= threshold) & (self.grad_norm_sum / views >= threshold) & (fainter > VISIBLE_OPACITY)

    def _removed(self, gaussians: Gaussians, step: int) -> Tensor:
        """Faint in one spectrum is enough to go, unless the other one sees a Gaussian clearly."""
        faint_rgb = gaussians.opacities < self.config.prune_opacity
        faint_thermal = gaussians.thermal_opacities < self.config.prune_opacity
        clear = torch.maximum(gaussians.opacities, gaussians.thermal_opacities) > self.config.keep_opacity
        off = _logit(self.config.off_opacity)
        gaussians.logit_opacities.masked_fill_(faint_rgb & clear, off)
        gaussians.logit_thermal_opacities.masked_fill_(faint_thermal & clear, off)
        removed = ((faint_rgb | faint_thermal) & ~clear) | self._too_large(gaussians, step)
        return removed & ~self._spared

    def forget(self, num_gaussians: int) -> None:
        """Start the sums again, for this many Gaussians."""
        super().forget(num_gaussians)
        self.gradient_sums = self._no_gradients(num_gaussians)

    def _no_gradients(self, num_gaussians: int) -> Tensor:
        return self.grad_norm_sum.new_zeros(len(_MODALITIES), num_gaussians, 2)

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint holds of this strategy."""
        return super().state_dict() | {"gradient_sums": self.gradient_sums}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's state."""
        super().load_state_dict(state)
        self.gradient_sums = state["gradient_sums"].to(self.gradient_sums)


def _logit(opacity: float) -> float:
    return math.log(opacity / (1.0 - opacity))
