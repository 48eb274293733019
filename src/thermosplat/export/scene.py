"""A trained scene as Gaussians with spherical-harmonic colours, one set for each spectrum.

The model decodes features per pixel, after blending; a PLY holds a colour per Gaussian, before blending. What the file
carries is therefore an approximation wherever there are decoders: each Gaussian's own features are decoded as if they
alone filled a pixel (A_f = f). Each spectrum's formation says what that is (``Formation.harmonics``). Scenes of
spherical harmonics alone are exported exactly. ``splat_fit`` makes the approximation a better one.
"""

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.export.export_frame import ExportFrame
from thermosplat.export.formats.ply import write_splats
from thermosplat.export.splat_rendering import OTHERS
from thermosplat.export.splats import Splats, WrittenSplats
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import label
from thermosplat.thermal.intensity import palette_colors, pixel_intensity
from thermosplat.thermal.radiometry import PixelScale

SceneSplats = dict[str, tuple[Splats, list[str]]]
"""By spectrum Gaussians, of tensors of their own, and the comments of the file's header."""
Scales = Mapping[str, PixelScale]
Colors = Literal["palette", "scalar"]
"""How a spectrum that is no photograph is shown: in the colours of its palette, or as its intensity, black to white."""


def scene_splats(
    model: SceneModel,
    scales: Scales,
    spectra: Iterable[str] | None = None,
    *,
    colors: Colors = "palette",
    frame: ExportFrame | None = None,
) -> SceneSplats:
    """What :func:`write_scene` writes, in the frame of the files; None: in that of the capture."""
    frame = frame or ExportFrame(model.placement)
    return {
        name: (
            frame.splats(spectrum_splats(model, name, scales, colors=colors)),
            [*header_comments(model, name, scales[name], frame, colors=colors), *_about_footprints(model)],
        )
        for name in (model.spectra if spectra is None else spectra)
    }


def _about_footprints(model: SceneModel) -> list[str]:
    """What is to be known of splats that were not fitted to other viewers."""
    eps2d = model.config.eps2d
    return [] if eps2d == OTHERS.eps2d else [f"trained with eps2d {eps2d:g} px²: viewers with more blur small images"]


def write_scene(
    scene: SceneSplats,
    folder: Path,
    *,
    compact: bool = False,
    scalars: Mapping[str, Mapping[str, Tensor]] | None = None,
    frame: ExportFrame,
) -> dict[str, WrittenSplats]:
    """Write ``splat_<spectrum>.ply`` for each spectrum, side by side; in any thread, as it does not touch the model.

    Args:
        scalars: Further properties by spectrum (``formats.ply.write_splats``).
        frame: Where positions count from; an origin is told in a file beside the others.
    """

    def write(name: str) -> WrittenSplats:
        further = None if scalars is None else scalars[name]
        return write_splats(folder / f"splat_{name}.ply", *scene[name], compact=compact, scalars=further)

    frame.write(folder)
    with ThreadPoolExecutor() as threads:
        writing = {name: threads.submit(write, name) for name in scene}
    return {name: file.result() for name, file in writing.items()}


@torch.no_grad()
def spectrum_splats(model: SceneModel, name: str, scales: Scales, *, colors: Colors = "palette") -> Splats:
    """Gaussians that show one spectrum by spherical harmonics alone, in the scene's frame; none is a parameter.

    Args:
        scales: What pixel values mean: a decoded scalar goes through its palette.
        colors: Palette or scalar. Pseudo-colours of a model without decoders stay, whatever is asked.

    Raises:
        UserError: The spectrum is not modelled.
    """
    if name not in model.spectra:
        raise UserError(
            f"This scene was trained without {label(name)} images, so it has no {label(name)} splats to export.",
            f"It has: {', '.join(model.spectra)}.",
        )
    gaussians = model.gaussians(model.set_of(name))
    harmonics = model.formations[name].harmonics(gaussians, lambda image: shown_colors(image, scales[name], colors))
    columns = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logits_in(name), *harmonics)
    return Splats(*(column.detach() for column in columns))


def shown_colors(image: Tensor, scale: PixelScale, colors: Colors = "palette") -> Tensor:
    """Pixels of a model as the colours of splats, [..., 3].

    Args:
        image: Values in [0, 1], [..., C], C as the scale says.
        colors: Palette or scalar; photographs are as they are.
    """
    if not scale.has_intensity or (scale.kind == "color" and colors == "palette"):
        return image[..., :3]
    intensity = pixel_intensity(image, scale)
    if colors == "scalar":
        return intensity[..., None].expand(*intensity.shape, 3).to(image)
    return palette_colors(intensity, scale.palette).to(image)


@torch.no_grad()
def spectrum_values(model: SceneModel, name: str, scales: Scales) -> Tensor:
    """What each Gaussian measures in a spectrum [its unit], [N]: decoded from its own features, or from its harmonics.

    Raises:
        ValueError: The spectrum has no unit.
    """
    image = model.formations[name].image_of(model.gaussians(model.set_of(name)))
    return torch.as_tensor(scales[name].value(pixel_intensity(image, scales[name])))


def header_comments(
    model: SceneModel, name: str, scale: PixelScale, frame: ExportFrame, *, colors: Colors = "palette"
) -> list[str]:
    """What a file says about its splats: the spectrum, its palette and range, how exact its colours are."""
    comments = [f"thermosplat {name}", *frame.comments()]
    exact = model.formations[name].exact_splats
    if not exact:
        comments.append("colors approximate the model, which decodes features per pixel, after blending")
    if scale.has_intensity:
        if colors == "palette" and (scale.kind == "color" or not exact):
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
    return comments
