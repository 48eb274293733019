"""The size of the training images, and the number of Gaussians that goes with it, by step.

Early steps learn what large structures show, and small images show it at a fraction of the time. DashGaussian (Chen et
al. 2025, arXiv 2503.18402) lets images and Gaussians grow together, since what small images do not show says nothing of
where more Gaussians are needed. Here a few sizes follow each other, and each has its limit to growth.
"""

from thermosplat.config import TrainConfig


def image_factor(config: TrainConfig, step: int) -> float:
    """What the sides of the training images are divided by in a step; 1.0 at full size.

    Args:
        step: The step, from 1.
    """
    return next((factor for factor, end in _stages(config) if step <= end), 1.0)


def most_gaussians(config: TrainConfig, factor: float) -> int | None:
    """How many Gaussians a set may grow to with images of a size; None: without a limit."""
    most = config.densification.max_gaussians
    return most if most is None or factor == 1.0 else max(1, int(most / factor**config.resolution.growth_power))


def resolution_note(config: TrainConfig) -> tuple[str, ...]:
    """What a user is told of the sizes of images; nothing where all steps have full size."""
    sizes = ", ".join(f"divided by {factor:g} up to step {end:,}" for factor, end in _stages(config))
    if not sizes:
        return ()
    return (f"Sides of the training images: {sizes}, then of full size.",)


def _stages(config: TrainConfig) -> list[tuple[float, int]]:
    """The factors, and the last step of each."""
    shares = zip(config.resolution.factors, config.resolution.until, strict=True)
    return [(float(factor), round(share * config.max_steps)) for factor, share in shares]
