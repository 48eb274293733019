"""A set of Gaussians seen from one view: what the renderer is told, and in which traversals features are blended."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from thermosplat.distributed.collectives import tensors_of_all
from thermosplat.fused.activations import activated
from thermosplat.fused.depth_spread import features_and_spread, with_depth_moments
from thermosplat.rasterizer import (
    LensArguments,
    RGBTRender,
    project,
    rasterization,
    rasterization_rgbt,
)
from thermosplat.rasterizer.lenses import RADIAL_COUNTS, TAKES
from thermosplat.rasterizer.median_depths import covered_depths
from thermosplat.scene.formations.formation import Blended
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.pixel_filter import PixelFilter
from thermosplat.scene.rendered_frame import RenderedFrame

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


Coefficients = tuple[Tensor, Tensor]
"""Spherical harmonics of degree 0 and of the others, [N, 1, 3] and [N, K-1, 3]."""


class Rendering(NamedTuple):
    """How a model renders now."""

    sh_degree: int
    """Highest degree of the spherical harmonics in use."""
    absgrad: bool
    """Also accumulate absolute means2d gradients."""
    pixel_filter: PixelFilter
    """How footprints are widened."""
    backgrounds: Tensor | None
    """Colour behind the SH colours of photographs, [1, 3]."""
    deterministic: bool = False
    geometry_held: bool = False
    """No gradient of this rasterization reaches means, quats, scales and opacities. ``render_view`` alone can do so."""
    depth_spread_limit: float | None = None
    """Also tell how far depths spread along rays, with this limit (``warp_depth_spread``); None: do not."""
    distributed: bool = False
    """The set is divided over ranks, each of which renders a view of its own now."""
    needs_depth: bool = False
    """Also blend depths, whether their spread is asked for or not."""

    @property
    def blends_depth(self) -> bool:
        """Whether depths are blended with features."""
        return self.needs_depth or self.depth_spread_limit is not None

    @property
    def background(self) -> Tensor | None:
        """Colour behind photographs, [3]; None: black."""
        return None if self.backgrounds is None else self.backgrounds[0]


def camera_arguments(view: "ViewTensors") -> dict[str, Any]:
    """What the rasterizer is told of a view's camera: pose, intrinsics, size, lens, and how its lines are read."""
    arguments = {"Ks": view.K[None], "width": view.width, "height": view.height, **_lens_arguments(view)}
    if view.readout is None:
        return {"viewmats": view.viewmat[None], **arguments}
    first, last = (view.readout @ view.viewmat).split(1)
    shutter = f"ROLLING_{view.line_order.replace('-', '_').upper()}"
    return {"viewmats": first, "viewmats_rs": last, "rolling_shutter": shutter, **arguments}


def projection_arguments(view: "ViewTensors") -> dict[str, Any]:
    """``camera_arguments`` as ``project`` takes them."""
    arguments = camera_arguments(view)
    of_lens = {name: arguments.pop(name) for name in LensArguments._fields if name in arguments}
    return {**arguments, "lens": LensArguments(**of_lens)}


def _lens_arguments(view: "ViewTensors") -> dict[str, Any]:
    """What the rasterizer is told of a view's lens: its camera model and coefficients, [1, n] each."""
    if view.lens is None and view.orthographic:
        return {"camera_model": "ortho"}
    if view.lens is None:
        return {"camera_model": "pinhole", "with_ut": view.unscented}
    coefficients = view.lens[None]
    arguments = {"camera_model": view.lens_model, "radial_coeffs": coefficients[:, : RADIAL_COUNTS[view.lens_model][0]]}
    if "tangential_coeffs" in TAKES[view.lens_model]:
        arguments["tangential_coeffs"] = coefficients[:, 6:]
    return arguments


