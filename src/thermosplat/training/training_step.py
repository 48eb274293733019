"""What a training step does on the device: render, compare, differentiate, update, take note.

Nothing in here reads a value back, so the same lines run one by one or, captured once, as one CUDA graph
(recorded_steps.py).
"""

import functools
from collections.abc import Callable, Collection, Iterable, Sequence
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
from thermosplat.losses.gaussian_penalties import feature_norm_loss, gaussian_penalties
from thermosplat.losses.image_terms import ComparedFrame, balanced_losses, compare_frame, squared_error
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.training.budget.noise_floor import gradient_shares
from thermosplat.training.budget.offset_shrinkage import hold_zeros, shrink_offsets
from thermosplat.training.budget.tolerances import TOLERANCES, Tolerances
from thermosplat.training.optimizers import FiniteGuard, gradients_to_watch, step_unless
from thermosplat.training.rows_in_view import hand_rows_over, observed_in_order
from thermosplat.training.sharing.calls import Calls, TakingPart, calls_of, infos_of_frame, render_with_others
from thermosplat.training.sharing.replicated import add_up_replicated, tell_errors
from thermosplat.training.step_kind import Group, Plan, StepKind, StepValues
from thermosplat.training.swept_depths.swept_depths import SweptDepths
from thermosplat.training.training_state import TrainingState

DEPTH_SPREAD_LIMIT = 0.1
"""v0 of v / (1 + v / v0), which is taken of each pixel's spread v, so that contours, where surfaces far apart meet in a
pixel, count for less: half of one and half of another 1.88 times as far is 0.1. 0: v itself. Open choice."""
TAKING_PART = "taking part"
"""The loss term, always zero, that lets gradients travel between ranks."""


@dataclass(frozen=True)
class Part:
    """What a frame is of its step."""

    weight: float
    """Of its losses; one by the number of frames."""
    penalised: Collection[str]
    """The sets of Gaussians whose own penalties come with this frame."""
    calls: Calls | None
    """The groups of spectra that this rank and the others render now; None: there is one rank."""


@dataclass(frozen=True)
class Differentiated:
    """What comparing rendered frames gave, after the backward passes."""

    rendered: RenderedFrame
    losses: dict[str, Tensor]
    squared_errors: dict[str, Tensor]
    observed: Sequence[dict[str, list[Any]]] = ()
    """What density control looks at of each frame, by set."""


