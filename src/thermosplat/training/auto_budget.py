"""A model no larger than the scene needs: ``--budget auto``.

- Some training views are withheld while the number of Gaussians grows; when their PSNR has not risen for a while,
  growth stops and they are trained on like the others. Held-out test views steer nothing.
- At set shares of the run the Gaussians that contribute least to the training views are removed (contributions.py);
  the rest of the run fine-tunes what is left. Growth ends with the first removal at the latest.
- Thermal opacity offsets shrink, and at the last removal those that do next to nothing go (offset_shrinkage.py).
- At the end spherical harmonics that change no training view are dropped (sh_bands.py), and the checkpoint stores only
  what is not zero (packed_parameters.py).
"""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.metrics import psnr
from thermosplat.training.contributions import contributions, negligible, prune_sets
from thermosplat.training.modality_schedule import ModalitySchedule
from thermosplat.training.offset_shrinkage import drop_offsets
from thermosplat.training.sh_bands import drop_bands
from thermosplat.training.train_frames import TrainFrames
from thermosplat.training.training_state import TrainingState


class AutoBudget:
    """What ``--budget auto`` does between the steps of a run.

    Args:
        config: The whole configuration.
        state: Model, optimizers and density control.
        frames: The training frames.
        schedule: Which of them the steps take.
    """

    def __init__(
        self, config: TrainConfig, state: TrainingState, frames: TrainFrames, schedule: ModalitySchedule
    ) -> None:
        self.config = config
        self.state = state
        self.frames = frames
        self.schedule = schedule
        self.settings = config.auto_budget
        self.validation = _spread(len(frames), self.settings.validation_views)
        self._prune_steps = {max(1, round(share * config.max_steps)) for share in self.settings.prune_at}
        if state.growing:
            schedule.withhold(self.validation)
        else:  # a resumed run whose growth has ended
            self._stop_growing()

    def acts_at(self, step: int) -> bool:
        """Whether something may change after this step."""
        return self.prunes_at(step) or self._validates_at(step) or self._growth_is_over(step)

    def prunes_at(self, step: int) -> bool:
        """Whether Gaussians are removed after this step, and captured steps no longer fit."""
        return step in self._prune_steps

    def after_step(self, step: int, sh_degree: int) -> None:
        """Validate, stop growth or prune, where this step is the one to do so.

        Args:
            step: The step done.
            sh_degree: Degree of the spherical harmonics in use.
        """
        if self._validates_at(step):
            self._validate(step, sh_degree)
        if self._growth_is_over(step):
            self._stop_growing()
        if self.prunes_at(step):
            self._stop_growing()
            self._prune()
        if step == max(self._prune_steps, default=0):
            self._drop_offsets()

    def finish(self, sh_degree: int) -> None:
        """Drop what is not needed once training is over.

        Args:
            sh_degree: Degree of the spherical harmonics in use.
        """
        drop_bands(self.state.model, self._all_frames(), sh_degree, self.settings.sh_tolerance)

    def _validates_at(self, step: int) -> bool:
        settings, started = self.settings, self.config.densification.start_step
        return bool(self.validation) and self.state.growing and step > started and step % settings.validate_every == 0

    def _growth_is_over(self, step: int) -> bool:
        """Whether density control adds nothing any more although nobody has stopped it."""
        state = self.state
        if not state.growing:
            return False
        full = (strategy.is_full(state.gaussian_sets[name]) for name, strategy in state.strategies.items())
        return step >= self.config.densification.stop_step or all(full)

    @torch.no_grad()
    def _validate(self, step: int, sh_degree: int) -> None:
        state, found = self.state, []
        for index in self.validation:
            frame = self.frames[index]
            rendered = state.model.render(frame.rgb, frame.thermal, sh_degree=sh_degree, aligned=frame.aligned)
            for image, view in ((rendered.rgb, frame.rgb), (rendered.thermal, frame.thermal)):
                if image is not None and view is not None and view.image is not None:
                    found.append(psnr(image, view.image))
        value = sum(found) / max(len(found), 1)
        best, best_step = state.best_validation
        if value > best + self.settings.least_gain or not math.isfinite(best):
            state.best_validation = (value, step)
        elif step - best_step >= self.settings.patience:
            self._stop_growing()

    def _stop_growing(self) -> None:
        self.state.growing = False
        for strategy in self.state.strategies.values():
            strategy.growing = False
        self.schedule.withhold(())

    def _prune(self) -> None:
        state = self.state
        squared = self.settings.prune_by == "squares"
        shares: dict[str, Tensor] = contributions(state.model, self._all_frames(), squared=squared)
        removed = {name: negligible(values, self.settings.prune_share) for name, values in shares.items()}
        prune_sets(state.gaussian_sets, state.optimizers, removed)
        for name, strategy in state.strategies.items():
            strategy.forget(len(state.gaussian_sets[name]))

    def _drop_offsets(self) -> None:
        self.state.offsets_dropped = True
        for name, gaussians in self.state.gaussian_sets.items():
            drop_offsets(gaussians, self.state.optimizers[name], self.settings.offset_tolerance)

    def _all_frames(self) -> Iterator[FrameTensors]:
        return (self.frames[index] for index in range(len(self.frames)))


def _spread(num_frames: int, count: int) -> tuple[int, ...]:
    """Indices of ``count`` frames spread over all; none where that would be more than a quarter of them."""
    if count == 0 or 4 * count > num_frames:
        return ()
    return tuple(round((i + 0.5) * num_frames / count - 0.5) for i in range(count))
