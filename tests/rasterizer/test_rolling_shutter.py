"""Rolling shutters: images and gradients to both poses against plain torch, where rotations are quaternions."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import reference_lens_rasterizer
from gaussian_scenes import Scene, assert_matches_reference, random_scene
from thermosplat import RollingShutterType, rasterization

pytestmark = pytest.mark.rotating

DIRECTIONS = [kind for kind in RollingShutterType if kind is not RollingShutterType.GLOBAL]


def moved(base: Tensor, twists: Tensor) -> Tensor:
    """View matrices [C, 4, 4] turned and moved by twists [C, 6]: gradients to poses have no others than these."""
    x, y, z, *t = twists.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, t[0], z, zero, -x, t[1], -y, x, zero, t[2], zero, zero, zero, zero]
    return torch.linalg.matrix_exp(torch.stack(rows, -1).reshape(*x.shape, 4, 4)) @ base


def from_twists(render: Callable[..., Any], base: Tensor) -> Callable[..., Any]:
    """The renderer as a function of twists of its cameras at the beginning and at the end of the readout."""

    def call(begin: Tensor, end: Tensor, **scene: Any) -> Any:
        poses = base.to(begin)
        return render(**scene, viewmats=moved(poses, begin), viewmats_rs=moved(poses, end))

    return call


def rolling_scene(shutter: RollingShutterType, *, fast: float = 0.1, **arguments: Any) -> tuple[Scene, Tensor]:
    """Gaussians before cameras that turn and move during the readout, and the cameras."""
    scene = random_scene(**arguments)
    base = scene.pop("viewmats")
    u, _, vh = torch.linalg.svd(base[:, :3, :3])
    base[:, :3, :3] = u @ vh  # rotations to the last digit: a matrix and its quaternion agree on nothing else
    generator = torch.Generator().manual_seed(5)
    for name in ("begin", "end"):
        scene[name] = fast * torch.randn(len(base), 6, generator=generator).float().double()
    return scene | {"rolling_shutter": shutter}, base


def compare(scene: Scene, base: Tensor, device: torch.device, dtype: torch.dtype = torch.float64) -> dict[str, Any]:
    """Held against the reference; returns what the reference says of the call."""
    tolerances = {"image_tolerance": 1e-11, "gradient_tolerance": 1e-9}
    if dtype == torch.float32:
        tolerances = {"image_tolerance": 1e-5, "gradient_tolerance": 2e-5}
    ours = from_twists(rasterization, base)
    reference = from_twists(reference_lens_rasterizer.rasterization, base)
    _, (_, _, info) = assert_matches_reference(ours, scene, device, dtype, reference=reference, **tolerances)
    return info


@pytest.mark.parametrize("shutter", [DIRECTIONS[0], *(pytest.param(d, marks=pytest.mark.slow) for d in DIRECTIONS[1:])])
def test_images_and_gradients_in_double_precision(device: torch.device, shutter: RollingShutterType) -> None:
    """Two cameras with a lens each, spherical harmonics, every gradient; some Gaussians lie beyond the first line."""
    scene, base = rolling_scene(shutter, cameras=2, sh_degree=1)
    scene["radial_coeffs"] = torch.tensor([[-0.2, 0.05, 0.0, 0.0], [-0.1, 0.0, 0.0, 0.0]]).double()
    info = compare(scene, base, device)
    assert info["visible"].float().mean() > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("camera_model", ["ortho", "fisheye"])
def test_other_cameras(device: torch.device, camera_model: str) -> None:
    """Cameras without coefficients have rolling shutters too."""
    scene, base = rolling_scene(DIRECTIONS[2], camera_model="ortho" if camera_model == "ortho" else "pinhole")
    compare(scene | {"camera_model": camera_model}, base, device)


def test_single_precision_and_a_fast_turn(device: torch.device) -> None:
    """float32; in float64 a camera that turns by about 40 degrees."""
    scene, base = rolling_scene(DIRECTIONS[0])
    compare(scene, base, device, torch.float32)
    scene, base = rolling_scene(DIRECTIONS[0], fast=0.02)
    scene["end"][:, 2] = 0.7  # about the axis
    compare(scene, base, device)


def test_each_gaussian_is_seen_at_the_time_of_its_line() -> None:
    """A camera that moves sideways shears a column of points: at line y it has moved by (y - 0.5) / (H - 1)."""
    height, speed = 48, 0.5
    y = torch.linspace(-0.5, 0.5, 11, dtype=torch.float64)
    means = torch.stack([torch.zeros_like(y), y, torch.ones_like(y)], -1)
    begin = torch.eye(4, dtype=torch.float64)[None]
    end = begin.clone()
    end[0, 0, 3] = speed
    _, _, info = rasterization(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).double().expand(11, 4),
        torch.full((11, 3), 1e-4).double(),
        torch.ones(11).double(),
        torch.ones(11, 1).double(),
        begin,
        torch.tensor([[[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]]]).double(),
        64,
        height,
        packed=False,
        rolling_shutter=RollingShutterType.ROLLING_TOP_TO_BOTTOM,
        viewmats_rs=end,
    )
    lines = 40 * y + 24
    expected = torch.stack([40 * speed * (lines - 0.5) / (height - 1) + 32, lines], -1)
    torch.testing.assert_close(info["means2d"][0], expected, atol=1e-5, rtol=0)


def test_a_camera_that_stands_still_has_a_global_shutter(device: torch.device) -> None:
    """Two equal poses give the image of one, and finite gradients."""
    scene, base = rolling_scene(DIRECTIONS[1], fast=0.0)
    inputs = {key: x.to(device) if isinstance(x, Tensor) else x for key, x in scene.items()}
    still, _, _ = from_twists(rasterization, base)(**inputs)
    for name in ("begin", "end", "rolling_shutter"):
        inputs.pop(name)
    expected, _, _ = rasterization(**inputs, viewmats=base.to(device), with_ut=True)
    torch.testing.assert_close(still, expected, atol=1e-10, rtol=0)
    poses = [base.to(device, copy=True).requires_grad_() for _ in range(2)]
    shutter = RollingShutterType.ROLLING_TOP_TO_BOTTOM
    image, _, _ = rasterization(**inputs, viewmats=poses[0], viewmats_rs=poses[1], rolling_shutter=shutter)
    assert all(x.isfinite().all() and x.norm() > 0 for x in torch.autograd.grad(image.square().sum(), poses))


def test_what_moves_as_fast_as_the_readout_is_not_drawn() -> None:
    """A point that runs along with the lines is read by many of them, or by none."""
    begin = torch.eye(4, dtype=torch.float64)[None]
    end = begin.clone()
    end[0, 1, 3] = 47 / 40  # as many pixels as lines, at a distance of 1
    scene = {
        "means": torch.tensor([[0.0, -0.5, 1.0], [0.0, -0.5, 4.0]]).double(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).double().expand(2, 4),
        "scales": torch.full((2, 3), 1e-3).double(),
        "opacities": torch.ones(2).double(),
        "colors": torch.ones(2, 1).double(),
        "Ks": torch.tensor([[[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]]]).double(),
    }
    _, _, info = rasterization(
        **scene, viewmats=begin, width=64, height=48, rolling_shutter="ROLLING_TOP_TO_BOTTOM", viewmats_rs=end
    )
    assert info["visible"][0].tolist() == [False, True]
