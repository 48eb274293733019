"""thermosplat: RGB + thermal-infrared 3D Gaussian Splatting on NVIDIA Warp kernels.

Importing the package is quick; the renderer (torch, Warp) loads when one of its names is first used:

    from thermosplat import rasterization        # gsplat's signature and meaning
"""

from typing import TYPE_CHECKING, Any

from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.rasterization import rasterization, rasterization_rgbt

__version__ = "0.1.0"
__all__ = ["UserError", "__version__", "rasterization", "rasterization_rgbt"]


def __getattr__(name: str) -> Any:
    if name in ("rasterization", "rasterization_rgbt"):
        import importlib

        # The function has its module's name: put the function in the package's namespace, where users look for it.
        module = importlib.import_module("thermosplat.rasterization")
        globals().update(rasterization=module.rasterization, rasterization_rgbt=module.rasterization_rgbt)
        return globals()[name]
    raise AttributeError(f"module 'thermosplat' has no attribute {name!r}")
