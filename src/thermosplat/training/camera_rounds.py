"""When cameras are registered to the scene as it is trained, and on images of which size."""

from dataclasses import replace

from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.distributed.team import Team
from thermosplat.refinement.camera_corrections import POSES
from thermosplat.refinement.image_registration import PASSES, register_cameras, sharpness_at
from thermosplat.training.frames.shrunk_frames import shrunk_frame
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.training_state import TrainingState

WIDEST = (160, 320)
"""Width [px] that images of the cameras that are found have at most, by the number of the pass. Wrong by the same
angle, a camera is the fewer pixels off the smaller its images are; the larger they are, the more exactly they tell
where it is. Open choice, measured on rig_desk (benchmarks/records/refinement.md)."""
_FASTER = ("means_lr", "means_lr_final", "quats_lr", "scales_lr", "sh0_lr", "shN_lr")


def finds_cameras(config: TrainConfig) -> bool:
    """Whether passes come first that find the cameras of the other spectra."""
    return len(config.modelled) > 1 and not set(config.refine) <= {POSES} and config.refine_first > 0


def of_passes(config: TrainConfig) -> TrainConfig:
    """What the scene on which cameras are found starts from, and how fast it learns.

    Its Gaussians are opaque and large enough to cover images from the first steps on, as 3DGS has it. A method's own
    start may cover them late, and through holes nothing is compared.

    Args:
        config: The whole configuration.
    """
    model = replace(config.model, init_opacity=ModelConfig().init_opacity)
    rates = {name: config.refine_rates * getattr(config.optimizer, name) for name in _FASTER}
    return replace(config, model=model, optimizer=replace(config.optimizer, **rates))


class CameraRounds:
    """Rounds of ``register_cameras`` between steps: every ``refine_every`` steps, as soon as there is a scene.

    They come first, in passes of some steps (``refine_first``) in which the first spectrum alone shapes the Gaussians:
    a scene that all spectra shape would follow wrong cameras. After each pass the scene is forgotten and starts anew.
    Colours that were learnt through wrong cameras would draw the cameras back in the next pass, and what a scene lacks
    that one spectrum shaped, it would lack to the end. Rounds depend on the step alone, so a resumed run goes on with
    the same ones.

    Args:
        config: The whole configuration.
        state: Model and corrections.
        frames: The training frames as the capture has them.
        team: The ranks that share the model; None: there is one.
    """

    def __init__(
        self, config: TrainConfig, state: TrainingState, frames: TrainFrames, team: Team | None = None
    ) -> None:
        self._config, self._state, self._frames, self._team = config, state, frames, team
        self.steps = min(config.refine_first, config.max_steps)
        """Steps of a pass."""
        self.start = config.refine_rounds_from
        """Steps of a pass before its first round."""

    @property
    def image_factor(self) -> float | None:
        """What the sides of images are divided by in the pass under way; None: it is over, the scene is trained."""
        corrections = self._state.corrections
        if not self._state.finds_cameras or corrections is None:
            return None
        width = min(corrections.shared[number].camera.width for number in corrections.registered)
        return max(1.0, width / WIDEST[self._number])

    def after_step(self, step: int, sh_degree: int) -> None:
        """Do the round that is due after a step, if one is.

        Args:
            step: The step, from 1.
            sh_degree: Highest SH degree in use.
        """
        config, state, factor = self._config, self._state, self.image_factor
        done, last = step - self.start, self.steps - self.start
        if factor is None or state.corrections is None:
            return
        if not 0 < done <= last or done % config.refine_every > 0:
            return
        turn, sharpness = done // config.refine_every, sharpness_at(self._number, done / last)
        if sharpness is not None:
            frames = _FramesOfSize(self._frames, factor)
            register_cameras(state.model, state.corrections, frames, turn, sharpness, sh_degree, self._team)

    def pass_ends(self, step: int) -> bool:
        """Whether the scene starts anew after this step."""
        return self._state.finds_cameras and step >= self.steps

    @property
    def _number(self) -> int:
        """The pass under way, from 0."""
        return len(PASSES) - self._state.camera_passes


class _FramesOfSize:
    """The training frames with images whose sides are divided by a factor."""

    def __init__(self, frames: TrainFrames, factor: float) -> None:
        self._frames, self._factor = frames, factor

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> FrameTensors:
        frame = self._frames[index]
        return frame if self._factor == 1.0 else shrunk_frame(frame, self._frames.frames[index].views, self._factor)
