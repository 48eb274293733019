"""Gaussians that break rasterizers: finite everywhere, and the reference's picture wherever that is defined."""

import pytest
import torch

import reference_rasterizer
from gaussian_scenes import (
    assert_finite,
    assert_matches_reference,
    gradients,
    leaves,
    random_rgbt_scene,
    random_scene,
    relative_error,
    upstream_gradients,
)
from thermosplat import rasterization, rasterization_rgbt

RASTERIZE_MODES = ["classic", "antialiased"]
DTYPES = [torch.float32, torch.float64]
PER_GAUSSIAN = ("means", "quats", "scales", "opacities", "colors", "features", "thermal_opacities", "covars")


def thin_tolerances(rasterize_mode: str, dtype: torch.dtype) -> dict[str, float]:
    """The compensation of a thin Gaussian is the root of xx * yy - xy * xy, which cancels in any renderer."""
    if rasterize_mode == "classic":
        return {}
    if dtype == torch.float32:
        return {"image_tolerance": 1e-5, "gradient_tolerance": 1e-4}
    return {"image_tolerance": 1e-7, "gradient_tolerance": 1e-5}


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
def test_zero_quaternion_is_the_identity(device: torch.device, rasterize_mode: str) -> None:
    """No rotation, no gradient to the quaternion, everything else as usual."""
    scene = random_scene(n=20, rasterize_mode=rasterize_mode)
    scene["quats"][::3] = 0.0
    for dtype in DTYPES:
        assert_matches_reference(rasterization, scene, device, dtype)
    inputs = leaves(scene, device, torch.float32)
    rasterization(**inputs)[0].sum().backward()
    assert (inputs["quats"].grad[::3] == 0).all()
    assert inputs["scales"].grad[::3].abs().sum() > 0


@pytest.mark.parametrize("axes", [[0], [0, 1], [0, 1, 2]], ids=["pancake", "line", "point"])
@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
def test_flat_and_point_gaussians(device: torch.device, rasterize_mode: str, axes: list[int]) -> None:
    """Flat and point Gaussians: the filter gives them a footprint, antialiasing makes lines and points vanish."""
    scene = random_scene(n=20, rasterize_mode=rasterize_mode)
    for axis in axes:
        scene["scales"][::2, axis] = 0.0
    for dtype in DTYPES:
        _, (_, _, truth) = assert_matches_reference(
            rasterization, scene, device, dtype, **thin_tolerances(rasterize_mode, dtype)
        )
    assert truth["visible"][0, 1::2].any()
    if rasterize_mode == "antialiased" and len(axes) > 1:
        assert not truth["visible"][0, ::2].any()