class TrainingStep:
    """The step of one run.

    Args:
        state: Model, optimizers and density control.

    Attributes:
        decoding: Opened around rendering and backward pass; what makes decoders fast.
        swept: Depths of the training views; None: there are none, or not yet.
    """

    def __init__(
        self,
        config: TrainConfig,
        state: TrainingState,
        guard: FiniteGuard,
        capacity: PairCapacity,
        team: Team,
        tolerances: Tolerances = TOLERANCES,
    ) -> None:
        self.config = config
        self.tolerances = tolerances
        self.state = state
        self.guard = guard
        self.capacity = capacity
        self.team = team
        self.decoding: Callable[[], AbstractContextManager[None]] = nullcontext
        self.swept: SweptDepths | None = None
        self._one = torch.ones_like(guard.blocked)

    def gradients(
        self, frames: Iterable[FrameTensors], kind: StepKind, plan: Plan, *, fixed_capacity: bool
    ) -> Differentiated:
        """Render the frames, compare them with their images, and leave the gradients on the parameters.

        Args:
            fixed_capacity: Render without reading numbers of pairs back.

        Raises:
            UserError: If no loss has a weight.
        """
        state, team = self.state, self.team
        parts, observed, overflows, indices = [], [], [], []
        done: Differentiated | None = None
        for number, (groups, frame) in enumerate(zip(plan.rounds, frames, strict=True)):
            calls = None if team.is_alone else calls_of(groups, team, next(iter(state.gaussian_sets.values())).means)
            part = Part(1.0 / plan.frames, plan.penalised if number == 0 else (), calls)
            done = None  # what it holds of the frame before is not needed while this one is rendered
            done = self.differentiate(frame, kind, part, fixed_capacity=fixed_capacity)
            if done.rendered.in_view:
                hand_rows_over(done.rendered, state.optimizers)
            parts.append((done.losses, done.squared_errors))
            if kind.densifying:
                observed += self._observed(done.rendered, calls, len(groups), plan)
            if len(plan.rounds) > 1:
                overflows.append(self.capacity.overflow.clone())
            if not team.is_alone and frame.index is not None:
                indices.append(frame.index.clone())
        if done is None:
            raise ValueError("A step has no frame.")
        losses, errors = parts[0] if plan.frames == 1 and team.is_alone else _added_up(parts, plan, team)
        if not team.is_alone:
            add_up_replicated(team, state)
            tell_errors(team, state, indices)
        self.guard.observe(state.step_on_device, losses, gradients_to_watch(state.optimizers))
        if overflows:
            self.capacity.overflow.copy_(torch.stack(overflows).amax())
        team.largest_in_place([self.guard.blocked, self.capacity.overflow])
        return replace(done, losses=losses, squared_errors=errors, observed=observed)

    def _observed(
        self, rendered: RenderedFrame, calls: Calls | None, frames: int, plan: Plan
    ) -> list[dict[str, list[Any]]]:
        """What density control looks at of so many frames that were rendered at a time, one of each rank."""
        if calls is not None:
            cameras = range(frames)
            return [infos_of_frame(rendered.infos, k, calls.of_ranks[k], plan.frames) for k in cameras]
        if plan.frames > 1:
            return [infos_of_frame(rendered.infos, 0, None, plan.frames)]
        if rendered.in_view:
            return [observed_in_order(rendered, {name: len(held) for name, held in self.state.gaussian_sets.items()})]
        return [rendered.infos]

    def differentiate(self, frame: FrameTensors, kind: StepKind, part: Part, *, fixed_capacity: bool) -> Differentiated:
        """Add a frame's gradients to those on the parameters."""
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
        return Differentiated(rendered, {name: loss.detach() for name, loss in losses.items()}, errors)

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
        if kind.swept_depths and self.swept and frame.index is not None:
            losses |= self.swept.losses(rendered, frame.index)
        if kind.depth_spread and rendered.depth_spreads:
            losses["depth_spread"] = config.loss.depth_spread * torch.stack(rendered.depth_spreads).sum()
        if config.loss.balance:
            numbers = {name: state.num_gaussians(name) for name in state.gaussian_sets}
            losses = balanced_losses(losses, compared.spectra, numbers)
        if part.weight != 1.0:
            losses = {name: part.weight * loss for name, loss in losses.items()}
        # While cameras are found there are no penalties on Gaussians: they would open holes.
        weights = replace(config.loss, opacity_reg=0.0, scale_reg=0.0) if kind.geometry_held else config.loss
        losses |= self._penalties(part, weights, rendered)
        if part.calls is not None:
            # Every image takes part, so that every rank's backward pass makes the same exchanges.
            images = [*rendered.images.values(), *rendered.features.values(), *rendered.blank]
            losses[TAKING_PART] = TakingPart.apply(*images)
        return replace(compared, losses=losses)

    def _penalties(self, part: Part, weights: LossConfig, rendered: RenderedFrame) -> dict[str, Tensor]:
        """Penalties on the Gaussians of the sets that the step renders: nothing would hold others against theirs.

        On several ranks those on this rank's share, which over all ranks add up to those on the sets. Whichever rank
        renders it, the first frame of a step says which Gaussians are seen.
        """
        state, shares = self.state, {name: self.state.gaussian_sets[name] for name in part.penalised}
        total: dict[str, Tensor] = {}
        if shares and (weights.opacity_reg > 0 or weights.scale_reg > 0):
            groups = None if part.calls is None else part.calls.of_ranks[0]
            seen = {name: _seen(rendered, name, len(share), groups) for name, share in shares.items()}
            numbers = {name: of_set.sum() for name, of_set in seen.items()}
            self.team.sum_in_place(list(numbers.values()))
            total |= gaussian_penalties(shares, weights, state.scene_extent, seen, numbers)
        weight = self.config.loss.feature_norm
        if weight > 0 and SHARED in shares and state.model.has_features:
            penalty = weight * feature_norm_loss(shares[SHARED].features)
            share = len(shares[SHARED]) / max(state.num_gaussians(SHARED), 1)
            total["feature_norm"] = penalty if self.team.is_alone else share * penalty
        return total

    def update(self, kind: StepKind, done: Differentiated) -> StepValues:
        """Improve Gaussians and decoders by the gradients, except where something was not finite or did not fit.

        The step counts as done as soon as they are, whatever becomes of the rest.
        """
        config, state = self.config, self.state
        blocked = torch.maximum(self.guard.blocked, self.capacity.overflow)
        if state.budget.offsets_dropped or kind.geometry_held:
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
        if config.budget == "auto" and not state.budget.offsets_dropped:
            for name, gaussians in state.gaussian_sets.items():
                shrink_offsets(gaussians, state.optimizers[name], self.tolerances.offset_shrinkage, blocked)
        state.clear_gradients()
        if kind.densifying:
            for infos in done.observed:
                for name, strategy in state.strategies.items():
                    strategy.observe(infos.get(name, []), blocked)
        return StepValues(done.losses, done.squared_errors)


def _added_up(parts: Sequence[tuple[dict[str, Tensor], dict[str, Tensor]]], plan: Plan, team: Team) -> Any:
    """Loss terms and squared errors of a step's frames; a rank says of all frames what it saw of its own."""
    losses: dict[str, list[Tensor]] = {}
    errors: dict[str, list[Tensor]] = {}
    for of_frame in parts:
        for held, found in zip((losses, errors), of_frame, strict=True):
            for name, value in found.items():
                held.setdefault(name, []).append(value)
    more = plan.frames / max(sum(team.rank < len(groups) for groups in plan.rounds), 1)
    return (
        {name: torch.stack(values).sum() * more for name, values in losses.items()},
        {name: torch.stack(values).mean() for name, values in errors.items()},
    )


def _seen(rendered: RenderedFrame, name: str, number: int, groups: Collection[Group] | None = None) -> Tensor:
    """Which Gaussians of a set the first camera of its calls sees, bool [N].

    Args:
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
