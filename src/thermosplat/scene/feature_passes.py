"""Features of a shared set as the spectra of one camera see them: in which traversals they are blended."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from thermosplat.distributed.collectives import tensors_of_all
from thermosplat.fused.depth_spread import features_and_spread, with_depth_moments
from thermosplat.scene.formations.formation import Blended
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.scene.views import Rendering, render_two_opacities, render_view

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


def blend_features(
    gaussians: Gaussians,
    names: Sequence[str],
    photograph: str | None,
    view: "ViewTensors",
    rendering: Rendering,
    rendered: RenderedFrame,
) -> dict[str, Blended]:
    """Features as spectra of one camera see them, each at its opacity, in as few traversals as possible.

    One traversal has SH colours and features at α, and features at one more opacity. Each opacity that is left takes a
    traversal of its own.

    Args:
        gaussians: A set that has features.
        names: The spectra.
        photograph: The one of them that takes SH colours; None: none does.
        view: Their camera and pose.
        rendering: How.
        rendered: Takes the spreads of depths, and what rasterizations say about their calls.

    Returns:
        What was blended, by spectrum.
    """
    values = _blended_values(gaussians, view, rendering)
    own_opacity = [name for name in names if name in gaussians.second_opacities]
    at_alpha = [name for name in names if name not in own_opacity]
    blended: dict[str, Blended] = {}

    def keep(seen_by: Sequence[str], image: Tensor, alpha: Tensor, colors: Tensor | None = None) -> None:
        features, log_depth = _split_features(gaussians, image, alpha, rendering, rendered)
        for name in seen_by:
            of_spectrum = colors if name == photograph else None
            blended[name] = Blended(view, alpha, features, of_spectrum, log_depth, rendering.background)

    def render_alone(seen_by: Sequence[str], logit_opacities: Tensor) -> None:
        image, alpha, info = render_view(gaussians, values, logit_opacities, view, rendering)
        keep(seen_by, image, alpha)
        if not rendering.geometry_held:
            rendered.note_call(SHARED, seen_by, info)

    if photograph is not None:
        second = own_opacity.pop(0) if own_opacity else None
        output = render_two_opacities(gaussians, second, values, view, rendering)
        # squeeze, not [0], whose gradient would be copied into zeros
        colors = output.render_colors.squeeze(0)
        keep(at_alpha, output.render_features.squeeze(0), output.render_alphas.squeeze(0), colors)
        if second is not None:
            keep([second], output.render_thermal_features.squeeze(0), output.render_thermal_alphas.squeeze(0))  # type: ignore[union-attr]
        rendered.note_call(SHARED, [*at_alpha, *([] if second is None else [second])], output.info)
    elif at_alpha:
        render_alone(at_alpha, gaussians.logit_opacities)
    for name in own_opacity:
        render_alone([name], gaussians.logits_in(name))
    return blended


def _blended_values(gaussians: Gaussians, view: "ViewTensors", rendering: Rendering) -> Tensor:
    """Features [N, d] or their coordinates [N, r], and log-depth and its square where depths are asked for.

    Where the set is divided over ranks, with log-depth in each rank's view, [W, N, ...].
    """
    if not rendering.blends_depth:
        return gaussians.features
    means = gaussians.means.detach() if rendering.geometry_held else gaussians.means
    if not rendering.distributed:
        return with_depth_moments(gaussians.features, means, view.viewmat)
    viewmats = tensors_of_all(view.viewmat.detach())
    return torch.stack([with_depth_moments(gaussians.features, means, viewmat) for viewmat in viewmats])


def _split_features(
    gaussians: Gaussians, image: Tensor, alpha: Tensor, rendering: Rendering, rendered: RenderedFrame
) -> tuple[Tensor, Tensor | None]:
    """Features [H, W, d] of an image of ``_blended_values``, and Σ w log z [H, W, 1]; the frame takes its spread."""
    if not rendering.blends_depth:
        return gaussians.expanded(image), None
    log_depth = image[..., -2:-1]
    if rendering.depth_spread_limit is None:
        return gaussians.expanded(image[..., :-2]), log_depth
    features, spread = features_and_spread(image, alpha, rendering.depth_spread_limit)
    rendered.depth_spreads.append(spread)
    return gaussians.expanded(features), log_depth
