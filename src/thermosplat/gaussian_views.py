"""A set of Gaussians seen from one view: the renderer's functions for ``Gaussians`` and ``ViewTensors``."""

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from torch import Tensor

from thermosplat.gaussians import Gaussians
from thermosplat.rasterizer import RGBTRender, rasterization, rasterization_rgbt

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
    rasterize_mode: Literal["classic", "antialiased"]
    """As gsplat's."""
    backgrounds: Tensor | None
    """Colour behind the visible SH colours, [1, 3]."""
    deterministic: bool = False
    """As the rasterizer's."""


def see(
    gaussians: Gaussians,
    colors: Tensor | Coefficients,
    opacities: Tensor,
    view: "ViewTensors",
    rendering: Rendering,
    *,
    backgrounds: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """One image by one plain rasterization.

    Args:
        gaussians: The set.
        colors: Features [N, X], or spherical harmonics (X = 3).
        opacities: Either opacity of the set, [N].
        view: Camera and pose.
        rendering: How; its background is not used.
        backgrounds: Colour behind the Gaussians, [1, X].

    Returns:
        Image [H, W, X], accumulated opacity [H, W, 1], and what the rasterization says about the call.
    """
    image, alpha, info = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        opacities,
        colors,
        view.viewmat[None],
        view.K[None],
        view.width,
        view.height,
        sh_degree=None if isinstance(colors, Tensor) else rendering.sh_degree,
        packed=False,
        backgrounds=backgrounds,
        absgrad=rendering.absgrad,
        rasterize_mode=rendering.rasterize_mode,
        deterministic=rendering.deterministic,
    )
    return image.squeeze(0), alpha.squeeze(0), info  # [0] would have its gradient copied into zeros


def see_depth(gaussians: Gaussians, opacities: Tensor, view: "ViewTensors", rendering: Rendering) -> Tensor:
    """Expected z-depth Σ w z / Σ w [world units], [H, W]; 0 where nothing is drawn.

    Args:
        gaussians: The set.
        opacities: Either opacity of the set, [N].
        view: Camera and pose.
        rendering: How.
    """
    depth, _, _ = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        opacities,
        opacities[:, None],  # not drawn
        view.viewmat[None],
        view.K[None],
        view.width,
        view.height,
        packed=False,
        render_mode="ED",
        rasterize_mode=rendering.rasterize_mode,
        deterministic=rendering.deterministic,
    )
    return depth[0, ..., 0]


def see_both(
    gaussians: Gaussians,
    thermal_opacities: Tensor | None,
    features: Tensor | Coefficients,
    view: "ViewTensors",
    rendering: Rendering,
) -> RGBTRender:
    """SH colours and features at α, and the features at α_t where there are thermal opacities, in one traversal.

    Args:
        gaussians: The set.
        thermal_opacities: α_t, [N], or None.
        features: Features [N, d], or a second spectrum's spherical harmonics (d = 3).
        view: Camera and pose.
        rendering: How.
    """
    return rasterization_rgbt(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        thermal_opacities,
        gaussians.sh_coeffs,
        features,
        view.viewmat[None],
        view.K[None],
        view.width,
        view.height,
        sh_degree=rendering.sh_degree,
        features_sh_degree=None if isinstance(features, Tensor) else rendering.sh_degree,
        backgrounds=rendering.backgrounds,
        absgrad=rendering.absgrad,
        rasterize_mode=rendering.rasterize_mode,
        deterministic=rendering.deterministic,
    )
