"""Training steps of several frames, on one rank or on several that divide frames and Gaussians.

A step's loss is the mean over its frames. Frame k of a step is rendered by rank k mod W, W frames at a time.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from thermosplat.config.run_schedule import adam_betas
from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.distributed.team import Team
from thermosplat.refinement.camera_corrections import POSES
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.stop_signals import deferred_interrupts
from thermosplat.training.density.gaussian_ops import Optimizers
from thermosplat.training.frames.spectrum_schedule import SpectrumSchedule
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.sharing.calls import Calls, Group, calls_of, infos_of_frame
from thermosplat.training.training_state import TrainingState
from thermosplat.training.training_step import Differentiated, Part, StepKind, StepValues, TrainingStep

NO_FRAME = FrameTensors("", {}, ())


@dataclass(frozen=True)
class Plan:
    """What the host decides about the frames of a step, which every rank knows of all of them."""

    penalised: tuple[str, ...]
    """The sets of Gaussians whose own penalties come with the step."""
    rounds: tuple[tuple[tuple[Group, ...], ...], ...]
    """The groups of spectra of every frame, as many frames at a time as there are ranks."""

    @property
    def frames(self) -> int:
        """Of all ranks."""
        return sum(map(len, self.rounds))


class BatchSteps:
    """Runs steps of several frames; ``PlainSteps`` has the same methods.

    Args:
        step: The step.
        frames: The training frames.
        schedule: Which of them each step takes.
        team: The ranks; None: there is one.
    """

    def __init__(
        self, step: TrainingStep, frames: TrainFrames, schedule: SpectrumSchedule, team: Team | None = None
    ) -> None:
        self.step, self.frames, self.schedule, self.team = step, frames, schedule, team
        self._rank, self._ranks = (0, 1) if team is None else (team.rank, team.size)
        schedule.places = range(self._rank, step.config.batch_size or 1, self._ranks)
        betas = adam_betas(step.config.batch_size or 1)
        for optimizers in step.state.optimizers.values():
            set_betas(optimizers, betas)

    @contextmanager
    def run(self, frame: FrameTensors, kind: StepKind) -> Iterator[StepValues]:
        """Do one step; the block goes on with it, and ends before an interrupt is heard.

        Args:
            frame: The first of its frames; the others are known.
            kind: What is done with them.
        """
        plan = self.plan()
        done = self.gradients(plan, self.own_frames(plan, kind), kind, fixed_capacity=False)
        with deferred_interrupts():
            yield self.step.update(kind, done)

    def forget(self, *, kernels: bool = False) -> None:
        """Nothing was recorded that could be forgotten."""

    def check_overflow(self) -> None:
        """Every pair has room: rasterizations read back how many there are."""

    def plan(self) -> Plan:
        """Of the step that comes next."""
        state = self.step.state
        shown = self.schedule.shown(state.step)
        batch = [self.frames.frames[index] for index in self.schedule.batch(state.step)]
        penalised = [
            state.model.set_of(name)
            for name in state.model.spectra
            if any(name in shown and name in frame.views for frame in batch)
        ]
        groups = [tuple(self._groups(frame, shown)) for frame in batch]
        rounds = (groups[start : start + self._ranks] for start in range(0, len(groups), self._ranks))
        return Plan(tuple(dict.fromkeys(penalised)), tuple(map(tuple, rounds)))

    def own_frames(self, plan: Plan, kind: StepKind) -> Iterator[FrameTensors]:
        """The frames that this rank renders in the step that comes next, one for each round.

        Args:
            plan: The step's.
            kind: What is done with them.
        """
        for number, groups in enumerate(plan.rounds):
            has_one = self._rank < len(groups)
            step, factor = self.step.state.step, kind.image_factor
            yield self.schedule.tensors(step, number, factor=factor) if has_one else NO_FRAME

    def gradients(
        self, plan: Plan, frames: Iterable[FrameTensors], kind: StepKind, *, fixed_capacity: bool
    ) -> Differentiated:
        """Render the frames, compare them with their images, and leave the gradients on the parameters.

        Args:
            plan: The step's.
            frames: This rank's, one for each round.
            kind: What is done with them.
            fixed_capacity: Render without reading numbers of pairs back.
        """
        state, team, capacity = self.step.state, self.team, self.step.capacity
        losses: dict[str, list[Tensor]] = {}
        errors: dict[str, list[Tensor]] = {}
        observed: list[dict[str, list[Any]]] = []
        overflows: list[Tensor] = []
        indices: list[Tensor] = []
        done: Differentiated | None = None
        for number, (groups, frame) in enumerate(zip(plan.rounds, frames, strict=True)):
            calls = None if team is None else self._calls(groups)
            part = Part(1.0 / plan.frames, plan.penalised if number == 0 else (), calls, team)
            done = None  # what it holds of the frame before is not needed while this one is rendered
            done = self.step.differentiate(frame, kind, part, fixed_capacity=fixed_capacity)
            overflows.append(capacity.overflow.clone())
            indices += [] if frame.index is None else [frame.index.clone()]
            for held, found in ((losses, done.losses), (errors, done.squared_errors)):
                for name, value in found.items():
                    held.setdefault(name, []).append(value.detach())
            for camera in range(len(groups)) if kind.densifying else ():
                rendered = None if calls is None else calls.of_ranks[camera]
                observed.append(infos_of_frame(done.rendered.infos, camera, rendered, plan.frames))
        if done is None:
            raise ValueError("A step has no frame.")
        own_frames = max(sum(self._rank < len(groups) for groups in plan.rounds), 1)
        # a rank says of all frames what it saw of its own
        said = {name: torch.stack(values).sum() * (plan.frames / own_frames) for name, values in losses.items()}
        if team is not None:
            self._add_up_replicated(team)
            self._tell_errors(team, indices)
        self.step.guard.observe(state.step_on_device, said, state.gradients_to_watch())
        capacity.overflow.copy_(torch.stack(overflows).amax())
        if team is not None:
            team.largest_in_place([self.step.guard.blocked, capacity.overflow])
        means = {name: torch.stack(values).mean() for name, values in errors.items()}
        return replace(done, losses=said, squared_errors=means, observed=observed)

    def _calls(self, groups: Sequence[Sequence[Group]]) -> Calls:
        missing: list[Sequence[Group]] = [()] * (self._ranks - len(groups))
        like = next(iter(self.step.state.gaussian_sets.values())).means
        return calls_of([*groups, *missing], self._rank, like.detach())

    def _groups(self, frame: Frame, shown: frozenset[str]) -> list[Group]:
        """The groups in which a rank renders a frame, as every rank finds them."""
        state = self.step.state
        names = [name for name in state.model.spectra if name in shown and name in frame.views]
        corrected = state.corrections is not None and not state.corrections.refined <= {POSES}
        if corrected or state.separates_spectra or SHARED not in state.gaussian_sets:
            return [(name,) for name in names]
        groups = (tuple(name for name in names if name in group) for group in frame.shared_cameras)
        return [group for group in groups if group]

    def _tell_errors(self, team: Team, own: Sequence[Tensor]) -> None:
        """Let all ranks know the errors of the frames that this one trained on, given by their indices."""
        watch = self.step.state.noise_watch
        if watch is None:
            return
        noted = torch.stack(list(watch.errors.values()))
        found = torch.zeros_like(noted)
        if own:
            index = torch.stack(list(own))
            found.index_copy_(1, index, noted.index_select(1, index))
        team.largest_in_place([found])  # a frame that two ranks have, where an epoch ends, has one error
        for errors, of_spectrum in zip(watch.errors.values(), found, strict=True):
            errors.copy_(torch.where(of_spectrum > 0, of_spectrum, errors))

    def _add_up_replicated(self, team: Team) -> None:
        """Sum the gradients of what every rank has whole, where some rank has one."""
        parameters = replicated_parameters(self.step.state)
        has = [int(parameter.grad is not None) for parameter in parameters]
        wanted = [any(of_all) for of_all in zip(*team.numbers(has), strict=True)] if has else []
        gradients = []
        for parameter, is_wanted in zip(parameters, wanted, strict=True):
            if is_wanted:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                gradients.append(parameter.grad)
        team.sum_in_place(gradients)


def replicated_parameters(state: TrainingState) -> list[torch.nn.Parameter]:
    """What every rank has whole: decoders, exposures, and what is wrong with the cameras."""
    learnt = [
        parameter
        for owner, optimizers in state.optimizers.items()
        if owner not in state.gaussian_sets
        for optimizer in optimizers.values()
        for parameter in optimizer.param_groups[0]["params"]
    ]
    return learnt if state.exposures is None else [*learnt, *state.exposures.parameters()]


def set_betas(optimizers: Optimizers, betas: tuple[float, float]) -> None:
    """Let the moments of optimizers, given by parameter name, decay so fast."""
    for optimizer in optimizers.values():
        for group in optimizer.param_groups:
            group["betas"] = betas
