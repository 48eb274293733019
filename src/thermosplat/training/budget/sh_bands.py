"""Spherical harmonics that the training images do not miss, set to zero Gaussian by Gaussian.

A pixel's colour is Σ_i w_i c_i. Where a Gaussian keeps degree d alone its colour changes by Δc_i, and the images by
about D_i(d) = Σ w_i² |Δc_i|², summed over pixels and views. Each Gaussian keeps the degree of least D_i(d) + λ B(d),
with B(d) the coefficients of degrees 1 to d: the least change for as many coefficients as are kept (Lagrangian rate
allocation). λ is the largest one with which the rendered images change within the tolerance.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors
from thermosplat.rasterizer import project
from thermosplat.rasterizer.projected_scene import ProjectedScene
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.scene.views import Coefficients, projection_arguments
from thermosplat.training.budget.contributions import squared_contributions
from thermosplat.training.budget.image_change import ImageChange, most_within

_LEAST_LAMBDA = 1e-20
_LAMBDA_STEP = 1.15
_LAMBDAS = 400
"""λ from 1e-20 to 2e4: below the first only zeros go, above the last all there is, as D is a share of at most 1."""


@dataclass(frozen=True)
class _Band:
    """Coefficients of one spectrum of one set."""

    values: Tensor
    """Of degree 1 and above, the parameter itself, [N, K-1, 3]."""
    saved: Tensor
    """As they were."""
    distortions: Tensor
    """D of every degree up to the one in use, [degree + 1, N]."""


@torch.no_grad()
def drop_bands(
    model: SceneModel, frames: Iterable[FrameTensors], sh_degree: int, change: ImageChange, tolerance: float
) -> None:
    """Set all coefficients above each Gaussian's needed degree to zero.

    Args:
        frames: The training frames; gone through several times.
        change: The images from before.
        tolerance: Largest change (``ImageChange.now``).
    """
    bands = list(_bands(model, frames, sh_degree))

    def cut(number: int) -> None:
        price = 0.0 if number == 0 else _LEAST_LAMBDA * _LAMBDA_STEP**number
        for band in bands:
            band.values.copy_(_up_to(band.saved, cheapest_degrees(band.distortions, price)))

    most_within(change, _LAMBDAS, cut, tolerance)


def cheapest_degrees(distortions: Tensor, price: float) -> Tensor:
    """The lowest degree of least D + λ B, int64 [N].

    Args:
        distortions: D of the degrees 0 to the highest, [degree + 1, N].
    """
    degrees = torch.arange(len(distortions), device=distortions.device)
    costs = distortions.double() + price * ((degrees + 1) ** 2 - 1)[:, None]
    return (costs <= costs.amin(dim=0)).to(torch.int64).argmax(dim=0)


def color_changes(
    gaussians: Gaussians, coefficients: Coefficients, views: Iterable[ViewTensors], sh_degree: int
) -> Tensor:
    """|Δc|² of keeping each degree alone, mean over the views a Gaussian is seen from, [degree + 1, N].

    Args:
        gaussians: The set.
        coefficients: Its spherical harmonics.
        views: The cameras.
    """
    changes = gaussians.means.new_zeros(sh_degree + 1, len(gaussians))
    times_seen = gaussians.means.new_zeros(len(gaussians))
    for view in views:
        scene = _projected(gaussians, coefficients, view, sh_degree)
        seen = scene.projected.visible.reshape(-1)
        times_seen += seen
        for degree in range(sh_degree):
            change = (scene.features[degree] - scene.features[-1]).square().sum(dim=-1).reshape(-1)
            changes[degree] += torch.where(seen, change, 0.0)
    return changes / times_seen.clamp(min=1.0)


def _bands(model: SceneModel, frames: Iterable[FrameTensors], sh_degree: int) -> Iterable[_Band]:
    """All coefficients above degree 0 that are rendered."""
    weights = squared_contributions(model, frames)
    for row, spectrum in enumerate(model.spectra):
        if not model.formations[spectrum].takes_colors:
            continue
        name = model.set_of(spectrum)
        gaussians = model.gaussians(name)
        coefficients = gaussians.sh_coeffs_of(spectrum)
        cameras = [
            replace(model.seen(frame.views[spectrum]), image=None, intensity=None, values=None)
            for frame in frames
            if spectrum in frame.views
        ]
        changes = color_changes(gaussians, coefficients, cameras, sh_degree)
        yield _Band(coefficients[1], coefficients[1].clone(), changes * weights[name][row])


def _up_to(shN: Tensor, degrees: Tensor) -> Tensor:
    """Coefficients [N, K-1, 3] with zeros above each one's degree [N]."""
    bases = torch.arange(shN.shape[1], device=shN.device)
    dropped = bases >= ((degrees + 1) ** 2 - 1)[:, None]
    return shN.masked_fill(dropped[..., None], 0.0)


def _projected(gaussians: Gaussians, coefficients: Coefficients, view: ViewTensors, sh_degree: int) -> ProjectedScene:
    """The set projected to one camera, which says who is seen, with its colours of every degree up to ``sh_degree``."""
    return project(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        drawn={f"colors of degree {degree}": (coefficients, degree) for degree in range(sh_degree + 1)},
        thermal_opacities=gaussians.largest_opacities if gaussians.second_opacities else None,
        **projection_arguments(view),
    )
