"""What the trainer asks of density control: a strategy adds, moves and removes the Gaussians of one set."""

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from thermosplat.config import DensificationConfig
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density.gaussian_ops import Optimizers
from thermosplat.training.frames.train_frames import Span


@dataclass(frozen=True)
class Refinement:
    """What one refinement did to a set of Gaussians."""

    cloned: int = 0
    """Small Gaussians that were doubled."""
    split: int = 0
    """Large Gaussians that became two smaller ones."""
    pruned: int = 0
    """Gaussians that were removed."""
    relocated: int = 0
    """Faint Gaussians that were moved onto others."""


class Strategy(Protocol):
    """Density control of one set of Gaussians.

    The trainer calls :meth:`step_pre_backward` after rendering, :meth:`observe` after the backward pass, both while
    :meth:`is_active`, and :meth:`refine` after the optimizers. Steps count from 1: the number of the step being done.
    """

    separates_spectra: bool
    """Needs the gradients of the spectra apart: each is rendered by a call of its own."""
    moves_gaussians: bool
    """Moves Gaussians after every update, by :meth:`move`."""
    growing: bool
    """Off: faint Gaussians are removed, but none added, and opacities are not reset."""
    most: int | None
    """As many Gaussians as there may be by now; None: no limit."""
    block: tuple[int, int] | None
    """Where Gaussians are divided over ranks, the first of this rank's, and the number of all."""

    def is_active(self, step: int) -> bool:
        """Whether gradients of this step count towards a refinement."""

    def has_started(self, step: int) -> bool:
        """Whether the set is old enough for refinements after this step."""

    def has_ended(self, step: int) -> bool:
        """Whether no gradients count any more after this step."""

    def refines_at(self, step: int) -> bool:
        """Whether Gaussians are added and removed at this step."""

    def resets_at(self, step: int) -> bool:
        """Whether opacities are reset at this step."""

    def is_full(self, gaussians: Gaussians) -> bool:
        """Whether nothing will be added any more."""

    def replaces_tensors(self, gaussians: Gaussians) -> bool:
        """Whether a refinement or reset now may put other tensors in place of the set's, or of what is observed."""

    def step_pre_backward(self, infos: list[dict[str, Any]]) -> None:
        """Keep the gradients that :meth:`observe` looks at.

        Args:
            infos: What the rasterization said about each call that rendered this set.
        """

    def observe(self, infos: list[dict[str, Any]], blocked: Tensor) -> None:
        """Add this step's gradients. Must not wait for the device.

        Args:
            infos: As given to :meth:`step_pre_backward`.
            blocked: Scalar, 1 where this step's gradients must not be noted.
        """

    def refine(
        self, gaussians: Gaussians, optimizers: Optimizers, step: int, generator: torch.Generator
    ) -> Refinement | None:
        """Add and remove Gaussians, or reset opacities, where this step is the one to do so.

        Args:
            gaussians: The set.
            generator: Draws what is random, on the CPU.

        Returns:
            What changed; None where this step does not refine.

        Raises:
            UserError: If no Gaussian is left.
        """

    def move(self, gaussians: Gaussians, optimizers: Optimizers, blocked: Tensor, generator: torch.Generator) -> None:
        """Change Gaussians after an update.

        Args:
            gaussians: The set.
            blocked: Scalar, 1 where this step must change nothing.
            generator: For what is random, on the Gaussians' device.
        """

    def forget(self, num_gaussians: int) -> None:
        """Start what is observed again, for this many Gaussians."""

    def state_dict(self) -> dict[str, Tensor]:
        """What a checkpoint holds of this strategy."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's state."""


class StrategyType(Protocol):
    """What makes a strategy."""

    def __call__(
        self,
        config: DensificationConfig,
        scene_extent: float,
        num_gaussians: int,
        device: torch.device | str,
        span: Span | None = None,
        spectra: tuple[str, ...] = (),
    ) -> Strategy:
        """A strategy.

        Args:
            config: Schedule and thresholds.
            scene_extent: Radius of the cameras [world units]; what "large" is measured against.
            num_gaussians: Gaussians in the set.
            span: The steps that train the set; the schedule counts from its start. None: all steps.
            spectra: The spectra that the set renders, in order.
        """