def render_view(
    gaussians: Gaussians,
    colors: Tensor | Coefficients,
    logit_opacities: Tensor,
    view: "ViewTensors",
    rendering: Rendering,
    *,
    backgrounds: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """One image by one plain rasterization.

    Args:
        colors: Features [N, X], or spherical harmonics (X = 3).
        logit_opacities: Logits of either opacity of the set, [N].
        rendering: How; its background is not used.
        backgrounds: Colour behind the Gaussians, [1, X].

    Returns:
        Image [H, W, X], accumulated opacity [H, W, 1], and what the rasterization says about the call.
    """
    means: Tensor = gaussians.means
    quats: Tensor = gaussians.quats
    scales, opacities = _scales_and_opacities(gaussians, logit_opacities)
    if rendering.geometry_held:
        means, quats, scales, opacities = (values.detach() for values in (means, quats, scales, opacities))
    image, alpha, info = rasterization(
        means,
        quats,
        scales,
        opacities,
        colors,
        sh_degree=None if isinstance(colors, Tensor) else rendering.sh_degree,
        packed=False,
        backgrounds=backgrounds,
        absgrad=rendering.absgrad,
        **rendering.pixel_filter._asdict(),
        **camera_arguments(view),
        deterministic=rendering.deterministic,
        distributed=rendering.distributed,
    )
    return image.squeeze(0), alpha.squeeze(0), info  # [0] would have its gradient copied into zeros


@torch.no_grad()
def render_view_surface(
    gaussians: Gaussians, logit_opacities: Tensor, view: "ViewTensors", rendering: Rendering
) -> tuple[Tensor, Tensor]:
    """Median z-depth [world units], 0 where nothing is drawn, and where a half is covered (``covered_depths``), [H, W].

    Args:
        logit_opacities: Logits of either opacity of the set, [N].
    """
    scales, opacities = _scales_and_opacities(gaussians, logit_opacities)
    means: Tensor = gaussians.means
    quats: Tensor = gaussians.quats
    how = {**rendering.pixel_filter._asdict(), **projection_arguments(view), "distributed": rendering.distributed}
    tile = 16 if means.is_cuda else 8  # a pixel of 8 px tiles passes over half as many Gaussians; benchmarks/records
    depth, covered = covered_depths(project(means, quats, scales, opacities, tile_size=tile, **how))
    return depth.squeeze(0), covered.squeeze(0)


def render_view_depth(
    gaussians: Gaussians, logit_opacities: Tensor, view: "ViewTensors", rendering: Rendering
) -> Tensor:
    """Mean z-depth Σ w z / Σ w [world units], [H, W]; 0 where nothing is drawn. Differentiable.

    Args:
        logit_opacities: Logits of either opacity of the set, [N].
    """
    scales, opacities = _scales_and_opacities(gaussians, logit_opacities)
    means: Tensor = gaussians.means
    quats: Tensor = gaussians.quats
    depth, _, _ = rasterization(
        means,
        quats,
        scales,
        opacities,
        opacities[:, None],  # not drawn
        packed=False,
        render_mode="ED",
        **rendering.pixel_filter._asdict(),
        **camera_arguments(view),
        deterministic=rendering.deterministic,
        distributed=rendering.distributed,
    )
    return depth[0, ..., 0]


def render_two_opacities(
    gaussians: Gaussians,
    second: str | None,
    features: Tensor | Coefficients,
    view: "ViewTensors",
    rendering: Rendering,
) -> RGBTRender:
    """SH colours and features at α, and the features at a second opacity where asked, in one traversal.

    Args:
        second: Spectrum at whose opacity the features are rendered too; None: at α alone.
        features: Features [N, d], or a second spectrum's spherical harmonics (d = 3).
    """
    second_opacities: Tensor | None = None
    if second is not None:
        scales, opacities, second_opacities = _scales_and_both_opacities(gaussians, second)
    else:
        scales, opacities = _scales_and_opacities(gaussians, gaussians.logit_opacities)
    return rasterization_rgbt(
        gaussians.means,
        gaussians.quats,
        scales,
        opacities,
        second_opacities,
        gaussians.sh_coeffs,
        features,
        sh_degree=rendering.sh_degree,
        features_sh_degree=None if isinstance(features, Tensor) else rendering.sh_degree,
        backgrounds=rendering.backgrounds,
        absgrad=rendering.absgrad,
        **rendering.pixel_filter._asdict(),
        **camera_arguments(view),
        deterministic=rendering.deterministic,
        distributed=rendering.distributed,
    )


def _scales_and_opacities(gaussians: Gaussians, logit_opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Scales [N, 3], and the opacities [N] of those logits."""
    if not activated_by_one_kernel(gaussians):
        return gaussians.scales, torch.sigmoid(logit_opacities)
    scales, opacities, _ = activated(gaussians.log_scales, logit_opacities)
    return scales, opacities


def _scales_and_both_opacities(gaussians: Gaussians, second: str) -> tuple[Tensor, Tensor, Tensor]:
    """Scales [N, 3], α [N] and the opacities [N] in a spectrum."""
    if not activated_by_one_kernel(gaussians):
        return gaussians.scales, gaussians.opacities, gaussians.opacities_in(second)
    stored = gaussians.log_scales, gaussians.logit_opacities, *gaussians.stored_opacity(second)
    scales, opacities, second_opacities = activated(*stored)
    return scales, opacities, opacities if second_opacities is None else second_opacities


def activated_by_one_kernel(gaussians: Gaussians) -> bool:
    """On CUDA, where each of torch's kernels takes longer to start than to run; on the CPU torch's are vectorised."""
    return gaussians.means.is_cuda


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
        photograph: The one of them that takes SH colours; None: none does.
        rendered: Takes the spreads of depths, and what rasterizations say about their calls.
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
            note_call(rendered, SHARED, seen_by, info)

    if photograph is not None:
        second = own_opacity.pop(0) if own_opacity else None
        output = render_two_opacities(gaussians, second, values, view, rendering)
        # squeeze, not [0], whose gradient would be copied into zeros
        colors = output.render_colors.squeeze(0)
        keep(at_alpha, output.render_features.squeeze(0), output.render_alphas.squeeze(0), colors)
        if second is not None:
            keep([second], output.render_thermal_features.squeeze(0), output.render_thermal_alphas.squeeze(0))  # type: ignore[union-attr]
        note_call(rendered, SHARED, [*at_alpha, *([] if second is None else [second])], output.info)
    elif at_alpha:
        render_alone(at_alpha, gaussians.logit_opacities)
    for name in own_opacity:
        render_alone([name], gaussians.logits_in(name))
    return blended


def note_call(rendered: RenderedFrame, gaussian_set: str, spectra: Sequence[str], info: dict[str, Any]) -> None:
    """Keep in the frame what the rasterization says about a call of a set for some spectra."""
    info["spectra"] = tuple(spectra)
    rendered.infos.setdefault(gaussian_set, []).append(info)


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
