"""The renderer for torch: ``rasterization`` as gsplat has it, and ``rasterization_rgbt`` for two spectra at once."""

from thermosplat.rasterizer.api import rasterization
from thermosplat.rasterizer.call_inputs import LensArguments
from thermosplat.rasterizer.lenses import (
    FThetaCameraDistortionParameters,
    FThetaPolynomialType,
    RollingShutterType,
)
from thermosplat.rasterizer.median_depths import median_depths
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.rasterizer.rgbt import RGBTRender, rasterization_rgbt
from thermosplat.rasterizer.scene_of_call import project

__all__ = [
    "FThetaCameraDistortionParameters",
    "FThetaPolynomialType",
    "LensArguments",
    "PairCapacity",
    "RGBTRender",
    "RollingShutterType",
    "median_depths",
    "project",
    "rasterization",
    "rasterization_rgbt",
]
