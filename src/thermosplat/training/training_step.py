"""What a training step does on the device: render, compare, differentiate, update, take note.

Nothing in here reads a value back, so the same lines run one by one or, captured once, as one CUDA graph
(captured_steps.py).
"""

import functools
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from thermosplat.config import LossConfig, TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors, with_unit_images
from thermosplat.distributed.team import Team
from thermosplat.errors import UserError
from thermosplat.losses.feature_norm import feature_norm_loss
from thermosplat.losses.gaussian_penalties import gaussian_penalties
from thermosplat.losses.image_terms import ComparedFrame, compare_frame, squared_error
from thermosplat.losses.spectrum_balance import balanced_losses
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.training.budget.noise_floor import gradient_shares
from thermosplat.training.budget.offset_shrinkage import hold_zeros, shrink_offsets
from thermosplat.training.budget.tolerances import TOLERANCES, Tolerances
from thermosplat.training.exposures import FROM as EXPOSED_FROM
from thermosplat.training.finite_guard import FiniteGuard
from thermosplat.training.frames.resolution_schedule import image_factor
from thermosplat.training.optimizers import step_unless
from thermosplat.training.rows_in_view import hand_rows_over, observed_in_order
from thermosplat.training.sharing.calls import Calls, Group, render_with_others
from thermosplat.training.sharing.taking_part import TakingPart
from thermosplat.training.swept_depths.swept_depths import SweptDepths
from thermosplat.training.training_state import TrainingState

DEPTH_SPREAD_FROM = 0.5
"""Share of the steps before the spread of depths along rays counts. Open choice."""
DEPTH_SPREAD_LIMIT = 0.1
"""v0 of v / (1 + v / v0), which is taken of each pixel's spread v, so that contours, where surfaces far apart meet in a
pixel, count for less: half of one and half of another 1.88 times as far is 0.1. 0: v itself. Open choice."""


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
    """Let the spread of depths along rays be a loss."""
    swept_depths: bool = False
    """Let depths be drawn to those that plane sweeps found."""
    refining: bool = False
    """Correct the cameras."""
    exposing: bool = False
    """Let the exposures of the frame follow its images."""
    geometry_held: bool = False
    """Let the images of the first spectrum alone shape the Gaussians, and leave opacity offsets at zero."""
    image_factor: float = 1.0
    """What the sides of the images are divided by."""
    taught: tuple[str, ...] = ()
    """Spectra that are compared with what a teacher shows, in place of images."""

    @classmethod
    def at(
        cls,
        config: TrainConfig,
        step: int,
        *,
        densifying: bool,
        cameras_found_at: float | None = None,
        taught: tuple[str, ...] = (),
    ) -> "StepKind":
        """What is done in a step.

        Args:
            config: The whole configuration.
            step: The step, from 1.
            densifying: As the field.
            cameras_found_at: What the sides of the images are divided by while cameras are found; None: the step
                trains the scene with them.
            taught: As the field.
        """
        loss, swept = config.loss, any(one.swept_depth > 0 for one in config.modelled.values())
        factor = image_factor(config, step) if cameras_found_at is None else cameras_found_at
        refining = bool(config.refine) and step > config.refine_from
        return cls(
            sh_degree_at(config, step),
            densifying,
            depth_spread=loss.depth_spread > 0 and step > DEPTH_SPREAD_FROM * config.max_steps,
            swept_depths=swept and factor == 1.0,
            refining=refining,
            exposing=step > EXPOSED_FROM * config.max_steps,
            geometry_held=cameras_found_at is not None,
            image_factor=factor,
            taught=taught,
        )


@dataclass(frozen=True)
class Part:
    """What a frame is of a step that may have several, on several ranks."""

    weight: float = 1.0
    """Of its losses; one by the number of frames."""
    penalised: Collection[str] | None = None
    """The sets of Gaussians whose own penalties come with this frame; None: those that it renders."""
    calls: Calls | None = None
    """The groups of spectra that this rank and the others render now; None: the Gaussians are not divided."""
    team: Team | None = None
    """The ranks; None: there is one."""


