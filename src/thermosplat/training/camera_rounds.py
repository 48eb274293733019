"""When cameras are registered to the scene as it is trained."""

import math

from thermosplat.config import TrainConfig
from thermosplat.distributed.team import Team
from thermosplat.refinement.image_registration import PASSES, Frames, register_cameras, sharpness_at
from thermosplat.training.training_state import TrainingState


class CameraRounds:
    """Rounds of ``register_cameras`` between steps: every ``refine_every`` steps, after ``refine_from`` of them.

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

    def __init__(self, config: TrainConfig, state: TrainingState, frames: Frames, team: Team | None = None) -> None:
        self._config, self._state, self._frames, self._team = config, state, frames, team
        self.steps = math.ceil(config.refine_first * config.max_steps)
        """Steps of a pass."""

    def after_step(self, step: int, sh_degree: int) -> None:
        """Do the round that is due after a step, if one is.

        Args:
            step: The step, from 1.
            sh_degree: Highest SH degree in use.
        """
        config, state = self._config, self._state
        done, last = step - config.refine_from, self.steps - config.refine_from
        if not state.finds_cameras or state.corrections is None:
            return
        if not 0 < done <= last or done % config.refine_every > 0:
            return
        turn, sharpness = done // config.refine_every, sharpness_at(len(PASSES) - state.camera_passes, done / last)
        if sharpness is not None:
            register_cameras(state.model, state.corrections, self._frames, turn, sharpness, sh_degree, self._team)

    def pass_ends(self, step: int) -> bool:
        """Whether the scene starts anew after this step."""
        return self._state.finds_cameras and step >= self.steps
