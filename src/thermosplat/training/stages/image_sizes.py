"""Images that are small at first, and depths that are swept once they are not."""

from dataclasses import replace

import torch

from thermosplat.training.density.gaussian_ops import become_copy
from thermosplat.training.frames.resolution_schedule import image_factor, resolution_note
from thermosplat.training.sharing.shares import count_anew
from thermosplat.training.step_kind import Stage, StepKind
from thermosplat.training.swept_depths.swept_depths import SweptDepths


class ImageSizes(Stage):
    """The size of the training images."""

    def before(self, step: int, kind: StepKind) -> StepKind:
        """Divide their sides."""
        factor = image_factor(self.training.config, step)
        return kind if factor == 1.0 else replace(kind, image_factor=factor)

    def notes(self) -> tuple[str, ...]:
        """The sizes."""
        return resolution_note(self.training.config)


class SweptDepthsStage(Stage):
    """Depths of the training views, swept when images first have full size. Comes after what decides on the size."""

    def before(self, step: int, kind: StepKind) -> StepKind:
        """Draw depths to those that were found."""
        if kind.image_factor != 1.0:
            return kind
        training = self.training
        if training.steps.step.swept is None:
            points, all_can = torch.from_numpy(training.capture.points), training.team.all_can
            found = SweptDepths.of(training.frames, training.config, points, training.logger.say, all_can)
            training.steps.step.swept = found
        return replace(kind, swept_depths=True)


class StartingSpectra(Stage):
    """Sets that begin to be trained."""

    def acts_at(self, step: int) -> bool:
        """Where the training of something begins."""
        return any(step == span.start for span in self.training.state.spans.values())

    def after(self, step: int, kind: StepKind) -> None:
        """Make a spectrum's set a copy of another one's trained set, to be trained anew from it."""
        training, state = self.training, self.training.state
        for name, spectrum in training.config.modelled.items():
            if spectrum.start != "points" and step == state.spans[name].start:
                training.steps.forget()
                become_copy(state.gaussian_sets[name], state.optimizers[name], state.gaussian_sets[spectrum.start])
                state.strategies[name].forget(len(state.gaussian_sets[name]))
                count_anew(training.team, state)
