"""What a training step does on the device: render, compare, differentiate, update, take note.

Nothing in here reads a value back, so the same lines run one by one or, captured once, as one CUDA graph
(captured_steps.py).
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.errors import UserError
from thermosplat.losses.feature_norm import feature_norm_loss
from thermosplat.losses.gaussian_penalties import gaussian_penalties
from thermosplat.losses.image_terms import compare_frame
from thermosplat.losses.spectrum_balance import balanced_losses
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.refinement.camera_corrections import POSES
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.training.budget.offset_shrinkage import hold_zeros, shrink_offsets
from thermosplat.training.finite_guard import FiniteGuard
from thermosplat.training.optimizers import step_unless
from thermosplat.training.training_state import TrainingState


@dataclass(frozen=True)
class StepValues:
    """What a step says of itself, on the device; of a captured step, until the next one overwrites it."""

    losses: dict[str, Tensor]
    """Weighted loss terms by name."""
    squared_errors: dict[str, Tensor]
    """Mean squared error of the step's own images, clamped to [0, 1], by spectrum."""


@dataclass(frozen=True)
class StepKind:
    """What the host decides about a step, beside the frame."""

    sh_degree: int
    """Degree of the spherical harmonics in use."""
    densifying: bool
    """Note gradients for the next refinement."""
    depth_spread: bool = False
    """Penalise the spread of depths along rays."""
    refining: bool = False
    """Correct the cameras."""
    offsets_held: bool = False
    """Leave opacity offsets that are zero at zero."""

    @classmethod
    def at(cls, config: TrainConfig, step: int, *, densifying: bool) -> "StepKind":
        """What is done in a step, from 1."""
        late = step > config.loss.depth_spread_from * config.max_steps
        refining = bool(config.refine) and step > config.refine_from
        between_cameras = bool(set(config.refine) - {POSES})
        return cls(
            sh_degree_at(config, step),
            densifying,
            depth_spread=config.loss.depth_spread > 0 and late,
            refining=refining,
            offsets_held=between_cameras and step <= config.refine_together * config.max_steps,
        )


def sh_degree_at(config: TrainConfig, step: int) -> int:
    """Degree of the spherical harmonics in a step: one more every ``sh_degree_interval`` steps. 3DGS."""
    return min(max(step - 1, 0) // config.sh_degree_interval, config.sh_degree)


class TrainingStep:
    """The step of one run.

    Args:
        config: The whole configuration.
        state: Model, optimizers and density control.
        guard: Watches losses and gradients.
        capacity: Counts the renderer's pairs.
        decoding: Opened around rendering and backward pass; what makes decoders fast.
    """

    def __init__(
        self,
        config: TrainConfig,
        state: TrainingState,
        guard: FiniteGuard,
        capacity: PairCapacity,
        decoding: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.config = config
        self.state = state
        self.guard = guard
        self.capacity = capacity
        self.decoding = decoding
        self._one = torch.ones_like(guard.blocked)

    def gradients(self, frame: FrameTensors, kind: StepKind, *, fixed_capacity: bool) -> "_Differentiated":
        """Render the frame, compare it with its images, and leave the gradients on the parameters.

        Args:
            frame: The frame.
            kind: What is done with it.
            fixed_capacity: Render without reading numbers of pairs back.

        Raises:
            UserError: If no loss has a weight.
        """
        config, state = self.config, self.state
        if state.corrections is not None:
            with torch.set_grad_enabled(kind.refining):
                frame = state.corrections(frame)
        with self.decoding():
            with self.capacity.step(fixed=fixed_capacity):
                apart = any(strategy.separates_spectra for strategy in state.strategies.values())
                rendered = state.model.render(
                    frame.views,
                    sh_degree=kind.sh_degree,
                    absgrad=config.densification.absgrad,
                    shared_cameras=[[name] for name in frame.views] if apart else frame.shared_cameras,
                    deterministic=config.deterministic,
                    depth_spread_limit=config.loss.depth_spread_limit if kind.depth_spread else None,
                )
            if state.exposures is not None and frame.index is not None:
                rendered = state.exposures(rendered, frame.index)
            compared = compare_frame(rendered, frame, config)
            losses = compared.losses
            if config.loss.feature_norm > 0 and state.model.decoders is not None:
                features = state.gaussian_sets[SHARED].features
                losses["feature_norm"] = config.loss.feature_norm * feature_norm_loss(features)
            if rendered.depth_spreads:
                losses["depth_spread"] = config.loss.depth_spread * torch.stack(rendered.depth_spreads).sum()
            if config.loss.balance:
                numbers = {name: len(owned) for name, owned in state.gaussian_sets.items()}
                losses = balanced_losses(losses, compared.spectra, numbers)
            # of sets that this step renders: nothing would hold others against their penalties
            rendered_sets = {name: state.gaussian_sets[name] for name in rendered.infos}
            losses |= gaussian_penalties(rendered_sets, config.loss, state.scene_extent)
            if not losses:
                raise UserError(
                    "All loss weights are 0: nothing to learn.", "Set the loss of a spectrum, such as --rgb.loss 1."
                )
            if kind.densifying:
                for name, strategy in state.strategies.items():
                    strategy.step_pre_backward(rendered.infos.get(name, []))
            terms = list(losses.values())
            # Of their sum, which nobody looks at; by this thread, since handing it to torch's own for the device and
            # waiting for it costs the host half a millisecond.
            with torch.autograd.set_multithreading_enabled(False):
                torch.autograd.backward(terms, [self._one] * len(terms))
        self.guard.observe(state.step_on_device, losses, state.gradients_to_watch())
        return _Differentiated(rendered, losses, compared.squared_errors)

    def update(self, kind: StepKind, done: "_Differentiated") -> StepValues:
        """Improve Gaussians and decoders by the gradients, except where something was not finite or did not fit.

        The step counts as done as soon as they are, whatever becomes of the rest.

        Args:
            kind: What is done with the frame.
            done: What :meth:`gradients` returned.
        """
        config, state = self.config, self.state
        blocked = torch.maximum(self.guard.blocked, self.capacity.overflow)
        if state.offsets_dropped or kind.offsets_held:
            for gaussians in state.gaussian_sets.values():
                hold_zeros(gaussians)
        step_unless(blocked, state.optimizers)
        state.step += 1
        for name, strategy in state.strategies.items():
            if strategy.moves_gaussians and state.gaussian_sets[name].means.grad is not None:
                strategy.move(state.gaussian_sets[name], state.optimizers[name], blocked, state.noise)
        if config.budget == "auto" and not state.offsets_dropped:
            for name, gaussians in state.gaussian_sets.items():
                shrink_offsets(gaussians, state.optimizers[name], config.auto_budget.offset_shrinkage, blocked)
        state.clear_gradients()
        if kind.densifying:
            for name, strategy in state.strategies.items():
                strategy.observe(done.rendered.infos.get(name, []), blocked)
        losses = {name: loss.detach() for name, loss in done.losses.items()}
        return StepValues(losses, done.squared_errors)


@dataclass(frozen=True)
class _Differentiated:
    """A rendered frame and what its comparison gave, after the backward pass."""

    rendered: RenderedFrame
    losses: dict[str, Tensor]
    squared_errors: dict[str, Tensor]
