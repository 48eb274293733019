"""thermosplat: RGB + thermal-infrared 3D Gaussian Splatting on NVIDIA Warp kernels.

Importing the package is quick; the renderer (torch, Warp) loads when one of its names is first used:

    from thermosplat import rasterization        # gsplat's signature and meaning
    from thermosplat import rasterization_rgbt   # colours and features at two opacities in one traversal
    from thermosplat import fully_fused_projection, rasterize_to_pixels  # and the other steps that gsplat has
    from thermosplat import SelectiveAdam, compute_relocation  # and what trainers take from it besides
    from thermosplat import PairCapacity         # to capture renders in CUDA graphs
    from thermosplat import load_run             # a trained scene

Every other public name of gsplat says what there is in its place.
"""

import sys

# "python -m" puts the current folder first, before it looks for what it is to run. Files that lie there, perhaps a
# stranger's, would be taken for the modules that are imported from here on.
if sys.argv[:1] == ["-m"] and not sys.flags.safe_path:
    _flags, _name, _rest = sys.orig_argv[-len(sys.argv)].partition("thermosplat")  # -m thermosplat, -umthermosplat.cli
    if _name and _rest[:1] in ("", ".") and (not _flags or _flags[0] + _flags[-1] == "-m"):
        del sys.path[0]

from importlib import import_module
from typing import TYPE_CHECKING, Any

from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.evaluation.loaded_run import LoadedRun, load_run
    from thermosplat.fused.relocation import compute_relocation
    from thermosplat.fused.selective_adam import SelectiveAdam
    from thermosplat.rasterizer import RGBTRender, rasterization, rasterization_rgbt
    from thermosplat.rasterizer.arguments import CameraModel, RasterizeMode, RenderMode
    from thermosplat.rasterizer.lenses import (
        FThetaCameraDistortionParameters,
        FThetaPolynomialType,
        RollingShutterType,
    )
    from thermosplat.rasterizer.pair_capacity import PairCapacity
    from thermosplat.rasterizer.steps import (
        fully_fused_projection,
        isect_offset_encode,
        isect_tiles,
        quat_scale_to_covar_preci,
        rasterize_to_pixels,
        spherical_harmonics,
    )

__version__ = "0.2.0"
__all__ = [
    "CameraModel",
    "FThetaCameraDistortionParameters",
    "FThetaPolynomialType",
    "LoadedRun",
    "PairCapacity",
    "RGBTRender",
    "RasterizeMode",
    "RenderMode",
    "RollingShutterType",
    "SelectiveAdam",
    "UserError",
    "__version__",
    "compute_relocation",
    "fully_fused_projection",
    "isect_offset_encode",
    "isect_tiles",
    "load_run",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterization_rgbt",
    "rasterize_to_pixels",
    "spherical_harmonics",
]
_LOADED_WHEN_USED = {
    "CameraModel": "thermosplat.rasterizer.arguments",
    "RasterizeMode": "thermosplat.rasterizer.arguments",
    "RenderMode": "thermosplat.rasterizer.arguments",
    "SelectiveAdam": "thermosplat.fused.selective_adam",
    "compute_relocation": "thermosplat.fused.relocation",
    "quat_scale_to_covar_preci": "thermosplat.rasterizer.steps",
    "fully_fused_projection": "thermosplat.rasterizer.steps",
    "isect_offset_encode": "thermosplat.rasterizer.steps",
    "isect_tiles": "thermosplat.rasterizer.steps",
    "rasterize_to_pixels": "thermosplat.rasterizer.steps",
    "spherical_harmonics": "thermosplat.rasterizer.steps",
    "FThetaCameraDistortionParameters": "thermosplat.rasterizer.lenses",
    "FThetaPolynomialType": "thermosplat.rasterizer.lenses",
    "LoadedRun": "thermosplat.evaluation.loaded_run",
    "PairCapacity": "thermosplat.rasterizer.pair_capacity",
    "RGBTRender": "thermosplat.rasterizer.rgbt",
    "RollingShutterType": "thermosplat.rasterizer.lenses",
    "load_run": "thermosplat.evaluation.loaded_run",
    "rasterization": "thermosplat.rasterizer.api",
    "rasterization_rgbt": "thermosplat.rasterizer.rgbt",
}


def __getattr__(name: str) -> Any:
    if name in _LOADED_WHEN_USED:
        try:
            return getattr(import_module(_LOADED_WHEN_USED[name]), name)
        except ModuleNotFoundError as error:
            if not str(error.name).startswith("thermosplat."):
                raise
            message = f"thermosplat.{name} is not in thermosplat-rasterizer, the rasterizer alone; thermosplat has it."
            raise ImportError(message, name=name) from None
    from thermosplat.gsplat_names import INSTEAD

    if name not in INSTEAD:
        raise AttributeError(f"module 'thermosplat' has no attribute {name!r}")
    message = f"thermosplat.{name} does not exist: {INSTEAD[name]}."
    # Of an AttributeError "from thermosplat import ..." shows nothing; hasattr() understands nothing else.
    if sys._getframe(1).f_globals.get("__name__") == "importlib._bootstrap":
        raise ImportError(message, name=name)
    raise AttributeError(message)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