def test_float32_does_not_move_gaussians_far_from_the_corner(device: torch.device) -> None:
    """Positions of 8,000 px are rounded to 2.4e-4 px, which alone is an error of 1e-4."""
    width, height, n = 8000, 6, 40
    scene = random_scene(n=n, width=width, height=height, backgrounds=False)
    scene["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    scene["Ks"][0] = torch.tensor([[4000.0, 0.0, 4000.0], [0.0, 4000.0, 3.0], [0.0, 0.0, 1.0]])
    depths = torch.linspace(4.0, 5.0, n)
    columns = torch.linspace(7900.0, 7990.0, n)
    scene["means"] = torch.stack([(columns / 4000.0 - 1.0) * depths, torch.zeros(n), depths], -1).double()
    scene["scales"] = (0.005 * scene["scales"]).float().double()
    _, (_, alphas, _) = assert_matches_reference(rasterization, scene, device)
    assert (alphas > 0.5).any()


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
def test_turning_a_sphere_changes_nothing(device: torch.device, rasterize_mode: str) -> None:
    """The gradient to its quaternion is zero and not what rounding leaves, of which Adam would make a whole step."""
    scene = random_scene(n=20, rasterize_mode=rasterize_mode)
    scene["scales"][::2] = scene["scales"][::2, :1]
    inputs = leaves(scene, device, torch.float32)
    rasterization(**inputs)[0].sum().backward()
    assert (inputs["quats"].grad[::2] == 0).all()
    assert inputs["quats"].grad[1::2].abs().sum() > 0


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
@pytest.mark.parametrize("thin", [[0], [0, 1]], ids=["pancake", "needle"])
def test_needles_and_pancakes(device: torch.device, thin: list[int], rasterize_mode: str) -> None:
    """Axis ratios of a million."""
    scene = random_scene(n=20, rasterize_mode=rasterize_mode)
    scene["scales"] = scene["scales"] * 2
    for axis in thin:
        scene["scales"][::2, axis] *= 1e-6
    scene["scales"] = scene["scales"].float().double()
    for dtype in DTYPES:
        assert_matches_reference(rasterization, scene, device, dtype, **thin_tolerances(rasterize_mode, dtype))


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
def test_needles_longer_than_the_image(device: torch.device, rasterize_mode: str) -> None:
    """Thousands of pixels long, a thousandth wide: float32 may lose them, but stays finite; float64 draws them."""
    scene = random_scene(n=20, rasterize_mode=rasterize_mode)
    scene["scales"][::2] = torch.tensor([500.0, 5e-4, 5e-4])
    assert_finite(rasterization, scene, device)
    if rasterize_mode == "classic":
        assert_matches_reference(
            rasterization, scene, device, torch.float64, image_tolerance=1e-6, gradient_tolerance=1e-4
        )


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "covars"])
def test_non_finite_gaussians_are_invisible(device: torch.device, name: str, value: float) -> None:
    """The picture and the gradients are those of the scene without them; theirs are zero."""
    scene = random_scene(n=12, cameras=2, with_covars=name == "covars")
    scene[name].view(12, -1)[3, -1] = value
    scene[name].view(12, -1)[7, 0] = value
    keep = torch.ones(12, dtype=torch.bool)
    keep[[3, 7]] = False
    without = {k: v[keep] if k in PER_GAUSSIAN and v is not None else v for k, v in scene.items()}
    images, found = [], []
    for case in (scene, without):
        inputs = leaves(case, device, torch.float32)
        image, alphas, info = rasterization(**inputs, packed=False)
        images.append(image)
        upstream = upstream_gradients([image, alphas], torch.ones(alphas.shape[:-1]))
        found.append(gradients([image, alphas], upstream, inputs))
        if case is scene:
            assert (info["radii"][:, ~keep] == 0).all()
    assert (images[0] - images[1]).abs().max() < 1e-6
    for key, gradient in found[0].items():
        if key in PER_GAUSSIAN:
            assert (gradient[~keep] == 0).all(), key
            gradient = gradient[keep]
        assert relative_error(gradient, found[1][key]) < 1e-5, key


@pytest.mark.parametrize("name", ["means", "thermal_opacities", "features", "colors"])
def test_non_finite_gaussians_are_invisible_in_both_spectra(device: torch.device, name: str) -> None:
    """A bad number in one spectrum takes the Gaussian out of both."""
    scene = random_rgbt_scene(n=12, sh_degree=1)
    scene[name].view(12, -1)[3, -1] = float("nan")
    keep = torch.arange(12) != 3
    without = {k: v[keep] if k in PER_GAUSSIAN and v is not None else v for k, v in scene.items()}
    inputs = leaves(scene, device, torch.float32)
    result, truth = rasterization_rgbt(**inputs), rasterization_rgbt(**leaves(without, device, torch.float32))
    for image, expected in zip(result[:5], truth[:5], strict=True):
        assert (image - expected).abs().max() < 1e-6
    found = gradients(result[:5], upstream_gradients(result[:5], torch.ones(1, 18, 23)), inputs)
    for key, gradient in found.items():
        assert torch.isfinite(gradient).all(), key
        assert key not in PER_GAUSSIAN or (gradient[3] == 0).all(), key


