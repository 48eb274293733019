"""Gaussians as OpenUSD's ParticleField3DGaussianSplat (OpenUSD 26.03 and later), by usd-core.

Scales and opacities are stored after their activation; coefficients are flattened, all of a Gaussian side by side. The
stage's axes have y up. Source: OpenUSD's user guide, schemas of UsdVol.
"""

from pathlib import Path

import numpy as np

from thermosplat.errors import UserError
from thermosplat.export.splats import Splats, WrittenSplats, drawable, turned_y_up
from thermosplat.runs.atomic_writes import write_atomically


def write_usd(path: Path, splats: Splats, *, name: str = "splats") -> WrittenSplats:
    """Write Gaussians as USD.

    Args:
        path: The file: ``*.usd`` or ``*.usdc`` for the binary form, ``*.usda`` for text.

    Raises:
        UserError: usd-core is not installed, or is too old to know Gaussians.
    """
    try:
        from pxr import Usd, UsdGeom, UsdVol, Vt

        schema = UsdVol.ParticleField3DGaussianSplat
    except (ImportError, AttributeError) as error:
        raise UserError(
            "USD files are written by usd-core 26.3 or later, which is not installed.",
            'Install it: pip install ".[usd]" in the repository. Or choose another --format.',
        ) from error
    shown = turned_y_up(drawable(splats))
    coefficients = np.concatenate([shown.sh0[:, None], shown.shN], axis=1).reshape(-1, 3)
    radii = 3.0 * np.exp(shown.log_scales.max(axis=1, keepdims=True))  # what is drawn ends at three deviations
    extent = [(shown.means - radii).min(axis=0), (shown.means + radii).max(axis=0)] if len(shown) else np.zeros((2, 3))

    def write(temporary: Path) -> None:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        field = schema.Define(stage, f"/{name}")
        stage.SetDefaultPrim(field.GetPrim())
        field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shown.means)))
        xyzw = np.ascontiguousarray(shown.quats[:, [1, 2, 3, 0]])  # as a GfQuatf lies in memory
        field.CreateOrientationsAttr(Vt.QuatfArray.FromBuffer(xyzw))
        field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(np.exp(shown.log_scales)))
        field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(shown.opacities))
        field.CreateRadianceSphericalHarmonicsDegreeAttr(shown.sh_degree)
        field.CreateRadianceSphericalHarmonicsCoefficientsAttr(
            Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(coefficients))
        )
        field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.asarray(extent, np.float32)))
        stage.GetRootLayer().Save()

    write_atomically(path, write)
    return WrittenSplats(path, len(shown), len(splats.means) - len(shown))
