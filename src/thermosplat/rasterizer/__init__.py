"""The renderer for torch: ``rasterization`` as gsplat has it, and ``rasterization_rgbt`` for two spectra at once."""

from thermosplat.rasterizer.api import RGBTRender, rasterization, rasterization_rgbt
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.rasterizer.project import project

__all__ = ["PairCapacity", "RGBTRender", "project", "rasterization", "rasterization_rgbt"]
