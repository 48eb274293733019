"""Gaussians of a PLY file in the layout of 3D Gaussian Splatting, ours or anybody's, as a model to look at.

The file is data from a stranger: its header is bounded, its counts are compared with its size before memory is taken,
and Gaussians that nothing can draw are left out, with a note. An infinite logit is an opacity of 1 or 0, and the
logarithm of a scale of 0 is -infinity: such values are taken as what they mean.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.config import DecoderConfig, ModelConfig
from thermosplat.datasets.placement import Placement
from thermosplat.datasets.transforms.point_cloud import BYTE_ORDERS, LONGEST_HEADER, PlyError, ply_vertices
from thermosplat.errors import UserError
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import Spectrum
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.viewer.viewed_scene import ViewedScene

SPECTRUM = "rgb"
"""What the colours of a PLY file are shown as."""
_NEEDED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
           "rot_0", "rot_1", "rot_2", "rot_3")  # fmt: skip
_OPAQUE, _FLAT = 30.0, -60.0
"""The sigmoid of the one is 1 in float32, and the exponential of the other 0 when it is squared."""
_HINT = "Expected a binary PLY of 3D Gaussians (x, f_dc_0, opacity, scale_0, rot_0 ...), as thermosplat-export writes."


def open_splats(path: Path, device: torch.device) -> tuple[ViewedScene, list[str]]:
    """The scene of a PLY file.

    Returns:
        The scene; lines to tell the user.

    Raises:
        UserError: It is no such file, or damaged.
    """
    rows = _read(path)
    names = rows.dtype.names or ()

    def columns(*wanted: str) -> torch.Tensor:
        with np.errstate(over="ignore"):  # of float64
            return torch.from_numpy(np.stack([rows[name].astype(np.float32) for name in wanted], axis=-1))

    rest = sum(1 for name in names if re.fullmatch(r"f_rest_\d+", name))
    if rest not in (0, 9, 24, 45, 72) or any(f"f_rest_{index}" not in names for index in range(rest)):
        raise UserError(f"{path} has {rest} SH coefficients f_rest_*; 0, 9, 24, 45 or 72 are expected.", _HINT)
    degree = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}[rest]
    higher = torch.zeros(len(rows), 0, 3)
    if rest:
        higher = columns(*(f"f_rest_{index}" for index in range(rest))).view(len(rows), 3, rest // 3).transpose(1, 2)
    quats = columns("rot_0", "rot_1", "rot_2", "rot_3").double()
    parameters = {
        "means": columns("x", "y", "z"),
        "quats": (quats / quats.norm(dim=1, keepdim=True)).float(),  # NaN of a rotation of length 0
        "log_scales": columns("scale_0", "scale_1", "scale_2").clamp(min=_FLAT),
        "logit_opacities": columns("opacity")[:, 0].clamp(-_OPAQUE, _OPAQUE),
        "sh0": columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
        "shN": higher.contiguous(),
    }
    drawn = [*parameters.values(), parameters["log_scales"].exp()]
    finite = torch.stack([value.reshape(len(rows), -1).isfinite().all(dim=1) for value in drawn]).all(dim=0)
    if not finite.any():
        raise UserError(f"{path} holds no Gaussian whose values are all finite.", _HINT)
    left_out = len(rows) - int(finite.sum())
    notes = []
    if left_out:
        notes.append(
            f"{left_out:,} of {len(rows):,} Gaussians are not shown: they hold values that are not finite, "
            "or a rotation of length 0."
        )
    values = {name: value[finite] for name, value in parameters.items()}
    centers = np.stack([rows[axis][finite.numpy()].astype(np.float64) for axis in "xyz"], axis=-1)
    placement = _placement(centers)
    values["means"] = torch.from_numpy(placement.to_scene(centers).astype(np.float32))
    values["log_scales"] = values["log_scales"] - math.log(placement.unit)
    gaussians = Gaussians(values)
    spectrum = Spectrum(SPECTRUM, 3, "photograph", "shared", (0, 0), None)
    config = ModelConfig(gaussian_sets="separate", feature_dim=0)
    formations = Formations(config, DecoderConfig(), [spectrum])
    model = SceneModel(config, formations, {SPECTRUM: gaussians}, placement=placement)
    return ViewedScene(path.name, model.to(device).eval(), degree, {SPECTRUM: PixelScale("photograph")}, device), notes


def _placement(centers: NDArray[np.float64]) -> Placement:
    """Where Gaussians [N, 3] lie in the file's world, as a camera needs it that sees all of them."""
    middle = np.median(centers, axis=0)
    radius = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    return Placement.of(middle[None] - (0.0, 0.0, 3.0 * radius), centers)


def _read(path: Path) -> NDArray[Any]:
    """The vertices of a PLY file, by the names of their properties."""
    try:
        size = path.stat().st_size
        if not path.is_file():  # nothing that is waited for
            raise UserError(f"{path} is no file.", "Give a RUN, a checkpoint or a PLY.")
        with path.open("rb") as file:
            header = file.read(LONGEST_HEADER)
            if re.search(rb"\nproperty[^\n]* packed_position\r?\n", header):
                raise UserError(
                    f"{path} is a compressed PLY, which thermosplat-view does not read.",
                    "Give the RUN itself, or a PLY of it: thermosplat-export RUN --format ply",
                )
            layout, count, fields, start = ply_vertices(header, _NEEDED)
            if layout == "ascii":
                raise PlyError("it is a text")
            kind = np.dtype([(name, BYTE_ORDERS[layout] + letter) for name, letter in fields])
            if count * kind.itemsize > size - start:
                raise UserError(f"{path} is cut off: {count} Gaussians do not fit into it.", "Copy or export it again.")
            file.seek(start)
            return np.fromfile(file, kind, count)
    except PlyError as error:
        raise UserError(f"{path} is no PLY of 3D Gaussians: {error}.", _HINT) from error
    except OSError as error:
        raise UserError(
            f"Cannot read {path}: {error.strerror or error}.", "Give a RUN, a checkpoint or a PLY."
        ) from error
