"""Small random scenes, and the comparison of a renderer with the dense reference on them."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

import reference_rasterizer

Scene = dict[str, Any]  # keyword arguments of rasterization


def random_scene(
    *,
    n: int = 60,
    cameras: int = 1,
    channels: int = 3,
    sh_degree: int | None = None,
    width: int = 23,
    height: int = 18,
    batch: Sequence[int] = (),
    per_camera_colors: bool = False,
    with_covars: bool = False,
    backgrounds: bool = True,
    camera_model: str = "pinhole",
    seed: int = 0,
    **arguments: Any,
) -> Scene:
    """Gaussians around the origin seen by cameras about 4 units away, as float64 that float32 holds exactly."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*batch, *shape, generator=generator).double()

    def normal(*shape: int) -> Tensor:
        return torch.randn(*batch, *shape, generator=generator).double()

    turn = 0.2 * normal(cameras, 3, 3)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(*batch, cameras, 1, 1)
    viewmats[..., :3, :3] = torch.linalg.matrix_exp(turn - turn.transpose(-1, -2))
    viewmats[..., :3, 3] = torch.tensor([0.0, 0.0, 4.0]) + 0.1 * normal(cameras, 3)
    focal = 1.25 * width if camera_model == "pinhole" else 0.4 * width
    intrinsics = torch.tensor([[focal, 0, 0.52 * width], [0, 0.93 * focal, 0.48 * height], [0, 0, 1]])
    color_shape = (channels,) if sh_degree is None else ((sh_degree + 1) ** 2, 3)
    color_lead = (cameras, n) if per_camera_colors else (n,)
    scene: Scene = {
        "means": normal(n, 3) * torch.tensor([1.0, 0.75, 0.625]),
        "quats": normal(n, 4),
        "scales": 0.05 + 0.3 * uniform(n, 3),
        "opacities": 0.01 + 0.98 * uniform(n),
        "colors": 0.3 * normal(*color_lead, *color_shape) if sh_degree is not None else uniform(*color_lead, channels),
        "viewmats": viewmats,
        "Ks": intrinsics.double().repeat(*batch, cameras, 1, 1),
        "width": width,
        "height": height,
        "camera_model": camera_model,
        "sh_degree": sh_degree,
        **arguments,
    }
    if backgrounds:
        scene["backgrounds"] = uniform(cameras, channels if sh_degree is None else 3)
    if with_covars:
        root = 0.2 * normal(n, 3, 3)
        scene["covars"] = root @ root.transpose(-1, -2) + 0.002 * torch.eye(3)
        scene["quats"] = scene["scales"] = None
    return {key: value.float().double() if isinstance(value, Tensor) else value for key, value in scene.items()}


def random_rgbt_scene(*, features: int = 8, **arguments: Any) -> Scene:
    """The same for rasterization_rgbt: features and a second opacity, some larger, some smaller than the first."""
    scene = random_scene(**arguments)
    generator = torch.Generator().manual_seed(1000 + arguments.get("seed", 0))
    shape = scene["means"].shape[:-1]
    scene["features"] = 2.0 * torch.rand(*shape, features, generator=generator).double() - 1.0
    logits = torch.logit(scene["opacities"]) + torch.randn(shape, generator=generator)
    scene["thermal_opacities"] = torch.sigmoid(logits).float().double()
    return scene


def leaves(scene: Scene, device: torch.device | str, dtype: torch.dtype) -> Scene:
    """A copy on the device, in the dtype, whose tensors collect gradients."""
    return {
        key: value.detach().to(device, dtype, copy=True).requires_grad_() if isinstance(value, Tensor) else value
        for key, value in scene.items()
    }


def upstream_gradients(images: Sequence[Tensor], certain: Tensor, seed: int = 7) -> list[Tensor]:
    """Random gradients of the loss with respect to each image, zero at the uncertain pixels."""
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(image.shape, generator=generator).double() * certain[..., None] for image in images]


def gradients(images: Sequence[Tensor], upstream: Sequence[Tensor], scene: Scene) -> dict[str, Tensor]:
    """Gradient of <images, upstream> for every tensor of the scene; None becomes zeros."""
    names = [key for key, value in scene.items() if isinstance(value, Tensor)]
    loss = sum((image * up.to(image)).sum() for image, up in zip(images, upstream, strict=True))
    found = torch.autograd.grad(loss, [scene[name] for name in names], allow_unused=True)  # type: ignore[arg-type]
    return {
        name: torch.zeros(scene[name].shape, dtype=torch.float64) if grad is None else grad.double().cpu()
        for name, grad in zip(names, found, strict=True)
    }


