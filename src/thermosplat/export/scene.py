"""A trained scene as Gaussians with spherical-harmonic colours, one set for each spectrum.

The model decodes features per pixel, after blending; a PLY holds a colour per Gaussian, before blending. What the file
carries is therefore an approximation wherever there are decoders: each Gaussian's own features are decoded as if they
alone filled a pixel (A_f = f). RGB adds that decoded colour to the SH colour; thermal has the decoded colour only, seen
at the thermal opacity. Scenes without decoders are exported exactly.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.export.ply import Splats, WrittenPly, write_splats
from thermosplat.gaussians import SH_C0, Gaussians
from thermosplat.model import SceneModel
from thermosplat.radiometry import ThermalScale

Modality = Literal["rgb", "thermal"]
SceneSplats = dict[Modality, tuple[Splats, list[str]]]


def export_scene(
    model: SceneModel,
    folder: Path,
    *,
    thermal_scale: ThermalScale | None,
    modalities: Iterable[Modality] | None = None,
    compact: bool = False,
) -> dict[Modality, WrittenPly]:
    """Write ``splat_rgb.ply`` and ``splat_thermal.ply``.

    Args:
        model: The trained scene.
        folder: Folder to write into; made where there is none.
        thermal_scale: What the thermal values mean; None for a model without thermal images.
        modalities: Which files to write. None: every modality that is modelled.
        compact: Leave out spherical harmonics that are zero everywhere (``ply.write_splats``).

    Returns:
        What was written, by modality.

    Raises:
        UserError: A modality that is asked for but not modelled.
    """
    return write_scene(scene_splats(model, thermal_scale, modalities), folder, compact=compact)


def scene_splats(
    model: SceneModel, thermal_scale: ThermalScale | None, modalities: Iterable[Modality] | None = None
) -> SceneSplats:
    """What :func:`write_scene` writes: by modality Gaussians, of tensors of their own, and the header's comments."""
    return {
        modality: (modality_splats(model, modality, thermal_scale), _comments(model, modality, thermal_scale))
        for modality in (modelled(model) if modalities is None else modalities)
    }


def write_scene(scene: SceneSplats, folder: Path, *, compact: bool = False) -> dict[Modality, WrittenPly]:
    """The files of :func:`export_scene`, side by side; in any thread, as it does not touch the model."""
    with ThreadPoolExecutor() as threads:
        writing = {
            modality: threads.submit(write_splats, folder / f"splat_{modality}.ply", *splats, compact=compact)
            for modality, splats in scene.items()
        }
    return {modality: file.result() for modality, file in writing.items()}


def modelled(model: SceneModel) -> tuple[Modality, ...]:
    """The modalities that a model renders."""
    switches: dict[Modality, bool] = {"rgb": model.config.rgb, "thermal": model.config.thermal}
    return tuple(modality for modality, on in switches.items() if on)


@torch.no_grad()
def modality_splats(model: SceneModel, modality: Modality, thermal_scale: ThermalScale | None) -> Splats:
    """Gaussians that show one modality by spherical harmonics alone; no tensor is a parameter of the model.

    Args:
        model: The trained scene.
        modality: What to show.
        thermal_scale: What the thermal values mean: a decoded scalar goes through its palette. RGB does not need it.

    Raises:
        UserError: The modality is not modelled.
    """
    if modality not in modelled(model):
        raise UserError(f"This scene was trained without {modality} images, so it has no {modality} splats to export.")
    gaussians = model.gaussians("shared" if "shared" in model.gaussian_sets else modality)
    of_thermal = modality == "thermal"
    logit_opacities: Tensor = gaussians.thermal_logits if of_thermal else gaussians.logit_opacities
    sh0, shN = gaussians.thermal_sh_coeffs if of_thermal else gaussians.sh_coeffs
    if model.decoders is not None and modality == "rgb":
        decoded = model.decoders.rgb(_decoder_input(model, gaussians))
        if model.decoder_config.hybrid_rgb:
            sh0 = sh0 + decoded[:, None] / SH_C0
        else:
            sh0, shN = _constant_color(decoded, shN)
    elif model.decoders is not None:
        sh0, shN = _constant_color(_decoded_thermal(model, gaussians, thermal_scale), shN)
    columns = (gaussians.means, gaussians.quats, gaussians.log_scales, logit_opacities, sh0, shN)
    return Splats(*(column.detach() for column in columns))


def _decoder_input(model: SceneModel, gaussians: Gaussians) -> Tensor:
    """Features as the decoders take them; where they also want a viewing direction, none: zero."""
    features = gaussians.expanded(gaussians.features)
    return torch.nn.functional.pad(features, (0, 3)) if model.decoder_config.view_direction else features


def _decoded_thermal(model: SceneModel, gaussians: Gaussians, thermal_scale: ThermalScale | None) -> Tensor:
    if model.decoders is None:
        raise ValueError("A model without decoders has no decoded thermal colours.")
    decoded = model.decoders.thermal(_decoder_input(model, gaussians))
    if decoded.shape[-1] == 3:
        return decoded
    if thermal_scale is None:
        raise ValueError("Scalar thermal values need a ThermalScale, whose palette gives them colours.")
    return torch.as_tensor(thermal_scale.palette.to_color(decoded[:, 0].cpu().numpy()), device=decoded.device)


def _constant_color(color: Tensor, shN: Tensor) -> tuple[Tensor, Tensor]:
    """SH coefficients of a colour [N, 3] that is the same from everywhere."""
    return (color[:, None] - 0.5) / SH_C0, torch.zeros_like(shN)


def _comments(model: SceneModel, modality: Modality, thermal_scale: ThermalScale | None) -> list[str]:
    comments = [f"thermosplat {modality}"]
    if model.decoders is not None:
        comments.append("colors approximate the model: features are decoded per Gaussian, not per blended pixel")
    if modality == "thermal" and thermal_scale is not None:
        if thermal_scale.kind == "color" or model.decoders is not None:
            stops = np.rint(255 * thermal_scale.palette.to_color(np.linspace(0.0, 1.0, 9))).astype(int)
            listed = " ".join(f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in stops)
            comments.append(f"thermal_palette coldest to hottest: {listed}")
        else:
            comments.append("thermal_palette none: black is the coldest, white the hottest")
        if thermal_scale.range_celsius is not None:
            low, high = thermal_scale.range_celsius
            comments.append(f"thermal_range_celsius {low:g} {high:g}")
        else:
            comments.append("thermal_range_celsius unknown")
    if model.config.rasterize_mode == "antialiased":
        comments.append("trained with antialiased rasterization: view it with mip-splatting's filter")
    return comments
