"""What a training does, resolved once: the configuration, and what the capture's images make of it.

The number of training views and the noise of the images decide how many steps there are, how many Gaussians, which
weights and which floors. A run that goes on keeps what was decided when it began, whatever its images say now.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from thermosplat.config import TrainConfig
from thermosplat.config.run_schedule import run_schedule, steps_note
from thermosplat.datasets.capture import Capture
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.scene.formations.saved_formations import as_trained
from thermosplat.spectra import listed
from thermosplat.thermography.display_range import times_as_wide
from thermosplat.training.budget.noise_floor import noise_floors
from thermosplat.training.budget.tolerances import Tolerances
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.image_noise import training_noise
from thermosplat.training.sensor_facts import SensorFacts


@dataclass(frozen=True)
class Recipe:
    """What a training does."""

    asked: TrainConfig
    """The configuration as it was given and is kept."""
    config: TrainConfig
    """What it means for this capture and for steps of so many frames."""
    noisy: tuple[str, ...]
    """Spectra whose images counted as noisy when the run began."""
    floors: dict[str, float]
    """By spectrum, the squared error below which no view is fitted (noise_floor.py)."""
    notes: tuple[str, ...]
    """What the user is told of it."""

    @classmethod
    def of(
        cls,
        asked: TrainConfig,
        capture: Capture,
        frames: TrainFrames,
        checkpoint: Checkpoint | None,
        tolerances: Tolerances,
    ) -> "Recipe":
        """The recipe of a run.

        Args:
            checkpoint: What it goes on from; None: it begins.
        """
        known = None if checkpoint is None else checkpoint.training.noisy
        facts = SensorFacts(asked, partial(training_noise, frames), known, partial(times_as_wide, capture))
        notes = steps_note(asked, len(frames), facts.noisy)
        config = run_schedule(asked, len(frames), facts.noisy)
        if checkpoint is not None:
            # its noise has decided, whatever that of images of another size would
            trained = as_trained(config.modelled, checkpoint.model.decoders)
            config = replace(config, spectra={**config.spectra, **trained})
        config, of_noise = facts.fitted(config, blur_is_known=checkpoint is not None)
        config, of_limit = with_limit(config, capture, facts.noisy)
        floors, of_floors = noise_floors(config, facts, tolerances.noise_floor)
        return cls(asked, config, facts.noisy, floors, (*notes, *of_noise, *of_floors, *of_limit))


LEAST = 300_000
"""What images of 400x300 were tried with (benchmarks/records/thermosplat-plus-preset.md)."""
LEAST_OF_NOISY = 150_000
"""Likewise where they are noisy (benchmarks/records/low-light.md)."""
MOST = 3_000_000
"""About what 3DGS ends with for Mip-NeRF 360 in the mean: 734 MB of 236 bytes each. Kerbl et al. 2023, table 1."""


def with_limit(config: TrainConfig, capture: Capture, noisy: Sequence[str]) -> tuple[TrainConfig, tuple[str, ...]]:
    """The configuration with the limit of each scene, which MCMC needs: it grows until there is one.

    Of a limit that is given, each of several scenes has its part. Where none is, MCMC's is one Gaussian for each pixel
    of the largest training image, from ``LEAST`` to ``MOST``, or from ``LEAST_OF_NOISY`` where images are noisy. For
    images of 1297x840 that is the million which gsplat's trainer has for Mip-NeRF 360.

    Args:
        capture: Its training frames, of the size that is trained with.

    Returns:
        The configuration, and what to tell the user about it.
    """
    densification, limit = config.densification, config.densification.max_gaussians
    notes: tuple[str, ...] = ()
    if densification.strategy == "mcmc" and limit is None:
        frames = capture.train
        cameras = [view.camera for frame in frames for name, view in frame.views.items() if name in config.modelled]
        pixels = max((camera.width * camera.height for camera in cameras), default=0)
        limit = min(max(LEAST_OF_NOISY if noisy else LEAST, pixels), MOST)
        if limit < LEAST:
            notes = (f"At most {limit:,} Gaussians are made, since {listed(noisy)} images are noisy.",)
    if limit is None:
        return config, notes
    return replace(config, densification=replace(densification, max_gaussians=math.ceil(limit / config.scenes))), notes
