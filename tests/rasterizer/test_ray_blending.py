"""with_eval3d: distances, normals and colours along rays against dense float64 torch, with all gradients."""

from typing import Any

import pytest
import torch
from torch import Tensor

import reference_rays
from gaussian_scenes import gradients, leaves, random_scene, relative_error, upstream_gradients
from thermosplat import UserError, rasterization

pytestmark = pytest.mark.rotating

DTYPES = [torch.float32, torch.float64]


def images_of(mode: str, result: tuple[Tensor, Tensor, dict[str, Any]], normals: bool) -> list[Tensor]:
    """The images of a call, expected distances times their weights."""
    image, alphas, info = result
    if "E" in mode:
        image = torch.cat([image[..., :-1], image[..., -1:] * alphas.detach()], -1)
    return [image, alphas, *([info["normals"]] if normals else [])]


def true_images(mode: str, found: dict[str, Tensor], normals: bool) -> list[Tensor]:
    """The same of the reference; expected distances have the weights that the renderer's are multiplied with."""
    parts = [found["colors"]] if "RGB" in mode else []
    if mode not in ("RGB",):
        depth = found["hits" if mode.endswith("d") else "depths"]
        if "E" in mode:
            depth = depth / found["alphas"].clamp(min=1e-10) * found["alphas"].detach()
        parts.append(depth)
    return [torch.cat(parts, -1), found["alphas"], *([found["normals"]] if normals else [])]


def assert_matches(scene: dict[str, Any], device: torch.device, dtype: torch.dtype, mode: str, normals: bool) -> None:
    """Images and every gradient are the reference's."""
    inputs, truth = leaves(scene, device, dtype), leaves(scene, "cpu", torch.float64)
    result = rasterization(**inputs, with_eval3d=True, render_mode=mode, return_normals=normals)
    reference = reference_rays.rasterization(result[2], **truth)
    certain = ~reference.pop("uncertain")[..., 0].bool()
    assert certain.float().mean() > 0.75
    ours, theirs = images_of(mode, result, normals), true_images(mode, reference, normals)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-11
    for one, other in zip(ours, theirs, strict=True):
        assert one.shape == other.shape
        error = (one.double().cpu() - other).abs()[certain]
        assert error.max() <= tolerance * max(1.0, float(other.detach().abs().max()))
    upstream = upstream_gradients(theirs, certain)
    found, expected = gradients(ours, upstream, inputs), gradients(theirs, upstream, truth)
    limit = 1e-4 if dtype == torch.float32 else 1e-9
    errors = {name: relative_error(found[name], expected[name]) for name in found}
    assert all(error <= limit for error in errors.values()), errors


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mode", ["RGB", "d", "Ed", "RGB-d", "RGB-Ed", "RGB+D"])
def test_render_modes_along_rays(device: torch.device, mode: str, dtype: torch.dtype) -> None:
    """Colours, distances along rays and depths, two cameras, with normals where there are distances."""
    scene = random_scene(n=12, cameras=2, width=9, height=7, tile_size=8, seed=2, backgrounds="RGB" in mode)
    assert_matches(scene, device, dtype, mode, normals=mode.endswith("d"))


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
def test_cameras_and_harmonics(device: torch.device, camera_model: str) -> None:
    """Rays of both camera models; colours of spherical harmonics."""
    scene = random_scene(n=12, width=9, height=7, sh_degree=2, camera_model=camera_model)
    assert_matches(scene, device, torch.float64, "RGB-d", normals=True)


def test_crowded_pixels_and_needles(device: torch.device) -> None:
    """Opaque Gaussians end pixels and clamp alpha; thin ones are crossed along and across."""
    scene = random_scene(n=60, width=9, height=7, seed=5)
    scene["opacities"][:] = 0.5 + 0.5 * scene["opacities"]
    scene["opacities"][::5] = 1.0
    scene["scales"][:, 0] *= 0.05
    scene["scales"][::2, 2] *= 5.0
    assert_matches(scene, device, torch.float64, "RGB-d", normals=True)


def test_rays_of_ones_own(device: torch.device) -> None:
    """Given rays are used as they are, have any length, and receive gradients."""
    scene = random_scene(n=12, width=9, height=7)
    generator = torch.Generator().manual_seed(1)
    rays = reference_rays.rays_of(scene["viewmats"][0], scene["Ks"][0], 9, 7, "pinhole")
    rays = rays + 0.05 * torch.randn(rays.shape, generator=generator).double()
    scene["rays"] = (rays[None]).float().double()
    assert_matches(scene, device, torch.float64, "RGB-d", normals=True)


def test_more_channels_than_one_traversal_blends(device: torch.device) -> None:
    """Chunks of channels are one image; distances are blended once."""
    scene = random_scene(n=12, width=9, height=7, channels=7, channel_chunk=3)
    assert_matches(scene, device, torch.float64, "RGB-Ed", normals=False)


