"""The renderer for torch: ``rasterization`` as gsplat has it, and ``rasterization_rgbt`` for two spectra at once."""

from thermosplat.rasterizer.api import rasterization
from thermosplat.rasterizer.lenses import (
    FThetaCameraDistortionParameters,
    FThetaPolynomialType,
    LensArguments,
    RollingShutterType,
)
from thermosplat.rasterizer.median_depths import median_depths
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.rasterizer.project import project
from thermosplat.rasterizer.rgbt import RGBTRender, rasterization_rgbt

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
