"""Plain calls of the rasterizer replayed from CUDA graphs."""

from thermosplat.rasterizer.replay.replayed_calls import Counts, clear, counts, enable, is_enabled

__all__ = ["Counts", "clear", "counts", "enable", "is_enabled"]
