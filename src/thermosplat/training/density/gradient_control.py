"""Adaptive density control: where Gaussians are added, split, removed and made transparent again. 3DGS.

Behaves as gsplat 1.5.3's ``DefaultStrategy`` with the same constants, and differs in three points:

- Opacities really are reset every ``reset_every`` steps, as in 3DGS. (gsplat 1.5.3 writes ``step % reset_every == 0 &
  step > 0``, which Python reads as ``... == (0 & step) > 0``: never true.)
- A Gaussian with several opacities is pruned when all are low, and all are reset.
- ``max_gaussians`` caps growth; the largest gradients grow first.

A frame is one observation of a Gaussian. Where one traversal renders two spectra, the gradient of ``means2d`` already
is the vector sum over both (MMOne). Where the spectra have cameras of their own, their image axes need not agree, so
each call's gradient is scaled by its own image size and the *norms* are added.
"""

from typing import Any

import torch
from torch import Tensor

from thermosplat.config import DensificationConfig
from thermosplat.errors import UserError
from thermosplat.fused.density_notes import note_gradients
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density.gaussian_ops import Optimizers, grow, prune, reset_opacities
from thermosplat.training.density.strategy import Refinement
from thermosplat.training.frames.train_frames import Span

GROW_SCALE3D = 0.01
"""Gaussians smaller than this share of the scene's extent are cloned, larger ones split. 3DGS (percent_dense)."""
PRUNE_SCALE3D = 0.1
"""Gaussians larger than this share of the scene's extent go, after the first reset of opacities. 3DGS."""


