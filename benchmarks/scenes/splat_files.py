"""Splat files read back by readers that thermosplat has not written: gsply, pygltflib, usd-core, plyfile.

Each gives Gaussians in the frame of the capture's poses again, as ``Splats``.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.export.splats import SplatArrays, Splats, turned_y_up


def read_by_gsply(path: Path) -> Splats:
    """A PLY, plain or compressed, or a SOG."""
    import gsply

    data = gsply.sogread(str(path)) if path.suffix == ".sog" else gsply.plyread(str(path))
    return _splats(data.means, data.quats, data.scales, data.opacities, data.sh0, data.shN)


def read_spz_by_gsply(path: Path) -> Splats:
    """An SPZ, whose axes are right, up, back."""
    import gsply

    data = gsply.read_spz(str(path))
    arrays = [data.means, data.quats, data.scales, data.opacities, data.sh0, _coefficients(data.shN, len(data.means))]
    return _turned_back(*arrays)


def read_by_pygltflib(path: Path) -> Splats:
    """A GLB with KHR_gaussian_splatting; the container, the JSON and the accessors are pygltflib's to read."""
    import pygltflib

    file = pygltflib.GLTF2().load_binary(str(path))
    binary = file.binary_blob()
    primitive = file.meshes[0].primitives[0]
    if primitive.mode != pygltflib.POINTS or "KHR_gaussian_splatting" not in primitive.extensions:
        raise ValueError(f"{path} holds no Gaussians")

    def values(attribute: str) -> NDArray[np.float32]:
        accessor = file.accessors[getattr(primitive.attributes, attribute)]
        view = file.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        if accessor.componentType != pygltflib.FLOAT:
            raise ValueError(f"{attribute} is not stored in floating point")
        found = np.frombuffer(binary, "<f4", accessor.count * width, view.byteOffset + (accessor.byteOffset or 0))
        return found.reshape(accessor.count, width).copy()

    prefix = "KHR_gaussian_splatting:"
    degrees = [d for d in (1, 2, 3) if hasattr(primitive.attributes, f"{prefix}SH_DEGREE_{d}_COEF_0")]
    higher = [values(f"{prefix}SH_DEGREE_{d}_COEF_{i}") for d in degrees for i in range(2 * d + 1)]
    means = values("POSITION")
    return _turned_back(
        means,
        values(f"{prefix}ROTATION")[:, [3, 0, 1, 2]],
        np.log(values(f"{prefix}SCALE")),
        _logits(values(f"{prefix}OPACITY")[:, 0]),
        values(f"{prefix}SH_DEGREE_0_COEF_0"),
        np.stack(higher, axis=1) if higher else np.zeros((len(means), 0, 3), np.float32),
    )


def read_by_usd_core(path: Path) -> Splats:
    """A USD with one ParticleField3DGaussianSplat, its default prim."""
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(path))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    means = np.array(field.GetPositionsAttr().Get(), np.float32).reshape(-1, 3)
    turns = [(q.GetReal(), *q.GetImaginary()) for q in field.GetOrientationsAttr().Get()]
    bases = (field.GetRadianceSphericalHarmonicsDegreeAttr().Get() + 1) ** 2
    found = field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()
    coefficients = np.array(found, np.float32).reshape(len(means), bases, 3)
    return _turned_back(
        means,
        np.array(turns, np.float32).reshape(-1, 4),
        np.log(np.array(field.GetScalesAttr().Get(), np.float32).reshape(-1, 3)),
        _logits(np.array(field.GetOpacitiesAttr().Get(), np.float32)),
        coefficients[:, 0],
        coefficients[:, 1:],
    )


READERS: dict[str, tuple[str, Callable[[Path], Splats]]] = {
    "ply": ("gsply", read_by_gsply),
    "compressed-ply": ("gsply", read_by_gsply),
    "spz": ("gsply", read_spz_by_gsply),
    "sog": ("gsply", read_by_gsply),
    "glb": ("pygltflib", read_by_pygltflib),
    "usd": ("pxr", read_by_usd_core),
}
"""By format the package that reads it, by the name of its module, and how."""


def _logits(opacities: NDArray[np.float32]) -> NDArray[np.float32]:
    shares = np.clip(opacities.astype(np.float64), 1e-7, 1 - 1e-7)
    return np.log(shares / (1 - shares)).astype(np.float32)


def _coefficients(shN: NDArray[np.float32] | None, count: int) -> NDArray[np.float32]:
    """Coefficients [M, K - 1, 3]; gsply has None or two axes where there are none."""
    return np.zeros((count, 0, 3), np.float32) if shN is None or shN.size == 0 else shN.reshape(count, -1, 3)


def _turned_back(*columns: NDArray[np.float32]) -> Splats:
    """From y up; half a turn twice is none."""
    arrays = turned_y_up(SplatArrays(*columns))
    return _splats(*(getattr(arrays, name) for name in arrays.__dataclass_fields__))


def _splats(
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    logits: NDArray[np.float32],
    sh0: NDArray[np.float32],
    shN: NDArray[np.float32] | None,
) -> Splats:
    higher = _coefficients(shN, len(means))
    columns = (means, quats, log_scales, logits.reshape(-1), sh0.reshape(-1, 1, 3), higher)
    return Splats(*(torch.from_numpy(np.array(column, np.float32)) for column in columns))