def relative_error(value: Tensor, truth: Tensor) -> float:
    """|value - truth| / |truth| in the Euclidean norm; absolute where the truth is zero."""
    scale = truth.norm()
    return float((value - truth).norm() / (scale if scale > 0 else 1.0))


def assert_matches_reference(
    render: Callable[..., Any],
    scene: Scene,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
    *,
    image_tolerance: float | None = None,
    gradient_tolerance: float | None = None,
    rgbt: bool = False,
) -> tuple[Any, Any]:
    """Images within 2e-6 and every gradient within 1e-5 of the float64 reference (1e-12, 1e-11 in float64).

    Depths are compared in units of the scene's largest depth, and expected depths and their loss weighted by the
    pixel's alpha: 1 - T has a rounding error of its own that a division by a small alpha would only enlarge.
    """
    single = dtype == torch.float32
    image_tolerance = image_tolerance or (2e-6 if single else 1e-12)
    gradient_tolerance = gradient_tolerance or (1e-5 if single else 1e-11)
    reference = reference_rasterizer.rasterization_rgbt if rgbt else reference_rasterizer.rasterization
    count = 5 if rgbt else 2
    true_scene = leaves(scene, "cpu", torch.float64)
    true_result = reference(**true_scene)
    test_scene = leaves(scene, device, dtype)
    result = render(**test_scene)
    true_images, images = list(true_result[:count]), list(result[:count])
    certain = ~true_result[-1]["uncertain"]
    assert certain.float().mean() > 0.75, "the scene has too many pixels on a threshold to say much"

    units = [torch.ones(image.shape[-1], dtype=torch.float64) for image in true_images]
    mode = scene.get("render_mode", "RGB")
    if "D" in mode:
        units[0][-1] = true_result[-1]["depths"].detach().abs().max().clamp(min=1.0)
    if "ED" in mode:
        weight = torch.ones_like(true_images[0].detach())
        weight[..., -1:] = true_images[1].detach()
        true_images[0], images[0] = true_images[0] * weight, images[0] * weight.to(images[0])

    for image, truth, unit in zip(images, true_images, units, strict=True):
        assert image.shape == truth.shape
        assert image.dtype == dtype
        assert torch.isfinite(image).all()
        error = ((image.double().cpu() - truth) / unit).detach().abs()[certain]
        assert error.max() <= image_tolerance, f"image off by {error.max().item():.2e}"
    upstream = [up / unit for up, unit in zip(upstream_gradients(true_images, certain), units, strict=True)]
    true_gradients = gradients(true_images, upstream, true_scene)
    found = gradients(images, upstream, test_scene)
    errors = {name: relative_error(found[name], true_gradients[name]) for name in found}
    wrong = {name: f"{error:.2e}" for name, error in errors.items() if not error <= gradient_tolerance}
    assert not wrong, f"relative gradient errors above {gradient_tolerance:.0e}: {wrong}"
    return result, true_result


def assert_finite(
    render: Callable[..., Any], scene: Scene, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Tensor:
    """Images and all gradients are finite; returns the colours."""
    inputs = leaves(scene, device, dtype)
    image, alphas, _ = render(**inputs)
    assert torch.isfinite(image).all()
    assert torch.isfinite(alphas).all()
    upstream = upstream_gradients([image, alphas], torch.ones(alphas.shape[:-1]))
    for name, gradient in gradients([image, alphas], upstream, inputs).items():
        assert torch.isfinite(gradient).all(), name
    return image.detach()


def gsplat_training(
    scene: Scene, device: torch.device | str
) -> tuple[torch.nn.ParameterDict, dict[str, torch.optim.Adam]]:
    """A scene's Gaussians as gsplat's densification strategies take them: stored parameters, an optimizer for each."""
    params = torch.nn.ParameterDict(
        {
            "means": scene["means"].float(),
            "scales": scene["scales"].float().log(),
            "quats": scene["quats"].float(),
            "opacities": torch.logit(scene["opacities"].float()),
            "colors": scene["colors"].float(),
        }
    ).to(device)
    return params, {name: torch.optim.Adam([{"params": value, "lr": 1e-2}]) for name, value in params.items()}