WHOLE_STEP = Part()
TAKING_PART = "taking part"
"""The loss term, always zero, that lets gradients travel between ranks."""


@dataclass(frozen=True)
class Differentiated:
    """A rendered frame and what its comparison gave, after the backward pass."""

    rendered: RenderedFrame
    losses: dict[str, Tensor]
    squared_errors: dict[str, Tensor]
    observed: list[dict[str, list[Any]]] | None = None
    """What density control looks at of each frame, by set; None: the one frame's infos."""


def sh_degree_at(config: TrainConfig, step: int) -> int:
    """Degree of the spherical harmonics in a step: one more every ``sh_degree_interval`` steps. 3DGS."""
    return min(int(max(step - 1, 0) // config.sh_degree_interval), config.sh_degree)


def _of_penalties(config: TrainConfig, kind: StepKind) -> LossConfig:
    """Weights of the penalties on Gaussians. While cameras are found there are none: they would open holes."""
    return replace(config.loss, opacity_reg=0.0, scale_reg=0.0) if kind.geometry_held else config.loss


class TrainingStep:
    """The step of one run.

    Args:
        config: The whole configuration.
        state: Model, optimizers and density control.
        guard: Watches losses and gradients.
        capacity: Counts the renderer's pairs.
        decoding: Opened around rendering and backward pass; what makes decoders fast.
        tolerances: Of a budget.

    Attributes:
        swept: Depths of the training views; None: there are none, or not yet.
    """

    def __init__(
        self,
        config: TrainConfig,
        state: TrainingState,
        guard: FiniteGuard,
        capacity: PairCapacity,
        decoding: Callable[[], AbstractContextManager[None]] = nullcontext,
        tolerances: Tolerances = TOLERANCES,
    ) -> None:
        self.config = config
        self.tolerances = tolerances
        self.state = state
        self.guard = guard
        self.capacity = capacity
        self.decoding = decoding
        self.swept: SweptDepths | None = None
        self._one = torch.ones_like(guard.blocked)

    def gradients(self, frame: FrameTensors, kind: StepKind, *, fixed_capacity: bool) -> Differentiated:
        """Render the frame, compare it with its images, and leave the gradients on the parameters.

        Args:
            frame: The frame.
            kind: What is done with it.
            fixed_capacity: Render without reading numbers of pairs back.

        Raises:
            UserError: If no loss has a weight.
        """
        done = self.differentiate(frame, kind, WHOLE_STEP, fixed_capacity=fixed_capacity)
        if done.rendered.in_view:
            hand_rows_over(done.rendered, self.state.optimizers)
            if kind.densifying:
                numbers = {name: len(gaussians) for name, gaussians in self.state.gaussian_sets.items()}
                done = replace(done, observed=[observed_in_order(done.rendered, numbers)])
        self.guard.observe(self.state.step_on_device, done.losses, self.state.gradients_to_watch())
        return done

    def differentiate(
        self, frame: FrameTensors, kind: StepKind, part: Part, *, fixed_capacity: bool = False
    ) -> Differentiated:
        """Add a frame's gradients to those on the parameters.

        Args:
            frame: The frame.
            kind: What is done with it.
            part: What it is of the step.
            fixed_capacity: Render without reading numbers of pairs back.

        Raises:
            UserError: If no loss has a weight.
        """
        state = self.state
        frame = with_unit_images(frame)
        if state.corrections is not None and frame.index is not None:
            with torch.set_grad_enabled(kind.refining):
                frame = state.corrections(frame)
        with self.decoding():
            with self.capacity.step(fixed=fixed_capacity):
                rendered = self._rendered(frame, kind, part)
                targets = self._targets(frame, kind)
            compared = self._compared(rendered, targets, kind, part)
            losses = compared.losses
            if not losses:
                raise UserError(
                    "All loss weights are 0: nothing to learn.", "Set the loss of a spectrum, such as --rgb.loss 1."
                )
            if kind.densifying:
                for name, strategy in state.strategies.items():
                    strategy.step_pre_backward(rendered.infos.get(name, []))
            errors = compared.squared_errors | _errors_of_images(rendered, frame, kind.taught)
            shares = {}
            if state.noise_watch is not None and frame.index is not None:
                # the mean of k independent pixels has a k-th of their noise's variance
                floors = state.noise_watch.floors_of(frame.index, self.tolerances.held_change)
                shares = gradient_shares(compared, {name: one / kind.image_factor**2 for name, one in floors.items()})
                if kind.image_factor == 1.0:
                    state.noise_watch.note(frame.index, errors)
            # Of their sum, which nobody looks at; by this thread, since handing it to torch's own for the device and
            # waiting for it costs the host half a millisecond.
            with torch.autograd.set_multithreading_enabled(False):
                torch.autograd.backward(list(losses.values()), [shares.get(name, self._one) for name in losses])
        losses.pop(TAKING_PART, None)
        return Differentiated(rendered, losses, errors)

    def _rendered(self, frame: FrameTensors, kind: StepKind, part: Part) -> RenderedFrame:
        """The frame's images as the losses see them: with the exposures of its photographs."""
        config, state = self.config, self.state
        blends_depths = kind.depth_spread or (kind.swept_depths and self.swept)
        render = partial(
            state.model.render,
            sh_degree=kind.sh_degree,
            absgrad=config.densification.absgrad,
            deterministic=config.deterministic,
            depth_spread_limit=DEPTH_SPREAD_LIMIT if blends_depths else None,
            shaped_by=tuple(state.model.spectra)[:1] if kind.geometry_held else None,
        )
        if part.calls is None:
            apart = [[name] for name in frame.views] if state.separates_spectra else None
            rendered = render(frame.views, shared_cameras=apart or frame.shared_cameras)
        else:
            rendered = render_with_others(render, frame.views, part.calls)
        if state.exposures is not None and frame.index is not None:
            if kind.exposing:
                state.exposures.compare(rendered, frame)
            rendered = state.exposures(rendered, frame.index)
        return rendered

    def _targets(self, frame: FrameTensors, kind: StepKind) -> FrameTensors:
        """The frame with the images that it is compared with: of spectra that are taught, their teachers'."""
        watch = self.state.noise_watch
        for name in kind.taught:
            view = frame.views.get(name)
            if watch is not None and view is not None and view.image is not None:
                frame = watch.teachers[name].targets(name, frame, self.state.exposures)
        return frame

    def _compared(self, rendered: RenderedFrame, frame: FrameTensors, kind: StepKind, part: Part) -> ComparedFrame:
        """The frame against its images, with all loss terms of the step: those of the Gaussians, too."""
        config, state = self.config, self.state
        compared = compare_frame(rendered, frame, config)
        losses = dict(compared.losses)
        if part.penalised is None:
            losses |= self._feature_norm()
        if kind.swept_depths and self.swept and frame.index is not None:
            losses |= self.swept.losses(rendered, frame.index)
        if kind.depth_spread and rendered.depth_spreads:
            losses["depth_spread"] = config.loss.depth_spread * torch.stack(rendered.depth_spreads).sum()
        if config.loss.balance:
            numbers = {name: state.num_gaussians(name) for name in state.gaussian_sets}
            losses = balanced_losses(losses, compared.spectra, numbers)
        if part.weight != 1.0:
            losses = {name: part.weight * loss for name, loss in losses.items()}
        # of sets that this step renders: nothing would hold others against their penalties
        if part.penalised is None:
            seen = {name: _seen(rendered, name, len(state.gaussian_sets[name])) for name in rendered.infos}
            rendered_sets = {name: state.gaussian_sets[name] for name in rendered.infos}
            losses |= gaussian_penalties(rendered_sets, _of_penalties(config, kind), state.scene_extent, seen)
        else:
            losses |= self._penalties_of_shares(part, _of_penalties(config, kind), rendered)
        if part.calls is not None:
            # Every image takes part, so that every rank's backward pass makes the same exchanges.
            images = [*rendered.images.values(), *rendered.features.values(), *rendered.blank]
            losses[TAKING_PART] = TakingPart.apply(*images)
        return replace(compared, losses=losses)

    def _penalties_of_shares(self, part: Part, weights: LossConfig, rendered: RenderedFrame) -> dict[str, Tensor]:
        """Penalties on this rank's share of some sets, which over all ranks add up to those on the sets.

        Whichever rank renders it, the first frame of a step says which Gaussians are seen.
        """
        state, names = self.state, list(part.penalised or ())
        if not names:
            return {}
        shares = {name: state.gaussian_sets[name] for name in names}
        groups = None if part.calls is None else part.calls.of_ranks[0]
        seen = {name: _seen(rendered, name, len(share), groups) for name, share in shares.items()}
        numbers = torch.stack([of_set.sum() for of_set in seen.values()]).float()
        if part.team is not None:
            part.team.sum_in_place([numbers])
        total = gaussian_penalties(shares, weights, state.scene_extent, seen, dict(zip(names, numbers)))
        if SHARED in shares:
            share = len(shares[SHARED]) / max(state.num_gaussians(SHARED), 1)
            total |= {term: share * penalty for term, penalty in self._feature_norm().items()}
        return total

    def _feature_norm(self) -> dict[str, Tensor]:
        """The penalty on the latent features, where there are some and it is asked for."""
        weight = self.config.loss.feature_norm
        if weight == 0 or not self.state.model.has_features:
            return {}
        return {"feature_norm": weight * feature_norm_loss(self.state.gaussian_sets[SHARED].features)}

    def update(self, kind: StepKind, done: Differentiated) -> StepValues:
        """Improve Gaussians and decoders by the gradients, except where something was not finite or did not fit.

        The step counts as done as soon as they are, whatever becomes of the rest.

        Args:
            kind: What is done with the frame.
            done: What :meth:`gradients` returned.
        """
        config, state = self.config, self.state
        blocked = torch.maximum(self.guard.blocked, self.capacity.overflow)
        if state.offsets_dropped or kind.geometry_held:
            for gaussians in state.gaussian_sets.values():
                hold_zeros(gaussians)
        step_unless(blocked, state.optimizers)
        if state.exposures is not None:
            state.exposures.follow(blocked)
        state.step += 1
        for name, strategy in state.strategies.items():
            moves = strategy.moves_gaussians and not kind.geometry_held
            if moves and state.gaussian_sets[name].means.grad is not None:
                strategy.move(state.gaussian_sets[name], state.optimizers[name], blocked, state.noise)
        if config.budget == "auto" and not state.offsets_dropped:
            for name, gaussians in state.gaussian_sets.items():
                shrink_offsets(gaussians, state.optimizers[name], self.tolerances.offset_shrinkage, blocked)
        state.clear_gradients()
        if kind.densifying:
            for infos in done.observed if done.observed is not None else [done.rendered.infos]:
                for name, strategy in state.strategies.items():
                    strategy.observe(infos.get(name, []), blocked)
        losses = {name: loss.detach() for name, loss in done.losses.items()}
        return StepValues(losses, done.squared_errors)


def _seen(rendered: RenderedFrame, name: str, number: int, groups: Collection[Group] | None = None) -> Tensor:
    """Which Gaussians of a set the first camera of its calls sees, bool [N].

    Args:
        rendered: A render.
        name: The set's name.
        number: Of its Gaussians here.
        groups: Of calls that ranks make together, those of the frame that decides; None: all.
    """
    infos = [info for info in rendered.infos.get(name, []) if groups is None or info["group"] in groups]
    found = [info["visible"].flatten(0, -2)[0] for info in infos]
    if not found:
        return torch.zeros(number, dtype=torch.bool, device=next(iter(rendered.images.values())).device)
    seen = functools.reduce(torch.logical_or, found)
    if name not in rendered.in_view:
        return seen
    whole = torch.zeros(number, dtype=torch.bool, device=seen.device)
    return whole.index_copy_(0, rendered.in_view[name].indices, seen)


def _errors_of_images(rendered: RenderedFrame, frame: FrameTensors, names: Collection[str]) -> dict[str, Tensor]:
    """Mean squared errors of some spectra against the frame's own images, whatever else they are compared with."""
    found = {}
    for name in names:
        image, view = rendered.images.get(name), frame.views.get(name)
        if image is not None and view is not None and view.image is not None:
            found[name] = squared_error(image, view.image, view.mask)
    return found
