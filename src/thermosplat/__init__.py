"""thermosplat: RGB + thermal-infrared 3D Gaussian Splatting on NVIDIA Warp kernels.

Importing the package is quick; the renderer (torch, Warp) loads when one of its names is first used:

    from thermosplat import rasterization        # gsplat's signature and meaning
    from thermosplat import rasterization_rgbt   # colours and features at two opacities in one traversal
    from thermosplat import PairCapacity         # to capture renders in CUDA graphs
    from thermosplat import load_run             # a trained scene
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.evaluation.loaded_run import LoadedRun, load_run
    from thermosplat.rasterizer import RGBTRender, rasterization, rasterization_rgbt
    from thermosplat.rasterizer.pair_capacity import PairCapacity

__version__ = "0.2.0"
__all__ = [
    "LoadedRun",
    "PairCapacity",
    "RGBTRender",
    "UserError",
    "__version__",
    "load_run",
    "rasterization",
    "rasterization_rgbt",
]
_LOADED_WHEN_USED = {
    "LoadedRun": "thermosplat.evaluation.loaded_run",
    "PairCapacity": "thermosplat.rasterizer.pair_capacity",
    "RGBTRender": "thermosplat.rasterizer.api",
    "load_run": "thermosplat.evaluation.loaded_run",
    "rasterization": "thermosplat.rasterizer.api",
    "rasterization_rgbt": "thermosplat.rasterizer.api",
}


def __getattr__(name: str) -> Any:
    if name not in _LOADED_WHEN_USED:
        raise AttributeError(f"module 'thermosplat' has no attribute {name!r}")
    return getattr(import_module(_LOADED_WHEN_USED[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
