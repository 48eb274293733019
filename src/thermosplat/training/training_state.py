"""Everything that changes while training, and that a checkpoint must hold to go on exactly."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import torch

from thermosplat.config import OptimizerConfig, TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.fused.row_adam import RowAdam
from thermosplat.refinement.camera_corrections import CameraCorrections
from thermosplat.refinement.image_registration import PASSES
from thermosplat.runs.checkpoint import Checkpoint, SavedTraining, damage_explained
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.scene.offloaded import OffloadedParameter
from thermosplat.scene.saved_gaussians import restored_sets
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.training.budget.noise_watch import NoiseWatch
from thermosplat.training.budget.progress import BudgetProgress
from thermosplat.training.density.gaussian_ops import Optimizers, parameter_like, replace_parameters
from thermosplat.training.density.strategies import STRATEGIES
from thermosplat.training.density.strategy import Strategy
from thermosplat.training.exposures import Exposures
from thermosplat.training.frames.random_streams import start_stream
from thermosplat.training.frames.train_frames import set_span
from thermosplat.training.joined_scenes import Scene
from thermosplat.training.optimizers import (
    gaussian_optimizers,
    load_optimizer,
    network_optimizer,
    parameter_optimizers,
    set_learning_rates,
)
from thermosplat.training.preliminaries import Preliminaries


@dataclass
class Seconds:
    """Where a run's time went, summed over all its sittings [s]."""

    train: float = 0.0
    """In training steps: rendering, losses, gradients, updates, densification. The first step of a sitting includes
    what kernels had to be compiled."""
    wall: float = 0.0
    """Between the start and the last step, with evaluations and files."""
    first_step: float = 0.0
    """The first step of the last sitting alone."""