class DefaultStrategy:
    """3DGS's density control of one set of Gaussians; the interface is ``Strategy``'s.

    Args:
        scene_extent: Radius of the cameras [world units]; what "large" is measured against.
        span: The steps that train the set; the schedule counts from its start. None: all steps.
        spectra: The spectra that the set renders, in order.
    """

    separates_spectra = False
    moves_gaussians = False

    def __init__(
        self,
        config: DensificationConfig,
        scene_extent: float,
        num_gaussians: int,
        device: torch.device | str,
        span: Span | None = None,
        spectra: tuple[str, ...] = (),
    ) -> None:
        self.config = config
        self.span = span
        self.spectra = spectra
        self.scene_extent = scene_extent
        self.growing = True
        """Off: faint Gaussians are removed, but none added, and opacities are not reset."""
        self.most = config.max_gaussians
        """As many Gaussians as there may be by now; None: no limit."""
        self.block: tuple[int, int] | None = None
        """Where Gaussians are divided over ranks, the first of this rank's, and the number of all."""
        self.grad_norm_sum = torch.zeros(num_gaussians, device=device)
        """Norms of the means2d gradients since the last refinement, in units of half the image, shape [N]."""
        self.observations = torch.zeros(num_gaussians, device=device)
        """Frames in which each Gaussian was visible since then, shape [N]."""

    # The schedule's numbers are gsplat's, whose steps count from 0: what it does "at step 600" follows its 601st step.
    # So an evaluation after a round number of steps comes before the refinement or reset of that number, not right
    # after Gaussians were removed or made transparent.

    def is_active(self, step: int) -> bool:
        """Whether gradients of this step count towards a refinement."""
        if self.span is not None and step not in self.span:
            return False
        return self._schedule_step(step) < self.config.stop_step

    def has_started(self, step: int) -> bool:
        """Whether the set is old enough for refinements after this step."""
        return self._schedule_step(step) >= self.config.start_step

    def has_ended(self, step: int) -> bool:
        """Whether no gradients count any more after this step."""
        over = self.span is not None and step >= self.span.end
        return over or self._schedule_step(step) + 1 >= self.config.stop_step

    def refines_at(self, step: int) -> bool:
        """Whether Gaussians are added and removed at this step."""
        done = self._schedule_step(step)
        return self.is_active(step) and done > self.config.start_step and done % self.config.every == 0

    def resets_at(self, step: int) -> bool:
        """Whether opacities are reset at this step."""
        done = self._schedule_step(step)
        return self.growing and self.is_active(step) and done > 0 and done % self.config.reset_every == 0

    def is_full(self, gaussians: Gaussians) -> bool:
        """Whether nothing will be added any more: here never, since what is pruned makes room."""
        return False

    def replaces_tensors(self, gaussians: Gaussians) -> bool:
        """Whether a refinement or reset now may put other tensors in place of the set's, or of what is observed."""
        return True

    def _schedule_step(self, step: int) -> int:
        """Steps of the set's training before this one."""
        return step - 1 - (0 if self.span is None else self.span.start)

    def step_pre_backward(self, infos: list[dict[str, Any]]) -> None:
        """Keep the gradients that :meth:`observe` looks at."""
        for info in infos:
            info["means2d"].retain_grad()

    def refine(
        self, gaussians: Gaussians, optimizers: Optimizers, step: int, generator: torch.Generator
    ) -> Refinement | None:
        """Add and remove Gaussians, or reset opacities, where this step is the one to do so."""
        refinement = None
        if self.refines_at(step):
            try:
                cloned, halved = self._grow(gaussians, optimizers, generator)
                pruned = self._prune(gaussians, optimizers, step)
                refinement = Refinement(cloned, halved, pruned)
            finally:  # also where memory ran out between two operations: the sums must fit the Gaussians there are
                self.forget(len(gaussians))
        if self.resets_at(step):
            reset_opacities(gaussians, optimizers, 2.0 * self.config.prune_opacity)
        return refinement

    def move(self, gaussians: Gaussians, optimizers: Optimizers, blocked: Tensor, generator: torch.Generator) -> None:
        """Change Gaussians after an update: this strategy does not."""

    @torch.no_grad()
    def observe(self, infos: list[dict[str, Any]], blocked: Tensor) -> None:
        """Add this step's gradients. Nothing here waits for the device."""
        if blocked.is_cuda and len(infos) == 1:  # the usual frame, without a dozen kernels
            gradient = self._gradient(infos[0])
            if gradient is not None:
                sums = self.grad_norm_sum, self.observations
                note_gradients(gradient, infos[0]["visible"], _half_size(infos[0]), blocked, *sums)
            return
        norms = torch.zeros_like(self.grad_norm_sum)
        visible = torch.zeros_like(self.observations)
        for info in infos:
            gradient = self._gradient(info)
            if gradient is None:
                continue
            half_width, half_height = _half_size(info)
            norm = torch.hypot(gradient[..., 0] * half_width, gradient[..., 1] * half_height).flatten(end_dim=-2)
            seen = info["visible"].flatten(end_dim=-2)  # [C, N]
            norms += torch.where(seen, norm, 0.0).sum(dim=0)
            visible = torch.maximum(visible, seen.sum(dim=0).to(visible.dtype))
        finite = blocked == 0
        self.grad_norm_sum += torch.where(finite, norms, 0.0)
        self.observations += torch.where(finite, visible, 0.0)

    def _gradient(self, info: dict[str, Any]) -> Tensor | None:
        """What counts of a call, [C, N, 2]; None where nothing of it reached the loss."""
        means2d = info["means2d"]
        return getattr(means2d, "absgrad", None) if self.config.absgrad else means2d.grad

    @torch.no_grad()
    def _grow(self, gaussians: Gaussians, optimizers: Optimizers, generator: torch.Generator) -> tuple[int, int]:
        """Clone small and split large Gaussians with a large mean gradient; how many of each."""
        if not self.growing:
            return 0, 0
        cloned, halved = self._growing(gaussians)
        num_cloned, num_halved = torch.stack([cloned.sum(), halved.sum()]).tolist()
        if num_cloned or num_halved:
            self._follow(grow(gaussians, optimizers, cloned, halved, generator))
        return num_cloned, num_halved

    def _growing(self, gaussians: Gaussians) -> tuple[Tensor, Tensor]:
        """Masks of the Gaussians to clone and to split, each [N]."""
        gradient = self.grad_norm_sum / self.observations.clamp(min=1.0)
        grows = self._within_cap(gradient > self.config.grad_threshold, gradient)
        is_small = gaussians.scales.amax(dim=-1) <= GROW_SCALE3D * self.scene_extent
        return grows & is_small, grows & ~is_small

    def _within_cap(self, doubled: Tensor, values: Tensor, copies: int = 1) -> Tensor:
        """Of the Gaussians that get copies, mask [N], those of the largest values [N] that there is room for."""
        if self.most is None:
            return doubled
        return doubled & _largest(values.masked_fill(~doubled, -torch.inf), (self.most - len(values)) // copies)

    def _follow(self, rows: Tensor) -> None:
        """Growth made Gaussian k a copy of the one that was ``rows[k]``: nothing is kept here that has to follow."""

    @torch.no_grad()
    def _prune(self, gaussians: Gaussians, optimizers: Optimizers, step: int) -> int:
        """Remove Gaussians that are too faint or too large; how many."""
        removed = self._removed(gaussians, step)
        num_pruned = int(removed.sum())
        if num_pruned == len(gaussians):
            raise UserError(
                f"No Gaussian is left after the refinement of step {step:,}: all {num_pruned:,} were fainter than "
                f"{self.config.prune_opacity} or larger than {PRUNE_SCALE3D} of the scene.",
                "Check the camera poses, or lower --densification.prune-opacity.",
            )
        if num_pruned:
            prune(gaussians, optimizers, removed)
        return num_pruned

    def _removed(self, gaussians: Gaussians, step: int) -> Tensor:
        """Mask of the Gaussians to remove, [N]."""
        fainter = gaussians.largest_opacities < self.config.prune_opacity
        return fainter | self._too_large(gaussians, step)

    def _too_large(self, gaussians: Gaussians, step: int) -> Tensor:
        if self._schedule_step(step) <= self.config.reset_every:  # 3DGS: after the first reset
            return torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        return gaussians.scales.amax(dim=-1) > PRUNE_SCALE3D * self.scene_extent

    def forget(self, num_gaussians: int) -> None:
        """Start the sums again, for this many Gaussians; in place where there are as many as before."""
        if len(self.grad_norm_sum) == num_gaussians:
            self.grad_norm_sum.zero_()
            self.observations.zero_()
        else:
            self.grad_norm_sum = self.grad_norm_sum.new_zeros(num_gaussians)
            self.observations = self.observations.new_zeros(num_gaussians)

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint holds of this strategy."""
        return {"grad_norm_sum": self.grad_norm_sum, "observations": self.observations}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's state."""
        for name in ("grad_norm_sum", "observations"):
            if state[name].shape != getattr(self, name).shape:
                raise ValueError(f"{name} has the shape {list(state[name].shape)}")
        self.grad_norm_sum = state["grad_norm_sum"].to(self.grad_norm_sum)
        self.observations = state["observations"].to(self.observations)


def _half_size(info: dict[str, Any]) -> tuple[float, float]:
    """What brings a gradient of means2d to units of half the image."""
    cameras = info["n_cameras"]
    return info["width"] / 2.0 * cameras, info["height"] / 2.0 * cameras


def _largest(values: Tensor, count: int) -> Tensor:
    """Mask of the ``count`` largest of values [N]; the first of equal ones."""
    mask = torch.zeros_like(values, dtype=torch.bool)
    if count > 0:
        mask[torch.argsort(values, descending=True, stable=True)[:count]] = True
    return mask
