"""A model no larger than the scene needs: ``--budget auto``.

- No training view is fitted more closely than its noise (noise_floor.py); that is done by the steps themselves.
- Some training views are withheld while the number of Gaussians grows; when their PSNR has not risen for a while,
  growth stops and they are trained on like the others. Held-out test views steer nothing.
- Where images are noisy they stay withheld up to the last removal: a spectrum that they say learns noise is held about
  where it was best (noise_watch.py), and then taught by the scene of that step (teacher.py).
- Where views are few, and not noisy, they stay withheld for some time beyond growth, and a spectrum that fell far goes
  back, too.
- At set shares of the run the Gaussians that matter least are removed (opacity_sensitivities.py): as
  many as change some training images within a tolerance (image_change.py); the rest of the run fine-tunes what is left.
  Nothing is removed while it still grows, which ends with the last share at the latest, nor of a scene that is not
  learnt: what it may lose is measured against its error.
- Opacity offsets shrink, and at the last removal those that do next to nothing go (offset_shrinkage.py).
- At the last removal latent channels become as few as are needed (feature_channels.py).
- At the end spherical harmonics are dropped (sh_bands.py) and parameters rounded (rounding.py) as far as those images
  do not show it, and the checkpoint stores only what is left (packed_parameters.py).
"""

import math
from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.image_quality.metrics import psnr
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.spectra import label, listed
from thermosplat.training.budget.feature_channels import reduce_features
from thermosplat.training.budget.image_change import ImageChange
from thermosplat.training.budget.looked_at_views import more_than_one_in, spread, validation_views
from thermosplat.training.budget.noise_watch import NoiseWatch
from thermosplat.training.budget.offset_shrinkage import drop_offsets, idle_offsets, offset_spectra
from thermosplat.training.budget.opacity_sensitivities import offset_effects, opacity_sensitivities, removal_effects
from thermosplat.training.budget.pruning import dispensable, prune_sets
from thermosplat.training.budget.rounding import round_to_half
from thermosplat.training.budget.sh_bands import drop_bands
from thermosplat.training.budget.teacher import Teacher
from thermosplat.training.budget.tolerances import TOLERANCES, Tolerances
from thermosplat.training.density.gaussian_ops import kept_on_failure
from thermosplat.training.frames.train_frames import CorrectedFrames, SomeFrames, SpectrumSchedule
from thermosplat.training.out_of_memory import is_out_of_memory
from thermosplat.training.training_state import TrainingState

WATCHED_ONE_IN = 20
"""Where more than one in so many are withheld, views are few: a capture misses each of them, unless images are noisy.
Open choice."""


