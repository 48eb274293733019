"""gsplat's rasterizer in place of ours: the same model, losses and optimizers, with one of its calls per opacity."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from thermosplat.rasterizer import RGBTRender
from thermosplat.scene import views as gaussian_views

Colors = Tensor | tuple[Tensor, Tensor]
Call = Callable[..., Any]


@contextmanager
def gsplat_rasterization(rasterization: Call, spherical_harmonics: Call) -> Iterator[None]:
    """While open, models are rendered by gsplat.

    Args:
        rasterization: ``gsplat.rasterization``.
        spherical_harmonics: ``gsplat.spherical_harmonics``.
    """

    def plain(*arguments: Any, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        means, quats, scales, opacities, colors = arguments
        options.pop("deterministic")  # gsplat has no such option
        return rasterization(means, quats, scales, opacities, _joined(colors), **options)

    def rgbt(*arguments: Any, **options: Any) -> RGBTRender:
        means, quats, scales, opacities, thermal_opacities, colors, features = arguments
        options.pop("deterministic")
        backgrounds = options.pop("backgrounds")
        degrees = options.pop("sh_degree"), options.pop("features_sh_degree")

        def evaluated(values: Any, degree: int | None) -> Tensor:
            """Colours [N, X] as the one camera sees them; gsplat cannot join SH and plain channels in one call."""
            if degree is None:
                return values
            viewmat = options["viewmats"][0]
            directions = means + viewmat[:3, :3].T @ viewmat[:3, 3]
            return (spherical_harmonics(degree, directions, _joined(values)) + 0.5).clamp(min=0.0)

        columns = [evaluated(values, degree) for values, degree in zip((colors, features), degrees, strict=True)]
        options["packed"] = False
        shape = means, quats, scales
        images, alphas, info = rasterization(*shape, opacities, torch.cat(columns, -1), **options)
        image, rendered_features = images.split([column.shape[-1] for column in columns], -1)
        if backgrounds is not None:  # behind the colours alone
            image = image + (1.0 - alphas) * backgrounds[:, None, None, :]
        thermal = thermal_alphas = None
        if thermal_opacities is not None:
            thermal, thermal_alphas, _ = rasterization(*shape, thermal_opacities, columns[1], **options)
        return RGBTRender(image, rendered_features, thermal, alphas, thermal_alphas, info)

    with patch.multiple(gaussian_views, rasterization=plain, rasterization_rgbt=rgbt):
        yield


def _joined(colors: Colors) -> Tensor:
    """Spherical harmonics as gsplat takes them, in one tensor [N, K, 3]."""
    return torch.cat(colors, -2) if isinstance(colors, tuple) else colors
