"""Images that are small at first, and depths that are swept once they are not."""

from dataclasses import replace

import torch

from thermosplat.training.frames.resolution_schedule import image_factor, resolution_note
from thermosplat.training.stages.stage import Stage
from thermosplat.training.step_kind import StepKind
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
