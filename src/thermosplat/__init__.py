"""thermosplat: RGB + thermal-infrared 3D Gaussian Splatting on NVIDIA Warp kernels.

Importing the package is quick; the renderer (torch, Warp) loads when one of its names is first used:

    from thermosplat import rasterization        # gsplat's signature and meaning
    from thermosplat import rasterization_rgbt   # colours and features at two opacities in one traversal
    from thermosplat import PairCapacity         # to capture renders in CUDA graphs
"""

from typing import TYPE_CHECKING, Any

from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.pair_capacity import PairCapacity
    from thermosplat.rasterizer import RGBTRender, rasterization, rasterization_rgbt

__version__ = "0.1.0"
__all__ = ["PairCapacity", "RGBTRender", "UserError", "__version__", "rasterization", "rasterization_rgbt"]


def __getattr__(name: str) -> Any:
    if name == "PairCapacity":
        from thermosplat.pair_capacity import PairCapacity

        return PairCapacity
    if name in ("RGBTRender", "rasterization", "rasterization_rgbt"):
        from thermosplat import rasterizer

        return getattr(rasterizer, name)
    raise AttributeError(f"module 'thermosplat' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
