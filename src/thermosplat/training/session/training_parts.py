"""What a training consists of: made once, and then shared by its stages, its checkpoints and its results."""

from dataclasses import dataclass

import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.distributed.team import Team
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.budget.tolerances import Tolerances
from thermosplat.training.fast_decoders import fast_decoding
from thermosplat.training.frames.train_frames import SpectrumSchedule, TrainFrames
from thermosplat.training.new_scenes import NewScenes
from thermosplat.training.offloading import limit_device_memory
from thermosplat.training.optimizers import FiniteGuard
from thermosplat.training.recipe import Recipe
from thermosplat.training.session.resuming import check_steps_left, placed_as_trained
from thermosplat.training.session.run_logger import RunLogger
from thermosplat.training.sharing.shares import count_anew
from thermosplat.training.step_kind import sh_degree_at
from thermosplat.training.steps import Steps
from thermosplat.training.training_state import TrainingState
from thermosplat.training.training_step import TrainingStep


@dataclass(frozen=True)
class Training:
    """The parts of a training, as one of the ranks of a team has them."""

    team: Team
    run: RunDirectory
    """Where everything goes; rank 0 writes there."""
    capture: Capture
    frames: TrainFrames
    recipe: Recipe
    logger: RunLogger
    schedule: SpectrumSchedule
    scenes: NewScenes
    state: TrainingState
    steps: Steps
    """What runs the steps; recordings are forgotten before their tensors change."""

    @classmethod
    def of(
        cls,
        config: TrainConfig,
        capture: Capture,
        run: RunDirectory,
        logger: RunLogger | None,
        checkpoint: Checkpoint | None,
        team: Team,
        tolerances: Tolerances,
    ) -> "Training":
        """The parts of a run that begins, or goes on from a checkpoint; arguments as of ``Trainer``."""
        device = team.device
        if checkpoint is not None:
            capture = placed_as_trained(capture, checkpoint)
        if device.type == "cuda" and config.gpu_memory is not None:
            limit_device_memory(device, config.gpu_memory)
        frames = TrainFrames(capture, config.modelled, device)
        recipe = Recipe.of(config, capture, frames, checkpoint, tolerances)
        if checkpoint is not None:
            check_steps_left(checkpoint, recipe.config, run)
        config = recipe.config
        logger = logger or RunLogger.of(run, config, device, speaks=team.is_first)
        schedule = SpectrumSchedule(config, frames)
        scenes = NewScenes(config, capture, team)
        state = TrainingState(scenes.first(checkpoint), config, capture, device)
        for name, number in (scenes.offloading.rows_on_device or {}).items():
            for optimizer in state.row_optimizers(name):
                optimizer.rows_on_device = number
        if checkpoint is not None:
            state.load(checkpoint)
        count_anew(team, state)
        if device.type == "cuda":
            torch.cuda.set_device(device)  # streams, graphs and their memory are those of the current one
        step = TrainingStep(config, state, FiniteGuard(device), PairCapacity(device), team, tolerances)
        step.decoding = fast_decoding(state.model.formations, config, device)
        recorded = device.type == "cuda" and config.graph and scenes.offloading.kind == "nothing"
        steps = Steps(step, frames, schedule, recorded=recorded, say=lambda line: logger.say(line))
        return cls(team, run, capture, frames, recipe, logger, schedule, scenes, state, steps)

    @property
    def config(self) -> TrainConfig:
        """What is done, as a configuration."""
        return self.recipe.config

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics in use after the steps done."""
        return sh_degree_at(self.config, self.state.step)

    def say(self, line: str) -> None:
        """Tell the user something."""
        self.logger.say(line)
