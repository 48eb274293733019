"""Density control that divides a Gaussian between spectra which pull it in different directions. MMOne.

A Gaussian that all spectra see has a gradient of means2d of each. Where the means of two of them over the views since
the last refinement differ by more than a threshold, the Gaussian becomes several at the same place, each of which one
spectrum alone sees. Not seen means an opacity below 1/255, which the renderer skips, so that it gets no gradient and
stays that way. ``max_gaussians`` caps division as it does growth, which gets what room is left.
"""

import itertools
import math
from typing import Any

import torch
from torch import Tensor

from thermosplat.scene.gaussians import Gaussians, own_logits_name
from thermosplat.training.density.gaussian_ops import Optimizers, append_copies, clear_moments
from thermosplat.training.density.gradient_control import DefaultStrategy

VISIBLE_OPACITY = 1.0 / 255.0
"""Opacity from which on the renderer draws a Gaussian. MMOne takes 1/256."""
CONFLICT_THRESHOLD = 2e-4
"""Difference of two spectra's mean means2d gradients, in units of half the image, from which on a Gaussian becomes one
of each. MMOne (mm_decompose_threshold)."""
KEEP_OPACITY = 0.5
"""A Gaussian that is faint in one spectrum goes unless its opacity in the other is above this. MMOne."""
OFF_OPACITY = 0.003
"""Opacity of a Gaussian of one spectrum in the other, below what is drawn. MMOne."""


