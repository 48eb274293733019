"""What a run can be told: the schema, presets in YAML, and checks. Nothing here imports torch."""

from thermosplat.config.schema import (
    OF_FRAMES,
    AutoBudgetConfig,
    DecoderConfig,
    DensificationConfig,
    ImageSize,
    LensUse,
    LossConfig,
    ModelConfig,
    OptimizerConfig,
    Refined,
    ResolutionConfig,
    TrainConfig,
)

__all__ = [
    "OF_FRAMES",
    "AutoBudgetConfig",
    "DecoderConfig",
    "DensificationConfig",
    "ImageSize",
    "LensUse",
    "LossConfig",
    "ModelConfig",
    "OptimizerConfig",
    "Refined",
    "ResolutionConfig",
    "TrainConfig",
]