class AutoBudget:
    """What ``--budget auto`` does between the steps of a run.

    Args:
        state: Model, optimizers and density control.
        schedule: Which of them the steps take.
        noisy: Whether images are noisy.
        tolerances: What it may change.
        teaches: Whether spectra may be trained on what the scene showed when they were best.
    """

    def __init__(
        self,
        config: TrainConfig,
        state: TrainingState,
        frames: CorrectedFrames,
        schedule: SpectrumSchedule,
        *,
        noisy: bool,
        tolerances: Tolerances = TOLERANCES,
        teaches: bool = True,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.config = config
        self.state = state
        self.frames = frames
        self.schedule = schedule
        self.noisy, self.teaches = noisy, teaches
        self._say = say
        self.settings = config.auto_budget
        self.tolerances = tolerances
        self._having = [
            [index for index, frame in enumerate(frames.frames) if name in frame.views] for name in state.model.spectra
        ]
        self.validation = validation_views(self._having, tolerances.validation_views)
        self._withholds_many = more_than_one_in(WATCHED_ONE_IN, self.validation, self._having)
        self._prune_steps = {max(1, round(share * config.max_steps)) for share in self.settings.prune_at}
        self._last_removal = max(self._prune_steps, default=0)
        if not state.budget.growing:  # a resumed run whose growth has ended
            self._stop_strategies()
        schedule.withhold(self.validation if self.withholds() else ())

    def acts_at(self, step: int) -> bool:
        """Whether something may change after this step."""
        return self.prunes_at(step) or self._validates_at(step) or self._growth_is_over(step)

    def prunes_at(self, step: int) -> bool:
        """Whether Gaussians may be removed after this step, and captured steps no longer fit."""
        return step in self._prune_steps

    def after_step(self, step: int, sh_degree: int) -> None:
        """Validate, stop growth or prune, where this step is the one to do so."""
        if self._validates_at(step):
            self.validate(step, sh_degree)
        is_last = step == self._last_removal
        if is_last or self._growth_is_over(step):
            self._stop_growing()
        # a short run may have far to grow after its first share
        if self.prunes_at(step) and not self.state.budget.growing:
            self.state.budget.due = ("prune", "drop_offsets", "reduce_features") if is_last else ("prune",)
        self.do_what_is_due(sh_degree)

    def do_what_is_due(self, sh_degree: int) -> None:
        """Leave out what is due after the step done. What memory is too small for stays due in a checkpoint."""
        actions = {"prune": self.prune, "drop_offsets": self.drop_offsets, "reduce_features": self.reduce_features}
        while self.state.budget.due:
            first, *others = self.state.budget.due
            actions[first](sh_degree)
            self.state.budget.due = tuple(others)

    def finish(self, sh_degree: int) -> None:
        """Drop what is not needed once training is over, all of it or nothing; again only after further steps."""
        model, tolerances = self.state.model, self.tolerances
        with kept_on_failure(model.gaussian_sets.parameters()):
            change = self.images(sh_degree)
            if not change.not_learnt:
                drop_bands(model, self.frames, sh_degree, change, tolerances.sh_change)
                round_to_half(model, self.images(sh_degree), tolerances.rounding_change)
        self.state.budget.trimmed = True

    def withholds(self) -> bool:
        """Whether some training views are withheld after the steps done."""
        watch = self.state.noise_watch
        return bool(self.validation) and (self.state.budget.growing or (watch is not None and not watch.over))

    @property
    def _few_views(self) -> bool:
        """Whether a capture misses each of the withheld views: they are many of all, and images are not noisy."""
        return self._withholds_many and not self.noisy

    @property
    def _watches_falls(self) -> bool:
        """Whether any spectrum may go back that the withheld views of few say has fallen."""
        return self._few_views and self.teaches

    def _validates_at(self, step: int) -> bool:
        if not (step % self.settings.validate_every == 0 and self.withholds()):
            return False
        return all(strategy.has_started(step) for strategy in self.state.strategies.values())

    def _growth_is_over(self, step: int) -> bool:
        """Whether density control adds nothing any more although nobody has stopped it."""
        state = self.state
        if not state.budget.growing:
            return False
        return all(
            strategy.has_ended(step) or strategy.is_full(state.gaussian_sets[name])
            for name, strategy in state.strategies.items()
        )

    @torch.no_grad()
    def validate(self, step: int, sh_degree: int) -> None:
        """Look at the withheld views: note who is better than ever, and stop growth that brings nothing more."""
        state, settings = self.state, self.settings
        found: dict[str, list[float]] = {}
        for index in self.validation:
            frame = self.frames[index]
            rendered = state.model.render(frame.views, sh_degree=sh_degree, shared_cameras=frame.shared_cameras)
            for name in state.model.spectra:
                view = frame.views.get(name)
                if name in rendered.images and view is not None and view.image is not None:
                    found.setdefault(name, []).append(psnr(rendered.images[name], view.image, view.mask))
        means = {name: sum(values) / len(values) for name, values in found.items()}
        if state.noise_watch is not None:
            teacher = partial(self._teacher, sh_degree)
            loss, patience = self.tolerances.spectrum_loss, self.tolerances.spectrum_looks * settings.validate_every
            state.noise_watch.judge(step, means, loss, patience, teacher, noisy_only=not self._watches_falls)
        if not state.budget.growing:
            self._release()
            return
        value = sum(map(sum, found.values())) / max(sum(map(len, found.values())), 1)
        best, best_step = state.budget.best_validation
        if value > best + self.tolerances.least_gain or not math.isfinite(best):
            state.budget.best_validation = (value, step)
        elif step - best_step >= self.tolerances.growth_looks * settings.validate_every:
            self._stop_growing()

    def _teacher(self, sh_degree: int) -> Teacher | None:
        """The scene as it is now; None where there is no room for another one."""
        if not self.teaches:
            return None
        try:
            return Teacher.of_now(self.state.model, sh_degree)
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
            return None

    def _stop_growing(self) -> None:
        self.state.budget.growing = False
        self._stop_strategies()
        self._release()

    def _stop_strategies(self) -> None:
        for strategy in self.state.strategies.values():
            strategy.growing = False

    def _release(self) -> None:
        """Train on the withheld views, too, unless a spectrum is watched by them."""
        watch = self.state.noise_watch
        if watch is not None and self._has_seen_enough(watch):
            fall = self.tolerances.spectrum_fall if self._watches_falls else math.inf
            for name in watch.end(self.tolerances.spectrum_loss, fall):
                best, then = watch.best[name]
                _, now = watch.lately[name][-1]
                self._say(
                    f"Withheld {label(name)} views were best after step {then:,}: {best:.2f} dB, and now "
                    f"{now:.2f}. From here on the scene learns its {label(name)} from how it looked then."
                )
        if not self.withholds():
            self.schedule.withhold(())

    def _has_seen_enough(self, watch: NoiseWatch) -> bool:
        """Whether withheld views have said what they can once growth has ended."""
        step = self.state.step
        if step >= self._last_removal:
            return True
        if self._watches_falls:
            fallen = watch.fallen(self.tolerances.spectrum_fall)
            share = self.tolerances.fallen_views_until if fallen else self.tolerances.few_views_until
            return step >= round(share * self.config.max_steps)
        return self._few_views or not watch.watches()

    def scores(self, sh_degree: int, change: ImageChange) -> dict[str, Tensor]:
        """What each Gaussian is worth to the training images, [N] by name of the set.

        Args:
            change: Some of the images as they are now.
        """
        model = self.state.model
        sensitivities = self._sensitivities(sh_degree, change)
        return {name: removal_effects(model.gaussians(name), found) for name, found in sensitivities.items()}

    def remove(self, removed: Mapping[str, Tensor]) -> None:
        """Remove Gaussians, by masks [N] by name of the set."""
        state = self.state
        for name, mask in removed.items():  # where memory ends between two sets, each is whole
            prune_sets(state.gaussian_sets, state.optimizers, {name: mask})
            state.strategies[name].forget(len(state.gaussian_sets[name]))

    def drop_offsets(self, sh_degree: int) -> None:
        """Make those opacity offsets zero, for good, that the training images do not miss."""
        state = self.state
        state.budget.offsets_dropped = True
        if not any(map(offset_spectra, state.gaussian_sets.values())):
            return
        change = self.images(sh_degree)
        if change.not_learnt:
            return
        for name, sensitivities in self._sensitivities(sh_degree, change).items():
            gaussians = state.gaussian_sets[name]
            for spectrum in offset_spectra(gaussians):
                effects = offset_effects(gaussians, spectrum, sensitivities)
                dropped = idle_offsets(gaussians, spectrum, effects, change, self.tolerances.offset_change)
                drop_offsets(gaussians, spectrum, state.optimizers[name], dropped)

    def reduce_features(self, sh_degree: int) -> None:
        """Leave as few latent channels as the training images, and the losses on channels, need."""
        state = self.state
        if not state.model.has_features:
            return
        change = self.images(sh_degree, self.config)
        if change.not_learnt:
            return
        reduce_features(state.model, state.optimizers[SHARED], change, self.tolerances.feature_change)

    def images(self, sh_degree: int, losses: TrainConfig | None = None) -> ImageChange:
        """Some training images as they are now."""
        looked_at = spread(self._having, self.tolerances.measured_views)
        return ImageChange(self.state.model, SomeFrames(self.frames, looked_at), sh_degree, losses)

    def prune(self, sh_degree: int) -> None:
        """Remove the Gaussians that the training images do not miss; none of a scene that is not learnt."""
        change = self.images(sh_degree)
        if change.not_learnt:
            self._say(
                f"No Gaussians are removed: the scene has not learnt its {listed(change.not_learnt)} images, so that "
                "nobody knows which of them it needs."
            )
            return
        self.remove(
            {
                name: dispensable(self.state.gaussian_sets[name], values, change, self.tolerances.prune_change)
                for name, values in self.scores(sh_degree, change).items()
            }
        )

    def _sensitivities(self, sh_degree: int, change: ImageChange) -> dict[str, Tensor]:
        """Of the images to opacities; summed over pixels, changes are shares of a spectrum's error as in ``change``."""
        weights = {}
        for spectrum, error in change.errors.items():
            views = [frame.views[spectrum] for frame in self.frames.frames if spectrum in frame.views]
            weights[spectrum] = 1.0 / (
                error * sum(view.channels * view.camera.width * view.camera.height for view in views)
            )
        deterministic = self.config.deterministic
        return opacity_sensitivities(self.state.model, self.frames, sh_degree, weights, deterministic=deterministic)
