"""A trained scene as Gaussians with spherical-harmonic colours, one set for each spectrum.

The model decodes features per pixel, after blending; a PLY holds a colour per Gaussian, before blending. What the file
carries is therefore an approximation wherever there are decoders: each Gaussian's own features are decoded as if they
alone filled a pixel (A_f = f). A hybrid photograph adds that decoded colour to the SH colour; other spectra have the
decoded colour only, seen at their own opacity. Scenes without decoders are exported exactly.
"""

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.export.ply import Splats, WrittenPly, write_splats
from thermosplat.scene.gaussians import SH_C0, Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import label
from thermosplat.thermal.radiometry import PixelScale

SceneSplats = dict[str, tuple[Splats, list[str]]]
"""By spectrum Gaussians, of tensors of their own, and the comments of the file's header."""
Scales = Mapping[str, PixelScale]


def export_scene(
    model: SceneModel,
    folder: Path,
    *,
    scales: Scales,
    spectra: Iterable[str] | None = None,
    compact: bool = False,
) -> dict[str, WrittenPly]:
    """Write ``splat_<spectrum>.ply`` for each spectrum.

    Args:
        model: The trained scene.
        folder: Folder to write into; made where there is none.
        scales: What pixel values mean, by spectrum.
        spectra: Which files to write. None: every spectrum that is modelled.
        compact: Leave out spherical harmonics that are zero everywhere (``ply.write_splats``).

    Returns:
        What was written, by spectrum.

    Raises:
        UserError: A spectrum that is asked for but not modelled.
    """
    return write_scene(scene_splats(model, scales, spectra), folder, compact=compact)


def scene_splats(model: SceneModel, scales: Scales, spectra: Iterable[str] | None = None) -> SceneSplats:
    """What :func:`write_scene` writes."""
    return {
        name: (spectrum_splats(model, name, scales), _comments(model, name, scales[name]))
        for name in (model.spectra if spectra is None else spectra)
    }


def write_scene(scene: SceneSplats, folder: Path, *, compact: bool = False) -> dict[str, WrittenPly]:
    """The files of :func:`export_scene`, side by side; in any thread, as it does not touch the model."""
    with ThreadPoolExecutor() as threads:
        writing = {
            name: threads.submit(write_splats, folder / f"splat_{name}.ply", *splats, compact=compact)
            for name, splats in scene.items()
        }
    return {name: file.result() for name, file in writing.items()}


@torch.no_grad()
def spectrum_splats(model: SceneModel, name: str, scales: Scales) -> Splats:
    """Gaussians that show one spectrum by spherical harmonics alone; no tensor is a parameter of the model.

    Args:
        model: The trained scene.
        name: The spectrum to show.
        scales: What pixel values mean: a decoded scalar goes through its palette.

    Raises:
        UserError: The spectrum is not modelled.
    """
    if name not in model.spectra:
        raise UserError(
            f"This scene was trained without {label(name)} images, so it has no {label(name)} splats to export.",
            f"It has: {', '.join(model.spectra)}.",
        )
    gaussians = model.gaussians(model.set_of(name))
    sh0, shN = gaussians.sh_coeffs_of(name)
    if model.decoders is not None:
        decoded = model.decoders.image(name, _decoder_input(model, gaussians))
        if name == model.photograph and model.decoder_config.hybrid:
            sh0 = sh0 + decoded[:, None] / SH_C0
        else:
            sh0, shN = _constant_color(_colors(decoded, scales[name]), shN)
    columns = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logits_in(name), sh0, shN)
    return Splats(*(column.detach() for column in columns))


def _decoder_input(model: SceneModel, gaussians: Gaussians) -> Tensor:
    """Features as the decoders take them; where they also want a viewing direction, none: zero."""
    features = gaussians.expanded(gaussians.features)
    return torch.nn.functional.pad(features, (0, 3)) if model.decoder_config.view_direction else features


def _colors(decoded: Tensor, scale: PixelScale) -> Tensor:
    """Decoded values [N, C] as colours [N, 3]: scalars go through the palette."""
    if decoded.shape[-1] == 3:
        return decoded
    return torch.as_tensor(scale.palette.to_color(decoded[:, 0].cpu().numpy())).to(decoded)


def _constant_color(color: Tensor, shN: Tensor) -> tuple[Tensor, Tensor]:
    """SH coefficients of a colour [N, 3] that is the same from everywhere."""
    return (color[:, None] - 0.5) / SH_C0, torch.zeros_like(shN)


def _comments(model: SceneModel, name: str, scale: PixelScale) -> list[str]:
    comments = [f"thermosplat {name}"]
    if model.decoders is not None:
        comments.append("colors approximate the model: features are decoded per Gaussian, not per blended pixel")
    if scale.kind != "photograph":
        if scale.kind == "color" or model.decoders is not None:
            stops = np.rint(255 * scale.palette.to_color(np.linspace(0.0, 1.0, 9))).astype(int)
            listed = " ".join(f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in stops)
            comments.append(f"{name}_palette lowest to highest: {listed}")
        else:
            comments.append(f"{name}_palette none: black is the lowest, white the highest")
        if scale.range is not None:
            low, high = scale.range
            comments.append(f"{name}_range {low:g} {high:g} {scale.unit or ''}".rstrip())
        else:
            comments.append(f"{name}_range unknown")
    if model.config.rasterize_mode == "antialiased":
        comments.append("trained with antialiased rasterization: view it with mip-splatting's filter")
    return comments
