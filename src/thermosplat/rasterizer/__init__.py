"""The renderer for torch: ``rasterization`` as gsplat has it, and ``rasterization_rgbt`` for two spectra at once."""

from thermosplat.rasterizer.api import RGBTRender, rasterization, rasterization_rgbt
from thermosplat.rasterizer.pair_capacity import PairCapacity

__all__ = ["PairCapacity", "RGBTRender", "rasterization", "rasterization_rgbt"]
