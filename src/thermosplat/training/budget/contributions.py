"""How much each Gaussian contributes to the training images, by the squares of its blending weights.

Their sum says how much the squared error grows where a Gaussian is missing: a few pixels that are its own count for
more than a trace in many. A render is A = Σ_i a_i w_i with blending weights w_i (equation 1), so with random signs
s_p = ±1 on the pixels the gradient of Σ s_p A_p with respect to a_i is Σ s_p w_p, whose square has the expected value
Σ w_p² (Hutchinson 1990): one backward pass per view gives those of all Gaussians, and each colour channel is a sample.
With several opacities every Gaussian has a weight in each spectrum.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors
from thermosplat.rasterizer import rasterization, rasterization_rgbt
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.model import SceneModel
from thermosplat.scene.views import camera_arguments


def squared_contributions(model: SceneModel, frames: Iterable[FrameTensors]) -> dict[str, Tensor]:
    """Each Gaussian's share of all squared blending weights of a spectrum, estimated with the same signs at every call.

    Returns:
        By name of the set, shape [S, N], a row per spectrum of the model; it adds up to 1, or is 0 where the set does
        not render that spectrum.
    """
    signs = torch.Generator().manual_seed(0)
    tiny = torch.finfo(torch.float32).tiny
    sums = _squared_weights(model, frames, signs)
    return {name: weights / weights.sum(dim=1, keepdim=True).clamp(min=tiny) for name, weights in sums.items()}


def _squared_weights(model: SceneModel, frames: Iterable[FrameTensors], signs: torch.Generator) -> dict[str, Tensor]:
    """Sums of squared blending weights in the images of each spectrum [S, N] by name of the set."""
    rows = {spectrum: row for row, spectrum in enumerate(model.spectra)}
    weights = {
        name: torch.zeros(len(rows), len(model.gaussians(name)), device=_device(model)) for name in model.gaussian_sets
    }
    for frame in frames:
        for group in frame.shared_cameras:
            names = [spectrum for spectrum in rows if spectrum in group]
            if len(names) > 1 and SHARED in model.gaussian_sets and rows[names[0]] == 0:
                first, second, *names = names
                both = _weights_of_two(model, second, frame.views[first], signs)
                weights[SHARED][[rows[first], rows[second]]] += both
            for spectrum in names:
                name = model.set_of(spectrum)
                weights[name][rows[spectrum]] += _weights(model, spectrum, frame.views[spectrum], signs)
    return weights


@torch.enable_grad()
def _weights_of_two(model: SceneModel, second: str, view: ViewTensors, signs: torch.Generator) -> Tensor:
    """Summed squares at α and in a second spectrum, shape [2, N], by one traversal.

    Deterministic, for they decide who goes.
    """
    gaussians = model.gaussians(SHARED)
    # as many channels as training blends, so that its compiled kernels serve
    blended = gaussians.features.shape[1] if gaussians.has_features else 3
    colors, features = _ones(gaussians, 3), _ones(gaussians, blended)
    output = rasterization_rgbt(
        gaussians.means.detach(),
        gaussians.quats.detach(),
        gaussians.scales.detach(),
        gaussians.opacities.detach(),
        gaussians.opacities_in(second).detach() if second in gaussians.second_opacities else None,
        colors,
        features,
        **model.pixel_filter._asdict(),
        **camera_arguments(model.seen(view)),
        deterministic=True,
    )
    thermal = output.render_thermal_features
    if thermal is None:
        thermal = output.render_features
    total = _sum(output.render_colors, signs) + _sum(thermal, signs)
    gradients = torch.autograd.grad(total, (colors, features))
    return torch.stack([_summed_squares(gradient) for gradient in gradients])


@torch.enable_grad()
def _weights(model: SceneModel, spectrum: str, view: ViewTensors, signs: torch.Generator) -> Tensor:
    """Summed squares of one spectrum in one view, shape [N]."""
    gaussians = model.gaussians(model.set_of(spectrum))
    colors = _ones(gaussians, 3)
    image, _, _ = rasterization(
        gaussians.means.detach(),
        gaussians.quats.detach(),
        gaussians.scales.detach(),
        gaussians.opacities_in(spectrum).detach(),
        colors,
        packed=False,
        **model.pixel_filter._asdict(),
        **camera_arguments(model.seen(view)),
        deterministic=True,
    )
    return _summed_squares(torch.autograd.grad(_sum(image, signs), colors)[0])


def _sum(image: Tensor, signs: torch.Generator) -> Tensor:
    """Sum over the first three channels of an image [1, H, W, C], with random signs."""
    image = image[..., :3]
    return (image * (2 * torch.randint(2, image.shape, generator=signs, dtype=torch.int8) - 1).to(image)).sum()


def _summed_squares(gradient: Tensor) -> Tensor:
    """Sums of squared weights [N], of the gradient of ``_sum`` [N, C]."""
    return gradient[:, :3].square().mean(dim=1)


def _ones(gaussians: Gaussians, channels: int) -> Tensor:
    return gaussians.means.new_ones(len(gaussians), channels).requires_grad_()


def _device(model: SceneModel) -> torch.device:
    return model.background.device