def test_non_finite_colors_of_one_camera(device: torch.device) -> None:
    """With colours of each camera's own, a bad one hides the Gaussian in that camera only."""
    scene = random_scene(n=12, cameras=2, per_camera_colors=True)
    scene["colors"][1, 3] = float("nan")
    assert_finite(rasterization, scene, device)
    inputs = leaves(scene, device, torch.float32)
    radii = rasterization(**inputs, packed=False)[2]["radii"]
    truth = reference_rasterizer.rasterization(**scene)[2]
    assert truth["visible"][0, 3]
    assert torch.equal((radii > 0).all(-1).cpu(), truth["visible"])


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
def test_around_the_camera_plane(device: torch.device, camera_model: str) -> None:
    """Means behind, in and just before the camera's plane, also where the near plane does not cull them."""
    for near_plane in (0.01, 0.0, -10.0):
        scene = random_scene(n=30, camera_model=camera_model, near_plane=near_plane)
        scene["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
        scene["means"][:, 2] = torch.linspace(-2, 3, 30)
        scene["means"][3, 2] = 0.0
        scene["means"][4] = 0.0
        scene["means"][5, 2] = 1e-20
        scene["means"][6, 2] = 0.01
        scene["means"] = scene["means"].float().double()
        assert_finite(rasterization, scene, device)
        assert_finite(rasterization, scene, device, torch.float64)
    assert_matches_reference(rasterization, scene | {"near_plane": 0.1}, device, torch.float64)


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
def test_camera_inside_a_gaussian(device: torch.device, rasterize_mode: str) -> None:
    """A Gaussian around the camera, its mean a hair in front: covers the image as the reference has it."""
    scene = random_scene(n=8, rasterize_mode=rasterize_mode)
    position = torch.linalg.inv(scene["viewmats"])[0, :3, 3]
    forward = scene["viewmats"][0, 2, :3]
    scene["means"][0] = (position + 0.05 * forward).float().double()
    scene["scales"][0] = 0.5
    scene["opacities"][0] = 0.3
    assert_finite(rasterization, scene, device)
    _, (_, alphas, truth) = assert_matches_reference(rasterization, scene, device, torch.float64)
    assert truth["visible"][0, 0]
    assert (alphas > 0.2).all()


def test_opacity_zero_and_one(device: torch.device) -> None:
    """Opacity 0 is invisible with zero gradients; opacity 1 is clamped with no opacity gradient in its core."""
    scene = random_scene(n=20)
    scene["opacities"][::3] = 0.0
    scene["opacities"][1::3] = 1.0
    for dtype in DTYPES:
        assert_matches_reference(rasterization, scene, device, dtype)
    inputs = leaves(scene, device, torch.float32)
    image, _, info = rasterization(**inputs, packed=False)
    image.sum().backward()
    assert (info["radii"][0, ::3] == 0).all()
    assert all((inputs[name].grad[::3] == 0).all() for name in ("means", "scales", "opacities", "colors"))


@pytest.mark.parametrize("opacity", [1.0 / 255.0, 1.0 / 255.0 + 1e-6, 1.0 / 255.0 - 1e-6, 1e-30])
def test_opacities_at_the_visibility_threshold(device: torch.device, opacity: float) -> None:
    """Opacities that are just, or just not, visible: an extent of next to nothing stays finite."""
    scene = random_scene(n=20)
    scene["opacities"][::2] = opacity
    image = assert_finite(rasterization, scene, device)
    without = scene | {name: scene[name][1::2] for name in ("means", "quats", "scales", "opacities", "colors")}
    assert (image - assert_finite(rasterization, without, device)).abs().max() < 0.02


@pytest.mark.parametrize("dtype", DTYPES)
def test_equal_depths_are_drawn_in_index_order(device: torch.device, dtype: torch.dtype) -> None:
    """Ties in depth are resolved by index, in both directions of the list."""
    scene = random_scene(n=40)
    scene["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    scene["means"][:, 2] = 4.0
    scene["means"][20:] = scene["means"][:20]  # and some in the very same place
    _, (image, _, _) = assert_matches_reference(rasterization, scene, device, dtype)
    names = ("means", "quats", "scales", "opacities", "colors")
    flipped = scene | {name: scene[name].flip(0).contiguous() for name in names}
    _, (other, _, _) = assert_matches_reference(rasterization, flipped, device, dtype)
    assert (image - other).abs().max() > 0.01


def test_thousands_of_gaussians_over_one_pixel(device: torch.device) -> None:
    """2500 faint layers: the transmittance, recovered in the backward pass, does not drift."""
    scene = random_scene(n=2500, width=6, height=4)
    scene["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    scene["means"][:, 2] = torch.linspace(3.0, 5.0, 2500).flip(0)  # no two depths that may swap
    scene["scales"] = (scene["scales"] + 0.5).float().double()
    scene["opacities"] = (0.0005 + 0.012 * scene["opacities"]).float().double()
    # A product of 2500 factors, each rounded to 2^-24, is off by about sqrt(2500) roundings.
    assert_matches_reference(rasterization, scene, device, image_tolerance=6e-6, gradient_tolerance=3e-5)
    _, (_, alphas, _) = assert_matches_reference(rasterization, scene, device, torch.float64)
    assert alphas.min() > 0.6


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
@pytest.mark.parametrize("eps2d", [0.3, 0.0])
def test_gaussians_smaller_than_a_pixel(device: torch.device, eps2d: float, rasterize_mode: str) -> None:
    """Widened by the filter, faded by the compensation, or hit or missed where there is no filter."""
    scene = random_scene(n=40, eps2d=eps2d, rasterize_mode=rasterize_mode)
    scene["scales"] = (scene["scales"] * 0.01).float().double()
    assert_matches_reference(rasterization, scene, device, torch.float64)
    if eps2d > 0:
        assert_matches_reference(rasterization, scene, device)
    scene["scales"] = scene["scales"] * 1e-30  # their squares underflow in float32
    assert_finite(rasterization, scene, device)


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
def test_gaussians_larger_than_the_world(device: torch.device, rasterize_mode: str) -> None:
    """A thousand times the frame: constant over the image; larger still, until squares overflow: finite."""
    scene = random_scene(n=20, rasterize_mode=rasterize_mode)
    scene["scales"][0] = 1000.0
    scene["opacities"][0] = 0.5
    assert_finite(rasterization, scene, device)
    _, (_, alphas, _) = assert_matches_reference(rasterization, scene, device, torch.float64)
    assert alphas.min() > 0.45
    for size in (1e10, 1e19, 1e25, 3e38):
        scene["scales"][0] = size
        assert_finite(rasterization, scene, device)


def test_far_from_the_origin(device: torch.device) -> None:
    """A million units away float32 cannot place the Gaussians any more, but nothing breaks; float64 can."""
    scene = random_scene(n=30)
    shift = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    moved = scene | {"means": scene["means"] + shift, "viewmats": scene["viewmats"].clone()}
    moved["viewmats"][0, :3, 3] -= moved["viewmats"][0, :3, :3] @ shift
    assert_finite(rasterization, moved, device)
    assert_matches_reference(rasterization, moved, device, torch.float64, image_tolerance=1e-8, gradient_tolerance=1e-7)


@pytest.mark.parametrize("size", [1e-30, 1e-10, 1e10, 1e30])
def test_unnormalised_quaternions(device: torch.device, size: float) -> None:
    """Quaternions of any length rotate alike; lengths whose square leaves float32's range stay finite."""
    scene = random_scene(n=20)
    scaled = scene | {"quats": scene["quats"] * size}
    image = assert_finite(rasterization, scaled, device)
    if 1e-15 < size < 1e15:
        assert (image - assert_finite(rasterization, scene, device)).abs().max() < 2e-5
        assert_matches_reference(rasterization, scaled | {"quats": scaled["quats"].float().double()}, device)


def test_singular_camera_pose_inputs_stay_finite(device: torch.device) -> None:
    """A camera that looks away from everything, and one inside the cloud."""
    scene = random_scene(n=30, cameras=2)
    scene["viewmats"][0, :3, 3] = torch.tensor([0.0, 0.0, -50.0])
    scene["viewmats"][1, :3, 3] = 0.0
    assert_finite(rasterization, scene, device)
    assert (assert_finite(rasterization, scene, device)[0].cpu() == scene["backgrounds"][0].float()).all()