class TrainingState:
    """The model, its optimizers and density control, and how far they have come.

    Nothing random is in here: random_streams.py makes it from the seed and the step.

    Attributes:
        model: The scene.
        gaussian_sets: The model's sets of Gaussians by name.
        exposures: Colour changes of the training views; None where no spectrum has them.
        corrections: What is wrong with the cameras; None where nothing of them is refined.
        optimizers: By name of the set, "decoders", "exposures" and "corrections", the optimizers by parameter name.
        spans: The steps that train each owner of optimizers.
        strategies: Density control by name of the set.
        step: Steps done.
        step_on_device: int64 scalar, the number of the step that is being done.
        preliminaries: Which scene of the training it is.
        budget: How far a budget has come with it.
        noise_watch: How far noisy images are fitted and may be; None where no spectrum has a noise floor.
        noise: Draws what is random within a step, on the device; starts afresh in every step.
        seconds: Where the time went.

    Args:
        model: The scene, on its device.
        capture: What it is trained on; the exposures and cameras of the training frames are part of the state.
    """

    def __init__(self, model: SceneModel, config: TrainConfig, capture: Capture, device: torch.device) -> None:
        self.model = model
        self.gaussian_sets: dict[str, Gaussians] = {name: model.gaussians(name) for name in model.gaussian_sets}
        self.optimizers: dict[str, Optimizers] = {
            name: gaussian_optimizers(gaussians, config.optimizer) for name, gaussians in self.gaussian_sets.items()
        }
        if any(True for _ in model.formations.parameters()):
            self.optimizers["decoders"] = {"decoders": network_optimizer(model.formations)}
        self.exposures: Exposures | None = None
        if exposed := [one for name, one in model.spectra.items() if config.spectra[name].exposure != "fixed"]:
            levels = [name for name, spectrum in config.modelled.items() if spectrum.exposure == "level"]
            self.exposures = Exposures(len(capture.training_frames(model.spectra)), exposed, levels).to(device)
        self.corrections: CameraCorrections | None = None
        if config.refine:
            self.corrections = CameraCorrections(config.refine, capture, list(model.spectra)).to(device)
            self.optimizers["corrections"] = parameter_optimizers(self.corrections.learnt(), config.optimizer)
        self.spans = {owner: set_span(owner, config) for owner in self.optimizers}
        strategy = STRATEGIES[config.densification.strategy]
        self.strategies: dict[str, Strategy] = {
            name: strategy(
                config.densification,
                capture.scene_extent,
                len(gaussians),
                device,
                self.spans[name],
                tuple(spectrum for spectrum in model.spectra if model.set_of(spectrum) == name),
            )
            for name, gaussians in self.gaussian_sets.items()
        }
        self.step = 0
        finds_cameras = self.corrections is not None and bool(self.corrections.registered) and config.refine_first > 0
        self.preliminaries = Preliminaries(
            config.seed,
            camera_passes=len(PASSES) if finds_cameras else 0,
            scenes_left=config.scenes if config.scenes > 1 else 0,
        )
        self.budget = BudgetProgress()
        self.noise_watch: NoiseWatch | None = None
        self._num_frames = len(capture.training_frames(model.spectra))
        self.step_on_device = torch.zeros((), dtype=torch.int64, device=device)
        self.scene_extent = capture.scene_extent
        self._batch_rate = math.sqrt(config.batch_size or 1)  # of the others, run_schedule has multiplied the rates
        self.noise = torch.Generator(device)
        self.seconds = Seconds()
        self.counts: dict[str, list[int]] | None = None
        """Gaussians of each rank by set, where they are divided over ranks: this state then holds one rank's."""

    @contextmanager
    def showing(self, whole: SceneModel) -> Iterator[None]:
        """Around what judges or writes the model: let it be the whole one, of which this is a share."""
        share, sets, counts = self.model, self.gaussian_sets, self.counts
        self.model, self.counts = whole, None
        self.gaussian_sets = {name: whole.gaussians(name) for name in whole.gaussian_sets}
        try:
            yield
        finally:
            self.model, self.gaussian_sets, self.counts = share, sets, counts

    @torch.no_grad()
    def take(self, sets: Mapping[str, Gaussians]) -> None:
        """Put other Gaussians in place of those of all sets; nothing is known of them yet.

        Args:
            sets: By name of the set, anywhere.
        """
        self.clear_gradients()
        for name, gaussians in self.gaussian_sets.items():
            parameters = dict(gaussians.named_parameters())
            found = {
                key: value if isinstance(parameters[key], OffloadedParameter) else value.to(parameters[key].device)
                for key, value in sets[name].named_parameters()
            }
            new = {key: parameter_like(parameters[key], value.detach()) for key, value in found.items()}
            replace_parameters(gaussians, self.optimizers[name], {key: (value, {}) for key, value in new.items()})
            gaussians.feature_basis = sets[name].feature_basis
            self.strategies[name].forget(len(gaussians))

    @torch.no_grad()
    def start_anew(self, model: SceneModel, kept: Sequence[Scene] = ()) -> None:
        """Forget the scene and all that was learnt but the corrections of cameras; no step is done.

        Args:
            kept: Scenes that are to become one, with this one where it is as far as it comes by itself.
        """
        self.take({name: model.gaussians(name) for name in self.gaussian_sets})
        for strategy in self.strategies.values():
            strategy.growing = True
        self.model.formations.load_state_dict(model.formations.state_dict())
        for parameter in [] if self.exposures is None else self.exposures.parameters():
            parameter.zero_()
        for owner in self.optimizers.keys() - self.gaussian_sets.keys():
            for optimizer in self.optimizers[owner].values():
                optimizer.state.clear()
        if self.corrections is not None:
            self.corrections.velocity.zero_()
        self.step, self.budget = 0, BudgetProgress()
        self.preliminaries.go_on(kept)
        if self.noise_watch is not None:
            self.noise_watch.forget()

    @property
    def taught(self) -> tuple[str, ...]:
        """The spectra that are trained on what a teacher shows."""
        return () if self.noise_watch is None else tuple(self.noise_watch.teachers)

    @property
    def separates_spectra(self) -> bool:
        """Whether density control needs each spectrum rendered by a call of its own."""
        return any(strategy.separates_spectra for strategy in self.strategies.values())

    def num_gaussians(self, name: str) -> int:
        """Gaussians of a set, of all ranks."""
        return len(self.gaussian_sets[name]) if self.counts is None else sum(self.counts[name])

    @property
    def all_gaussians(self) -> int:
        """Gaussians of all sets and ranks."""
        return sum(map(self.num_gaussians, self.gaussian_sets))

    def begin_step(self, step: int, config: OptimizerConfig) -> None:
        """Tell the device the step's number and learning rates, and forget what an interrupted step left.

        Args:
            step: The step to come, from 1.
        """
        self.clear_gradients()
        self.budget.trimmed = False
        self.step_on_device.fill_(step)
        if any(strategy.moves_gaussians for strategy in self.strategies.values()):
            start_stream(self.noise, self.preliminaries.seed, "position noise", step)
        for owner, optimizers in self.optimizers.items():
            scale = self.scene_extent
            if owner == "corrections" and self.corrections is not None:
                scale = self._batch_rate * self.corrections.image_width
            set_learning_rates(optimizers, config, self.spans[owner].progress(step - 1), scale)

    def clear_gradients(self) -> None:
        """Forget all gradients, and free their memory."""
        for maps in [] if self.exposures is None else self.exposures.parameters():
            maps.grad = None
        for optimizers in self.optimizers.values():
            for optimizer in optimizers.values():
                if isinstance(optimizer, RowAdam):
                    optimizer.rows = None
                for parameter in optimizer.param_groups[0]["params"]:
                    parameter.grad = None  # Optimizer.zero_grad takes ten times as long

    def row_optimizers(self, name: str) -> list[RowAdam]:
        """Optimizers of what is offloaded of a set."""
        return [optimizer for optimizer in self.optimizers[name].values() if isinstance(optimizer, RowAdam)]

    def checkpoint(
        self, config: TrainConfig, sh_degree: int, scales: Mapping[str, PixelScale], capture: Capture | None = None
    ) -> Checkpoint:
        """The state to go on from; of a trimmed model without Adam's moments, twice its size.

        Args:
            capture: What is trained on, for the frames' names; None: nobody goes on from it with another capture.
        """
        trimmed, watch = self.budget.trimmed, self.noise_watch
        moments = {
            owner: {name: optimizer.state_dict() for name, optimizer in optimizers.items()}
            for owner, optimizers in self.optimizers.items()
        }
        training = SavedTraining(
            optimizers=None if trimmed else moments,
            strategies={name: strategy.state_dict() for name, strategy in self.strategies.items()},
            exposures=self.exposures.state_dict() if self.exposures is not None else None,
            corrections=self.corrections.state_dict() if self.corrections is not None else None,
            **self.preliminaries.state_dict(),
            **self.budget.state_dict(),
            noise_watch=None if watch is None else watch.state_dict(teachers=not trimmed),
            seconds=asdict(self.seconds),
        )
        return Checkpoint(
            step=self.step,
            config=config,
            sh_degree=sh_degree,
            model=self.model.checkpoint_state(),
            scales={name: scale.state_dict() for name, scale in scales.items()},
            training=training,
            train_frames=None if capture is None else [frame.name for frame in capture.train],
            test_frames=None if capture is None else [frame.name for frame in capture.test],
        )

    def load(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint; the model must already be its.

        Raises:
            UserError: It is incomplete, or does not fit the model.
        """
        with damage_explained("training state"):
            self._load(checkpoint, checkpoint.training)
        self.step = checkpoint.step

    def _load(self, checkpoint: Checkpoint, training: SavedTraining) -> None:
        if training.missing:
            raise KeyError(training.missing[0])
        if training.optimizers is not None:
            for owner, optimizers in self.optimizers.items():
                for name, optimizer in optimizers.items():
                    load_optimizer(optimizer, training.optimizers[owner][name])
        for name, strategy in self.strategies.items():
            strategy.load_state_dict((training.strategies or {})[name])
        for module, saved in ((self.exposures, training.exposures), (self.corrections, training.corrections)):
            if module is not None:
                module.load_state_dict(saved or {})
        self.preliminaries.load_state_dict(training)
        for scene in filter(None, training.kept_scenes):
            restored_sets(scene, checkpoint.config, self.model.formations)  # whether it can be
        self.budget = BudgetProgress.of_checkpoint(training)
        if training.noise_watch is not None:
            self.noise_watch = NoiseWatch.of_checkpoint(checkpoint, self._num_frames, self.step_on_device.device)
        self.seconds = Seconds(**training.seconds or {})
