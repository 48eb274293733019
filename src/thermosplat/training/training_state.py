"""Everything that changes while training, and that a checkpoint must hold to go on exactly."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

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
from thermosplat.training.density.gaussian_ops import Optimizers, parameter_like, replace_parameters
from thermosplat.training.density.strategies import STRATEGIES
from thermosplat.training.density.strategy import Strategy
from thermosplat.training.exposures import Exposures
from thermosplat.training.frames.random_streams import start_stream
from thermosplat.training.frames.spectrum_schedule import set_span
from thermosplat.training.joined_scenes import Scene, seed_of_scene
from thermosplat.training.optimizers import (
    gaussian_optimizers,
    load_optimizer,
    network_optimizer,
    parameter_optimizers,
    set_learning_rates,
)

_OF_SCENES = ("camera_passes", "scenes_left")
_OF_BUDGETS = ("growing", "offsets_dropped", "budget_due", "trimmed", "best_validation")
"""What checkpoints hold as it is."""


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
        camera_passes: Passes that are to find the cameras of the other spectra, with the one under way. After each of
            them the scene starts anew; 0: it is trained with these cameras.
        scenes_left: Scenes that are to be trained before all become one, with the one under way; 0: there is one.
        kept_scenes: Those that are trained, in the host's memory. Of ranks that share the model only the first has
            them; the others hold empty ones in their place.
        growing: Whether density control may still add Gaussians; with ``--budget auto`` that ends some day.
        offsets_dropped: Whether opacity offsets that are zero stay zero.
        budget_due: What a budget is to leave out after the step done and has not left out yet: memory ended before.
        trimmed: Whether what the training images do not miss was dropped after the last step (``AutoBudget.finish``).
        best_validation: Best PSNR of withheld training views so far [dB], and its step.
        noise_watch: How far noisy images are fitted and may be; None where no spectrum has a noise floor.
        noise: Draws what is random within a step, on the device; starts afresh in every step.
        seconds: Where the time went.

    Args:
        model: The scene, on its device.
        config: The whole configuration.
        capture: What it is trained on; the exposures and cameras of the training frames are part of the state.
        device: The model's device.
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
        exposed = [spectrum for name, spectrum in model.spectra.items() if config.spectra[name].exposure != "fixed"]
        if exposed:
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
        finds_cameras = self.corrections is not None and bool(self.corrections.registered)
        self.camera_passes = len(PASSES) if finds_cameras and config.refine_first > 0 else 0
        self.scenes_left = config.scenes if config.scenes > 1 else 0
        self.kept_scenes: list[Scene] = []
        self.noise_watch: NoiseWatch | None = None
        self.num_frames = len(capture.training_frames(model.spectra))
        self._forget_budget()
        self.step_on_device = torch.zeros((), dtype=torch.int64, device=device)
        self.scene_extent = capture.scene_extent
        self._seed = config.seed
        self._batch_rate = math.sqrt(config.batch_size or 1)  # of the others, run_schedule has multiplied the rates
        self.noise = torch.Generator(device)
        self.seconds = Seconds()
        self.counts: dict[str, list[int]] | None = None
        """Gaussians of each rank by set, where they are divided over ranks: this state then holds one rank's."""

    def _forget_budget(self) -> None:
        self.growing = True
        self.offsets_dropped = False
        self.budget_due: tuple[str, ...] = ()
        self.trimmed = False
        self.best_validation = (-math.inf, 0)
        if self.noise_watch is not None:
            self.noise_watch.forget()

    @contextmanager
    def showing(self, whole: SceneModel) -> Iterator[None]:
        """Around what judges or writes the model: let it be the whole one, of which this is a share.

        Args:
            whole: The model of all ranks.
        """
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
            model: A new model; its parameters are taken over.
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
        self.step, self.camera_passes = 0, max(self.camera_passes - 1, 0)
        self.scenes_left -= len(kept) - len(self.kept_scenes)
        self.kept_scenes = list(kept)
        self._forget_budget()

    @property
    def taught(self) -> tuple[str, ...]:
        """The spectra that are trained on what a teacher shows."""
        return () if self.noise_watch is None else tuple(self.noise_watch.teachers)

    @property
    def finds_cameras(self) -> bool:
        """Whether the scene is to start anew, with the cameras that are found on it."""
        return self.camera_passes > 0

    @property
    def is_preliminary(self) -> bool:
        """Whether the scene is to start anew, for whatever reason: it is no result of the run."""
        return self.finds_cameras or self.scenes_left > 1

    @property
    def seed(self) -> int:
        """What the random numbers of the scene under way come from."""
        return seed_of_scene(self._seed, len(self.kept_scenes))

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

    def begin_step(self, step: int, config: OptimizerConfig, scene_extent: float) -> None:
        """Tell the device the step's number and learning rates, and forget what an interrupted step left.

        Args:
            step: The step to come, from 1.
            config: The rates.
            scene_extent: Radius of the cameras [world units].
        """
        self.clear_gradients()
        self.trimmed = False
        self.step_on_device.fill_(step)
        if any(strategy.moves_gaussians for strategy in self.strategies.values()):
            start_stream(self.noise, self.seed, "position noise", step)
        for owner, optimizers in self.optimizers.items():
            scale = scene_extent
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

    def keep_moments_on_device(self, rows: Mapping[str, int]) -> None:
        """Keep moments of the first Gaussians of sets on the device, where sets are offloaded.

        Args:
            rows: How many, by name of the set.
        """
        for name, number in rows.items():
            for optimizer in self.row_optimizers(name):
                optimizer.rows_on_device = number

    def row_optimizers(self, name: str) -> list[RowAdam]:
        """Optimizers of what is offloaded of a set."""
        return [optimizer for optimizer in self.optimizers[name].values() if isinstance(optimizer, RowAdam)]

    def gradients_to_watch(self) -> dict[str, list[Tensor]]:
        """The gradients there are, by set and parameter name; the decoders' all under one name.

        Without those of spherical harmonics above degree 0, which are most of all numbers. They are the colours'
        gradients times values below 1, and those of degree 0 the same times a constant: finite where these are.
        """
        return {
            owner if owner == name else f"{owner} {name}": [
                learnt.grad for learnt in _learnt(optimizer) if learnt.grad is not None and learnt.numel() > 0
            ]
            for owner, optimizers in self.optimizers.items()
            for name, optimizer in optimizers.items()
            if name != "shN" and not name.endswith("_shN")
        }

    def checkpoint(
        self, config: TrainConfig, sh_degree: int, scales: Mapping[str, PixelScale], capture: Capture | None = None
    ) -> Checkpoint:
        """The state to go on from; of a trimmed model without Adam's moments, twice its size.

        Args:
            config: The whole configuration.
            sh_degree: Degree of the spherical harmonics in use.
            scales: What pixel values mean, by spectrum.
            capture: What is trained on, for the frames' names; None: nobody goes on from it with another capture.
        """
        training = SavedTraining(
            optimizers=None
            if self.trimmed
            else {
                owner: {name: optimizer.state_dict() for name, optimizer in optimizers.items()}
                for owner, optimizers in self.optimizers.items()
            },
            strategies={name: strategy.state_dict() for name, strategy in self.strategies.items()},
            exposures=self.exposures.state_dict() if self.exposures is not None else None,
            corrections=self.corrections.state_dict() if self.corrections is not None else None,
            kept_scenes=tuple({name: dict(packed) for name, packed in scene.items()} for scene in self.kept_scenes),
            **{name: getattr(self, name) for name in (*_OF_SCENES, *_OF_BUDGETS)},
            noise_watch=None if self.noise_watch is None else self.noise_watch.state_dict(teachers=not self.trimmed),
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

        Args:
            checkpoint: The checkpoint.

        Raises:
            UserError: It is incomplete, or does not fit the model.
        """
        with damage_explained("training state"):
            self._load(checkpoint.training, checkpoint)
        self.step = checkpoint.step

    def _load(self, training: SavedTraining, checkpoint: Checkpoint) -> None:
        if training.missing:
            raise KeyError(training.missing[0])
        if training.optimizers is not None:
            for owner, optimizers in self.optimizers.items():
                for name, optimizer in optimizers.items():
                    load_optimizer(optimizer, training.optimizers[owner][name])
        for name, strategy in self.strategies.items():
            strategy.load_state_dict((training.strategies or {})[name])
        if self.exposures is not None:
            self.exposures.load_state_dict(training.exposures or {})
        if self.corrections is not None:
            self.corrections.load_state_dict(training.corrections or {})
        for name in _OF_SCENES:
            setattr(self, name, getattr(training, name))
        self.kept_scenes = list(training.kept_scenes)
        for scene in filter(None, self.kept_scenes):
            restored_sets(scene, checkpoint.config, self.model.formations)  # whether it can be
        self.load_budget(training)
        if training.noise_watch is not None:
            device = self.step_on_device.device
            self.noise_watch = NoiseWatch(training.noise_watch["noise"], self.num_frames, device)
            self.noise_watch.load_state_dict(training.noise_watch)
            self.noise_watch.load_teachers(training.noise_watch, checkpoint)
        self.seconds = Seconds(**training.seconds or {})

    def load_budget(self, training: SavedTraining) -> None:
        """How far a budget has come.

        Args:
            training: What a checkpoint holds of a training.
        """
        for name in _OF_BUDGETS:
            setattr(self, name, getattr(training, name))


def _learnt(optimizer: torch.optim.Adam) -> list[Tensor]:
    """What may have gradients that an optimizer applies: its parameters, or rows of an offloaded one."""
    if isinstance(optimizer, RowAdam):
        return [] if optimizer.rows is None else [optimizer.rows.values]
    learnt: list[Tensor] = optimizer.param_groups[0]["params"]
    return learnt