def test_leading_dimensions_are_calls_side_by_side(device: torch.device) -> None:
    """Leading dimensions are calls side by side."""
    scene = leaves(random_scene(n=10, batch=(2,), cameras=2, width=9, height=7), device, torch.float64)
    whole = rasterization(**scene, with_eval3d=True, return_normals=True, render_mode="RGB-d")
    for k in range(2):
        part = {name: one[k] if isinstance(one, Tensor) else one for name, one in scene.items()}
        image, _, info = rasterization(**part, with_eval3d=True, return_normals=True, render_mode="RGB-d")
        torch.testing.assert_close(whole[0][k], image)
        torch.testing.assert_close(whole[2]["normals"][k], info["normals"])


def test_a_plane_is_hit_where_it_is(device: torch.device) -> None:
    """A flat, opaque Gaussian across the axis: distances are those of the plane, its normal faces the camera."""
    n, size = 1, 9
    K = torch.tensor([[[6.0, 0, 4.5], [0, 6.0, 4.5], [0, 0, 1]]], device=device)
    _, alphas, info = result = rasterization(
        torch.tensor([[0.0, 0.0, 3.0]], device=device), torch.tensor([[1.0, 0, 0, 0]], device=device),
        torch.tensor([[50.0, 50.0, 1e-3]], device=device), torch.ones(n, device=device), None,
        torch.eye(4, device=device)[None], K, size, size, render_mode="Ed", with_eval3d=True, return_normals=True,
    )  # fmt: skip
    across = (torch.arange(size, device=device) + 0.5 - 4.5) / 6.0
    length = (1 + across[:, None] ** 2 + across[None] ** 2).sqrt()
    torch.testing.assert_close(result[0][0, ..., 0], 3.0 * length, rtol=1e-4, atol=0.0)
    facing = torch.tensor([0.0, 0.0, -1.0], device=device)
    torch.testing.assert_close(info["normals"][0], alphas[0] * facing)


def test_degenerate_gaussians_stay_out(device: torch.device) -> None:
    """Scales of zero, quaternions of zero, NaN, the camera inside: finite images and gradients."""
    scene = leaves(random_scene(n=20, width=9, height=7), device, torch.float32)
    with torch.no_grad():
        scene["scales"][0] = 0.0
        scene["scales"][1, 2] = 0.0
        scene["quats"][2] = 0.0
        scene["means"][3] = torch.nan
        scene["quats"][4] = torch.inf
        scene["means"][5] = torch.tensor([0.0, 0.0, -3.9], device=device)
        scene["scales"][5] = 3.0
    image, alphas, info = rasterization(**scene, with_eval3d=True, return_normals=True, render_mode="RGB-d")
    (image.sum() + alphas.sum() + info["normals"].square().sum()).backward()
    assert image.isfinite().all()
    for name in ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"):
        assert scene[name].grad.isfinite().all(), name


def test_nothing_to_draw(device: torch.device) -> None:
    """Everything behind the camera: backgrounds, zeros, and gradients of zero."""
    scene = random_scene(n=3, width=9, height=7)
    scene["means"][:, 2] = -50.0
    inputs = leaves(scene, device, torch.float32)
    image, alphas, info = rasterization(**inputs, with_eval3d=True, return_normals=True, render_mode="RGB-Ed")
    assert torch.equal(image[..., :3], inputs["backgrounds"][:, None, None].expand_as(image[..., :3]))
    assert not alphas.any()
    assert not image[..., 3].any()
    assert not info["normals"].any()
    image.sum().backward()
    assert not inputs["means"].grad.any()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"render_mode": "RGB-d"}, "render_mode='RGB-d' needs with_eval3d=True"),
        ({"return_normals": True}, "return_normals needs with_eval3d=True"),
        ({"rays": torch.zeros(1, 7, 9, 6)}, "rays needs with_eval3d=True"),
        ({"with_eval3d": True, "absgrad": True}, "absgrad does not go with with_eval3d=True"),
        ({"with_eval3d": True, "rasterize_mode": "antialiased"}, "rasterize_mode='antialiased' does not go with"),
        ({"with_eval3d": True, "sparse_grad": True}, "sparse_grad does not go with with_eval3d=True"),
        ({"with_eval3d": True, "camera_model": "fisheye"}, "a lens or a rolling shutter without rays does not go"),
        ({"with_eval3d": True, "rays": torch.zeros(1, 7, 9, 5)}, "rays must have shape"),
    ],
)
def test_what_does_not_go_together_is_told(changes: dict[str, Any], said: str) -> None:
    """One sentence that names the argument."""
    scene = leaves(random_scene(n=4, width=9, height=7), "cpu", torch.float32)
    with pytest.raises(UserError, match=said):
        rasterization(**scene | changes)
