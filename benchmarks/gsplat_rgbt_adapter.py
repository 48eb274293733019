"""The same model and losses on gsplat's rasterizer, as its user would write them: a step launched line by line.

gsplat blends any number of channels at one opacity, so a frame of both spectra takes two calls: colours and features at
α, then the features at α_t. Decoders and losses are PyTorch's and kornia's in float32, and each parameter has torch's
fused Adam, as in gsplat's own trainer.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any, NamedTuple

import torch
from torch import Tensor

from thermosplat import gaussian_views, losses
from thermosplat.config import TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.losses import frame_losses
from thermosplat.model import SceneModel
from thermosplat.rasterizer import RGBTRender


class Gsplat(NamedTuple):
    """gsplat's functions.

    Attributes:
        description: version and kind.
        rasterization: ``gsplat.rasterization``.
        spherical_harmonics: ``gsplat.spherical_harmonics``.
        options: for every call of ``rasterization``.
    """

    description: str
    rasterization: Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
    spherical_harmonics: Callable[[int, Tensor, Tensor], Tensor]
    options: dict[str, Any]


class GsplatTraining:
    """Steps of the same model on gsplat's rasterizer. Its rates are 0, so all steps find the same Gaussians.

    Args:
        model: The scene; it is trained.
        config: Weights of the losses and Adam's ε.
        sh_degree: Degree of the spherical harmonics in use.
        gsplat: The rasterizer.
    """

    def __init__(self, model: SceneModel, config: TrainConfig, sh_degree: int, gsplat: Gsplat) -> None:
        self.model = model
        self.config = config
        self.sh_degree = sh_degree
        self.gsplat = gsplat
        parameters = [parameter for parameter in model.parameters() if parameter.numel() > 0]
        eps = config.optimizer.eps
        self.optimizers = [torch.optim.Adam([parameter], lr=0.0, eps=eps, fused=True) for parameter in parameters]

    def losses(self, frame: FrameTensors) -> dict[str, Tensor]:
        """Weighted loss terms of a frame.

        Args:
            frame: Views of both spectra of one camera.
        """
        with _rendered_by(self.gsplat):
            rendered = self.model.render(frame.rgb, frame.thermal, sh_degree=self.sh_degree, aligned=True)
            return frame_losses(rendered, frame, self.config.loss)

    def step(self, frame: FrameTensors) -> None:
        """One training step.

        Args:
            frame: As for :meth:`losses`.
        """
        torch.stack(list(self.losses(frame).values())).sum().backward()
        for optimizer in self.optimizers:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)


@contextmanager
def _rendered_by(gsplat: Gsplat) -> Iterator[None]:
    """While open, models are rendered by gsplat, and images are compared by kornia's filters on every device."""
    saved = gaussian_views.rasterization_rgbt, losses._fused
    gaussian_views.rasterization_rgbt, losses._fused = _two_calls(gsplat), losses._filtered
    try:
        yield
    finally:
        gaussian_views.rasterization_rgbt, losses._fused = saved


def _two_calls(gsplat: Gsplat) -> Callable[..., RGBTRender]:
    """``rasterization_rgbt`` for one camera by gsplat's functions."""

    def rasterization_rgbt(
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        thermal_opacities: Tensor | None,
        colors: tuple[Tensor, Tensor],
        features: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        *,
        sh_degree: int,
        backgrounds: Tensor | None,
        rasterize_mode: str,
        **_: Any,  # absgrad and determinism, of no use here
    ) -> RGBTRender:
        camera = {"viewmats": viewmats, "Ks": Ks, "width": width, "height": height, "rasterize_mode": rasterize_mode}
        position = -viewmats[0, :3, :3].T @ viewmats[0, :3, 3]
        rgb = (gsplat.spherical_harmonics(sh_degree, means - position, torch.cat(colors, 1)) + 0.5).clamp(min=0.0)
        images, alphas, info = gsplat.rasterization(
            means, quats, scales, opacities, torch.cat([rgb, features], -1), **camera, **gsplat.options
        )
        image, rendered_features = images.split([3, features.shape[-1]], -1)
        if backgrounds is not None:  # behind the colours alone
            image = image + (1.0 - alphas) * backgrounds[:, None, None, :]
        thermal = thermal_alphas = None
        if thermal_opacities is not None:
            thermal, thermal_alphas, _ = gsplat.rasterization(
                means, quats, scales, thermal_opacities, features, **camera, **gsplat.options
            )
        return RGBTRender(image, rendered_features, thermal, alphas, thermal_alphas, info)

    return rasterization_rgbt


def find_gsplat(device: torch.device, oracle: str | None) -> Gsplat | None:
    """gsplat, or None where it cannot be imported, which is said.

    Args:
        device: On CUDA gsplat's kernels, which it compiles on their first use; on the CPU its torch reference.
        oracle: Folder of ``gsplat_oracle.py``, which makes that reference run without CUDA (README.md).
    """
    try:
        if device.type == "cuda":
            import gsplat

            description = f"gsplat {version('gsplat')}, CUDA kernels"
            return Gsplat(description, gsplat.rasterization, gsplat.spherical_harmonics, {"packed": False})
        if oracle is not None:
            sys.path.insert(0, oracle)
        import gsplat_oracle

        rasterization = gsplat_oracle.install()
        from gsplat.rendering import spherical_harmonics
    except ImportError as error:
        print(f"gsplat is not importable ({error}); it is left out", flush=True)
        return None
    return Gsplat(f"gsplat {version('gsplat')}, torch reference", rasterization, spherical_harmonics, {})
