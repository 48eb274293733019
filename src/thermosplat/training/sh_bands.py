"""Spherical harmonics that no training view needs, set to zero Gaussian by Gaussian.

A pixel's colour is Σ_i w_i c_i plus background with Σ_i w_i <= 1. If every colour c_i changes by at most τ in a view,
no pixel of it changes by more than τ. A Gaussian therefore keeps the lowest degree whose colour stays within τ of its
full colour in all training views it is seen from; what is above goes.
"""

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors
from thermosplat.gaussian_views import Coefficients
from thermosplat.gaussians import Gaussians
from thermosplat.model import SceneModel
from thermosplat.projected_scene import ProjectedScene
from thermosplat.rasterization_arguments import checked_settings


@torch.no_grad()
def drop_bands(model: SceneModel, frames: Iterable[FrameTensors], sh_degree: int, tolerance: float) -> None:
    """Set all coefficients above each Gaussian's needed degree to zero.

    Args:
        model: The scene.
        frames: The training frames.
        sh_degree: Degree in use.
        tolerance: τ, largest change of any training image, of the range 0 to 1.
    """
    cameras: dict[str, list[ViewTensors]] = {"rgb": [], "thermal": []}
    for frame in frames:
        for spectrum, view in (("rgb", frame.rgb), ("thermal", frame.thermal)):
            if view is not None:
                cameras[spectrum].append(replace(view, image=None, intensity=None, celsius=None))
    for name in model.gaussian_sets:
        gaussians = model.gaussians(name)
        for spectrum in ("rgb", "thermal"):
            if (name in (spectrum, "shared")) and getattr(model.config, spectrum):
                of_thermal = spectrum == "thermal" and name == "shared"
                if of_thermal and model.decoders is not None:
                    continue  # decoded from features
                coefficients = gaussians.thermal_sh_coeffs if of_thermal else gaussians.sh_coeffs
                needed = needed_degrees(gaussians, coefficients, cameras[spectrum], sh_degree, tolerance)
                _drop(coefficients, needed)


def needed_degrees(
    gaussians: Gaussians, coefficients: Coefficients, views: Iterable[ViewTensors], sh_degree: int, tolerance: float
) -> Tensor:
    """Lowest degree of each Gaussian whose colour stays within the tolerance in all views, int64 [N].

    Args:
        gaussians: The set.
        coefficients: Its spherical harmonics.
        views: The cameras.
        sh_degree: Degree in use.
        tolerance: τ, of the range 0 to 1.
    """
    changes = gaussians.means.new_zeros(sh_degree + 1, len(gaussians))
    for view in views:
        scene = _projected(gaussians, view)
        seen = (scene.projected.radii > 0).all(dim=-1).reshape(-1)
        colors = [_colors(scene, coefficients, degree) for degree in range(sh_degree + 1)]
        for degree in range(sh_degree):
            change = (colors[degree] - colors[-1]).abs().amax(dim=-1)
            changes[degree] = torch.maximum(changes[degree], torch.where(seen, change, 0.0))
    return (changes <= tolerance).to(torch.int64).argmax(dim=0)  # the first that is within; the last always is


def _colors(scene: ProjectedScene, coefficients: Coefficients, degree: int) -> Tensor:
    sh0, shN = coefficients
    return scene.colors(sh0, degree, per_camera=False, higher_degrees=shN)


def _drop(coefficients: Coefficients, degrees: Tensor) -> None:
    shN = coefficients[1]
    bases = torch.arange(shN.shape[1], device=shN.device)
    dropped = bases >= ((degrees + 1) ** 2 - 1)[:, None]
    shN.masked_fill_(dropped[..., None], 0.0)


def _projected(gaussians: Gaussians, view: ViewTensors) -> ProjectedScene:
    """The set projected to one camera, which says who is seen."""
    viewmats, Ks = view.viewmat[None], view.K[None]
    settings = checked_settings(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        None,
        gaussians.opacities,
        viewmats,
        Ks,
        width=view.width,
        height=view.height,
        near_plane=0.01,
        far_plane=1e10,
        radius_clip=0.0,
        eps2d=0.3,
        sh_degree=None,
        tile_size=16,
        render_mode="RGB",
        rasterize_mode="classic",
        camera_model="pinhole",
    )
    return ProjectedScene(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        None,
        gaussians.opacities,
        gaussians.thermal_opacities if gaussians.has_two_opacities else None,
        viewmats,
        Ks,
        settings,
        16,
    )
