"""When cameras are registered to the scene as it is trained, and on images of which size."""

from collections.abc import Callable
from dataclasses import replace

from thermosplat.config import OptimizerConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.refinement.image_registration import PASSES, register_cameras, sharpness_at
from thermosplat.training.frames.shrunk_frames import shrunk_frame
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.new_scenes import of_passes
from thermosplat.training.session.training_parts import Training
from thermosplat.training.step_kind import Stage, StepKind

WIDEST = (160, 320)
"""Width [px] that images of the cameras that are found have at most, by the number of the pass. Wrong by the same
angle, a camera is the fewer pixels off the smaller its images are; the larger they are, the more exactly they tell
where it is. Open choice, measured on rig_desk (benchmarks/records/refinement.md)."""


class CameraStage(Stage):
    """Rounds of ``register_cameras`` between steps: every ``refine_every`` steps, as soon as there is a scene.

    They come first, in passes of some steps (``refine_first``) in which the first spectrum alone shapes the Gaussians:
    a scene that all spectra shape would follow wrong cameras. After each pass the scene is forgotten and starts anew.
    Colours that were learnt through wrong cameras would draw the cameras back in the next pass, and what a scene lacks
    that one spectrum shaped, it would lack to the end. Rounds depend on the step alone, so a resumed run goes on with
    the same ones.

    Args:
        start_anew: Forgets the scene, and tells the user why.
    """

    def __init__(self, training: Training, start_anew: Callable[[str], None]) -> None:
        super().__init__(training)
        self._start_anew = start_anew
        self._passes = training.state.preliminaries
        self.steps = min(training.config.refine_first, training.config.max_steps)
        """Steps of a pass."""
        self.start = training.config.refine_rounds_from
        """Steps of a pass before its first round."""
        self._rates = of_passes(training.config).optimizer

    def notes(self) -> tuple[str, ...]:
        """How long it takes."""
        passes = self._passes.camera_passes
        said = f"The cameras are found first: {passes} times {self.steps:,} steps, and each time a new scene."
        return (said,) if passes > 0 else ()

    def before(self, step: int, kind: StepKind) -> StepKind:
        """Let the first spectrum alone shape the scene, on images of the pass."""
        if not self._passes.find_cameras:
            return kind
        return replace(kind, geometry_held=True, image_factor=self._image_factor)

    def rates(self, rates: OptimizerConfig) -> OptimizerConfig:
        """Learn the scene fast."""
        return self._rates if self._passes.find_cameras else rates

    def acts_at(self, step: int) -> bool:
        """Where a round is due, or a pass ends."""
        return self._passes.find_cameras and (self._has_round(step) or step >= self.steps)

    def after(self, step: int, kind: StepKind) -> None:
        """Do the round that is due, if one is."""
        training, corrections = self.training, self.training.state.corrections
        if corrections is None or not self._has_round(step):
            return
        done, last = step - self.start, self.steps - self.start
        turn, sharpness = done // training.config.refine_every, sharpness_at(self._number, done / last)
        if sharpness is not None:
            frames, model = _FramesOfSize(training.frames, self._image_factor), training.state.model
            register_cameras(model, corrections, frames, turn, sharpness, kind.sh_degree, training.team)

    def leave(self) -> None:
        """Start anew after a pass."""
        if self._passes.find_cameras and self.training.state.step >= self.steps:
            self._start_anew("The scene starts anew with the cameras that were found.")

    def _has_round(self, step: int) -> bool:
        done = step - self.start
        return 0 < done <= self.steps - self.start and done % self.training.config.refine_every == 0

    @property
    def _image_factor(self) -> float:
        """What the sides of images are divided by in the pass under way."""
        corrections = self.training.state.corrections
        if corrections is None:
            return 1.0
        width = min(corrections.shared[number].camera.width for number in corrections.registered)
        return max(1.0, width / WIDEST[self._number])

    @property
    def _number(self) -> int:
        """The pass under way, from 0."""
        return len(PASSES) - self._passes.camera_passes


class _FramesOfSize:
    """The training frames with images whose sides are divided by a factor."""

    def __init__(self, frames: TrainFrames, factor: float) -> None:
        self._frames, self._factor = frames, factor

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> FrameTensors:
        frame = self._frames[index]
        return frame if self._factor == 1.0 else shrunk_frame(frame, self._frames.frames[index].views, self._factor)