class DecomposingStrategy(DefaultStrategy):
    """``DefaultStrategy`` with decomposition by spectrum, of a set with an opacity for each, stored apart.

    Gradients of the spectra are added as vectors. Where their cameras differ, their image axes are taken to be
    parallel, as those of a camera pair nearly are.
    """

    separates_spectra = True

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.opacities = ["logit_opacities", *map(own_logits_name, self.spectra[1:])]
        """The parameters with the opacity of each spectrum."""
        self.gradient_sums = self._no_gradients()
        """Gradients of means2d since the last refinement, in units of half the image, by spectrum, shape [S, N, 2]."""
        self._spared = torch.zeros_like(self.grad_norm_sum, dtype=torch.bool)
        """Gaussians that the refinement under way has divided, and must not remove, shape [N]."""

    @torch.no_grad()
    def observe(self, infos: list[dict[str, Any]], blocked: Tensor) -> None:
        """Add this step's gradients. Nothing here waits for the device."""
        finite = blocked == 0
        total = torch.zeros_like(self.gradient_sums[0])
        visible = torch.zeros_like(self.observations)
        for info in infos:
            gradient = info["means2d"].grad
            if gradient is None:  # nothing of this call reached the loss
                continue
            # one axis after the other: a captured step cannot make a tensor of two numbers from the host
            axes = [gradient[..., axis] * (info[side] / 2.0) for axis, side in enumerate(("width", "height"))]
            seen = info["visible"].reshape(-1)
            vectors = torch.where(seen[:, None], torch.stack(axes, dim=-1).reshape(-1, 2), 0.0)
            (spectrum,) = info["spectra"]
            self.gradient_sums[self.spectra.index(spectrum)] += torch.where(finite, vectors, 0.0)
            total += vectors
            visible = torch.maximum(visible, seen.to(visible.dtype))
        self.grad_norm_sum += torch.where(finite, total.norm(dim=-1), 0.0)
        self.observations += torch.where(finite, visible, 0.0)

    @torch.no_grad()
    def _grow(self, gaussians: Gaussians, optimizers: Optimizers, generator: torch.Generator) -> tuple[int, int]:
        """As ``DefaultStrategy``'s; before, Gaussians that conflict are divided, and neither grow nor go this time."""
        if self.growing:
            self._divide(gaussians, optimizers)
        return super()._grow(gaussians, optimizers, generator)

    def _divide(self, gaussians: Gaussians, optimizers: Optimizers) -> None:
        divided = self.conflicting(gaussians)
        if not divided.any():
            return
        rows, others = torch.where(divided)[0], len(self.opacities) - 1
        append_copies(gaussians, optimizers, rows.repeat(others))
        owners = torch.where(divided, 0, -1)  # of what is divided, the spectrum that sees it
        copies = torch.arange(1, others + 1, device=rows.device).repeat_interleave(len(rows))
        owners = torch.cat([owners, copies])
        for place, name in enumerate(self.opacities):
            self._switch_off(gaussians, optimizers, name, (owners >= 0) & (owners != place))
        none = self.grad_norm_sum.new_zeros(len(copies))
        self.grad_norm_sum = torch.cat([self.grad_norm_sum.masked_fill(divided, 0.0), none])
        self.observations = torch.cat([self.observations, none])
        self._spared = owners >= 0

    def _follow(self, rows: Tensor) -> None:
        self._spared = self._spared[rows]

    def conflicting(self, gaussians: Gaussians) -> Tensor:
        """Mask of the Gaussians that all spectra see and two pull apart; where room is scarce, the farthest. [N]."""
        views = self.observations.clamp(min=1.0)
        pairs = itertools.combinations(self.gradient_sums, 2)
        apart = torch.stack([(one - other).norm(dim=-1) for one, other in pairs]).amax(dim=0) / views
        faintest = torch.stack([gaussians.opacities_in(name) for name in self.spectra]).amin(dim=0)
        pulled = (apart >= CONFLICT_THRESHOLD) & (self.grad_norm_sum / views >= CONFLICT_THRESHOLD)
        return self._within_cap(pulled & (faintest > VISIBLE_OPACITY), apart, copies=len(self.spectra) - 1)

    @torch.no_grad()
    def _prune(self, gaussians: Gaussians, optimizers: Optimizers, step: int) -> int:
        """As ``DefaultStrategy``'s; what stays although it is faint in one spectrum is switched off there."""
        pruned = super()._prune(gaussians, optimizers, step)
        faint, clear = self._faint(gaussians), self._clear(gaussians)
        for name, faint_in in zip(self.opacities, faint, strict=True):
            self._switch_off(gaussians, optimizers, name, faint_in & clear)
        return pruned

    def _removed(self, gaussians: Gaussians, step: int) -> Tensor:
        """Faint in one spectrum is enough to go, unless the other one sees a Gaussian clearly."""
        removed = (self._faint(gaussians).any(dim=0) & ~self._clear(gaussians)) | self._too_large(gaussians, step)
        return removed & ~self._spared

    def _faint(self, gaussians: Gaussians) -> Tensor:
        """Which Gaussians are faint in each spectrum, bool [S, N]."""
        opacities = torch.stack([gaussians.opacities_in(name) for name in self.spectra])
        return opacities < self.config.prune_opacity

    def _clear(self, gaussians: Gaussians) -> Tensor:
        """Mask of the Gaussians that a spectrum sees clearly, [N]."""
        return gaussians.largest_opacities > KEEP_OPACITY

    def _switch_off(self, gaussians: Gaussians, optimizers: Optimizers, name: str, selected: Tensor) -> None:
        """Let a spectrum see Gaussians, mask [N], no more. ``name`` is that of its opacity."""
        off = OFF_OPACITY
        gaussians.get_parameter(name)[selected] = math.log(off / (1.0 - off))
        # Momentum goes on without gradients and would bring some back: after steady ones it makes nine more steps of
        # the rate, which at MMOne's 0.05 is 0.45 in the logit, and from 0.003 to 1/255 it is 0.27.
        clear_moments(gaussians, optimizers, selected, (name,))

    def forget(self, num_gaussians: int) -> None:
        """Start the sums again, for this many Gaussians."""
        super().forget(num_gaussians)
        self.gradient_sums = self._no_gradients()
        self._spared = torch.zeros_like(self.grad_norm_sum, dtype=torch.bool)

    def _no_gradients(self) -> Tensor:
        return self.grad_norm_sum.new_zeros(len(self.spectra), len(self.grad_norm_sum), 2)

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint holds of this strategy."""
        return super().state_dict() | {"gradient_sums": self.gradient_sums}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's state; gradients by spectrum start at zero where its strategy did not note them."""
        super().load_state_dict(state)
        sums = state.get("gradient_sums", self._no_gradients())
        if sums.shape != self.gradient_sums.shape:
            raise ValueError(f"gradient_sums has the shape {list(sums.shape)}")
        self.gradient_sums = sums.to(self.gradient_sums)
