"""Rendering through lenses: images and every gradient against seven-point projection in plain torch, in float64."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import reference_lens_rasterizer
import reference_rasterizer
from gaussian_scenes import Scene, assert_matches_reference, leaves, random_scene
from thermosplat import rasterization, rasterization_rgbt
from thermosplat.errors import UserError
from thermosplat.rasterizer.lenses import FThetaCameraDistortionParameters, FThetaPolynomialType

pytestmark = pytest.mark.rotating

FORWARD = [0.0, 30.0, 0.6, -1.2, 0.3, -0.05]
"""An f-theta lens: distances [px] of angles."""


def coefficients(cameras: int, *values: float) -> Tensor:
    """The same coefficients for all cameras, changed a little from one to the next."""
    row = torch.tensor(values, dtype=torch.float64)
    return torch.stack([row * (1 + 0.1 * c) for c in range(cameras)]).float().double()


def lens_arguments(name: str, cameras: int) -> dict[str, Any]:
    """Arguments of ``rasterization`` for a strong lens of each kind."""
    if name == "radial":
        return {"radial_coeffs": coefficients(cameras, -0.3, 0.1, -0.01, 0.0)}
    if name == "rational":
        return {
            "radial_coeffs": coefficients(cameras, 0.6, 0.1, 0.005, 0.9, 0.3, 0.02),
            "tangential_coeffs": coefficients(cameras, 0.02, -0.015),
            "thin_prism_coeffs": coefficients(cameras, 0.02, 0.004, -0.015, 0.003),
        }
    if name == "fisheye":
        return {"camera_model": "fisheye", "radial_coeffs": coefficients(cameras, -0.05, 0.01, -0.004, 0.0006)}
    if name in ("ftheta", "ftheta_inverse"):
        forward = name == "ftheta"
        lens = FThetaCameraDistortionParameters(
            FThetaPolynomialType.ANGLE_TO_PIXELDIST if forward else FThetaPolynomialType.PIXELDIST_TO_ANGLE,
            pixeldist_to_angle_poly=[0.0, 1 / 30.0, -2e-5, 1.5e-6, 0.0, 0.0],
            angle_to_pixeldist_poly=FORWARD,
            max_angle=1.4,
            linear_cde=[1.01, 0.003, -0.002],
        )
        return {"camera_model": "ftheta", "ftheta_coeffs": lens}
    return {"camera_model": name.removeprefix("bare "), "with_ut": True}


def lens_scene(name: str, *, cameras: int = 1, **arguments: Any) -> Scene:
    """Gaussians all over the field of a lens, from its axis to beyond the image, some behind the camera."""
    scene = random_scene(cameras=cameras, **arguments)
    arguments = lens_arguments(name, cameras)
    camera_model = arguments.get("camera_model", "pinhole")
    scene["means"] = (1.5 * scene["means"]).float().double()
    scene["means"][:3] = torch.tensor([[0.0, 0.0, -9.0], [4.0, 1.0, -3.9], [0.0, 9.0, -3.0]])  # behind, beside, below
    focal = 15.0 if camera_model in ("fisheye", "ftheta") else 0.6 * scene["width"]
    if camera_model == "ortho":
        focal = 5.0
    scene["Ks"][..., 0, 0], scene["Ks"][..., 1, 1] = focal, 0.9 * focal
    return scene | {"camera_model": camera_model} | arguments


def compare(scene: Scene, device: torch.device, dtype: torch.dtype) -> tuple[Any, Any]:
    """Held against the reference; a float32 image is off by what rounds 1 px."""
    tolerances = {"image_tolerance": 1e-11, "gradient_tolerance": 1e-9}
    if dtype == torch.float32:
        tolerances = {"image_tolerance": 5e-6, "gradient_tolerance": 2e-5}
    reference = reference_lens_rasterizer.rasterization
    return assert_matches_reference(rasterization, scene, device, dtype, reference=reference, **tolerances)


@pytest.mark.parametrize(("name", "mode"), [("radial", "classic"), ("fisheye", "antialiased")])
def test_images_and_gradients_in_double_precision(device: torch.device, name: str, mode: str) -> None:
    """Two cameras with lenses of their own, Gaussians off the edge, behind and where no ray comes from."""
    scene = lens_scene(name, cameras=2, rasterize_mode=mode)
    _, (_, _, info) = compare(scene, device, torch.float64)
    assert 0.3 < info["visible"].float().mean() < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rational", "ftheta", "ftheta_inverse", "pinhole", "ortho", "bare fisheye"])
def test_all_models_in_double_precision(device: torch.device, name: str) -> None:
    """All coefficients of a pinhole lens, both polynomials of f-theta, and the transform without a lens."""
    compare(lens_scene(name, cameras=2), device, torch.float64)


@pytest.mark.parametrize("rolling", [False, True])
def test_terms_of_zero_change_nothing(device: torch.device, rolling: bool) -> None:
    """A radial lens has kernels without the other terms; those with them give its image and gradients."""
    scene, results = lens_scene("radial", cameras=2, backgrounds=False), []
    if rolling:
        end = scene["viewmats"].clone()
        end[..., 0, 3] += 0.1
        scene |= {"viewmats_rs": end, "rolling_shutter": "ROLLING_TOP_TO_BOTTOM"}
    for zeros in ({}, {"tangential_coeffs": torch.zeros(2, 2), "thin_prism_coeffs": torch.zeros(2, 4)}):
        inputs = leaves(scene | zeros, device, torch.float64)
        image, _, info = rasterization(**inputs)
        image.square().sum().backward()
        names = ("means", "quats", "scales", "viewmats", "Ks", "radial_coeffs")
        results.append([image.detach(), info["means2d"].detach(), *[inputs[name].grad for name in names]])
    for one, other in zip(*results, strict=True):
        assert one.norm() > 0
        assert (one - other).norm() < 1e-10 * one.norm()


@pytest.mark.parametrize("name", ["radial", pytest.param("fisheye", marks=pytest.mark.slow)])
def test_single_precision(device: torch.device, name: str) -> None:
    """Spherical harmonics, antialiasing and depth in float32."""
    compare(lens_scene(name, sh_degree=1), device, torch.float32)
    compare(lens_scene(name, rasterize_mode="antialiased"), device, torch.float32)


def test_coefficients_of_an_ftheta_lens_get_gradients(device: torch.device) -> None:
    """Polynomial and matrix as tensors."""
    scene = lens_scene("ftheta", n=20, backgrounds=False)
    scene["ftheta_coeffs"] = None
    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(scene["height"], scene["width"], 3, dtype=torch.float64, generator=generator)

    def gradient(render: Any, device: torch.device | str) -> list[Tensor]:
        inputs = {key: x.to(device) if isinstance(x, Tensor) else x for key, x in scene.items()}
        numbers = (FORWARD, [1.01, 0.003, -0.002])
        given = [torch.tensor(x, dtype=torch.float64, device=device, requires_grad=True) for x in numbers]
        exact = FThetaPolynomialType.ANGLE_TO_PIXELDIST
        lens = FThetaCameraDistortionParameters(exact, [0.0] * 6, given[0], 1.4, given[1])
        image, _, _ = render(**(inputs | {"ftheta_coeffs": lens}))
        return [x.cpu() for x in torch.autograd.grad((image[0] * weights.to(image)).sum(), given)]

    expected = gradient(reference_lens_rasterizer.rasterization, "cpu")
    for found, truth in zip(gradient(rasterization, device), expected, strict=True):
        assert truth.norm() > 1e-3
        torch.testing.assert_close(found, truth, rtol=1e-8, atol=1e-10)


def seen(means: list[list[float]], **arguments: Any) -> list[bool]:
    """Which small Gaussians a camera at the origin draws."""
    count = len(means)
    Ks = torch.tensor([[[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]]], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(count, 4)
    _, _, info = rasterization(
        torch.tensor(means, dtype=torch.float64),
        quats,
        torch.full((count, 3), 0.02, dtype=torch.float64),
        torch.ones(count, dtype=torch.float64),
        torch.ones(count, 1, dtype=torch.float64),
        torch.eye(4, dtype=torch.float64)[None],
        Ks,
        64,
        48,
        **arguments,
    )
    return info["visible"][0].tolist()


def test_what_a_lens_folds_back_is_not_drawn() -> None:
    """With k1 = -1/3 the image turns round at r = 1, where it is at 2/3; one from r = √3 would land in the middle."""
    radial = torch.tensor([[-1 / 3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    means = [[0.0, 0.0, 1.0], [0.9, 0.0, 1.0], [1.05, 0.0, 1.0], [1.7, 0.0, 1.0], [0.1, 0.0, -1.0], [0.0, 0.0, 0.001]]
    assert seen(means, radial_coeffs=radial) == [True, True, False, False, False, False]
    weaker = torch.tensor([[-1 / 4, 0.0, 0.0, 0.0]], dtype=torch.float64)  # turns round at r = 1.15
    assert seen(means, radial_coeffs=weaker) == [True, True, True, False, False, False]


def test_what_lies_beyond_the_largest_angle_is_not_drawn() -> None:
    """Angles of 0, 0.5, 0.9 and 1.2 rad with a largest angle of 1, and a fisheye whose polynomial turns at 0.8."""
    means = [[0.6 * math.sin(a), 0.8 * math.sin(a), math.cos(a)] for a in (0.0, 0.5, 0.9, 1.2)]
    lens = FThetaCameraDistortionParameters(1, [0.0] * 6, [0.0, 20.0, 0.0, 0.0, 0.0, 0.0], 1.0)
    assert seen(means, camera_model="ftheta", ftheta_coeffs=lens) == [True, True, True, False]
    turning = torch.tensor([[-1 / (3 * 0.64), 0.0, 0.0, 0.0]], dtype=torch.float64)
    assert seen(means, camera_model="fisheye", radial_coeffs=turning) == [True, True, False, False]


def test_small_gaussians_are_seen_where_opencv_sees_points() -> None:
    """Positions in the image, of every coefficient, are cv2.projectPoints' and cv2.fisheye's."""
    cv2 = pytest.importorskip("cv2")
    scene = lens_scene("rational", n=40)
    scene["scales"] = torch.full_like(scene["scales"], 1e-6)
    _, _, info = rasterization(**scene, packed=False)
    camera = scene["means"] @ scene["viewmats"][0, :3, :3].T + scene["viewmats"][0, :3, 3]
    order = (*scene["radial_coeffs"][0, :2], *scene["tangential_coeffs"][0], *scene["radial_coeffs"][0, 2:])
    distortion = torch.stack([*order, *scene["thin_prism_coeffs"][0]]).numpy()
    shown = info["radii"][0, :, 0] > 0
    expected, _ = cv2.projectPoints(
        camera[shown].numpy(), torch.zeros(3).numpy(), torch.zeros(3).numpy(), scene["Ks"][0].numpy(), distortion
    )
    assert shown.sum() > 10
    torch.testing.assert_close(info["means2d"][0][shown], torch.from_numpy(expected)[:, 0], atol=1e-7, rtol=0)

    scene = lens_scene("fisheye", n=40)
    scene["scales"] = torch.full_like(scene["scales"], 1e-6)
    _, _, info = rasterization(**scene, packed=False)
    camera = scene["means"] @ scene["viewmats"][0, :3, :3].T + scene["viewmats"][0, :3, 3]
    shown = info["radii"][0, :, 0] > 0
    expected, _ = cv2.fisheye.projectPoints(
        camera[shown][:, None].numpy(),
        torch.zeros(3, 1).numpy(),
        torch.zeros(3, 1).numpy(),
        scene["Ks"][0].numpy(),
        scene["radial_coeffs"][0].numpy(),
    )
    torch.testing.assert_close(info["means2d"][0][shown], torch.from_numpy(expected)[:, 0], atol=1e-7, rtol=0)


def test_a_lens_without_distortion_is_nearly_a_pinhole(device: torch.device) -> None:
    """Of Gaussians of a pixel or two the transform and the linearisation hardly differ."""
    scene = random_scene(n=40)
    scene["scales"] = 0.3 * scene["scales"]
    inputs = {key: value.to(device) if isinstance(value, Tensor) else value for key, value in scene.items()}
    plain, _, _ = rasterization(**inputs)
    bent, _, _ = rasterization(**inputs, radial_coeffs=torch.zeros(1, 6, dtype=torch.float64, device=device))
    difference = (bent - plain).square().mean().sqrt()
    assert 0 < difference < 0.01


def test_a_fisheye_camera_is_linearised_unless_the_transform_is_asked_for(device: torch.device) -> None:
    """gsplat's meaning without with_ut; with_ut=True is the transform, as coefficients are, of zeros too."""
    scene = lens_scene("bare fisheye", n=40)
    inputs = {key: value.to(device) if isinstance(value, Tensor) else value for key, value in scene.items()}
    del inputs["with_ut"]
    linear, _, _ = rasterization(**inputs)
    expected, _, info = reference_rasterizer.rasterization(**{k: v for k, v in scene.items() if k != "with_ut"})
    assert ((linear.cpu() - expected).abs().amax(-1) * ~info["uncertain"]).max() < 1e-11
    transformed, _, _ = rasterization(**inputs, with_ut=True)
    zeros = torch.zeros(1, 4, dtype=torch.float64, device=device)
    assert torch.equal(rasterization(**inputs, radial_coeffs=zeros)[0], transformed)
    assert (transformed - linear).abs().max() > 0.005


def test_two_opacities_through_a_lens(device: torch.device) -> None:
    """rasterization_rgbt renders what three calls of rasterization do."""
    scene = lens_scene("radial", n=30)
    inputs = leaves(scene, device, torch.float64)
    inputs = {key: value.detach() if isinstance(value, Tensor) else value for key, value in inputs.items()}
    colors, backgrounds = inputs.pop("colors"), inputs.pop("backgrounds")
    opacities = inputs.pop("opacities")
    inputs.pop("sh_degree")
    features, thermal = torch.rand(30, 4).to(colors), 0.5 * opacities
    frame = rasterization_rgbt(
        opacities=opacities,
        thermal_opacities=thermal,
        colors=colors,
        features=features,
        backgrounds=backgrounds,
        **inputs,
    )
    expected, _, _ = rasterization(opacities=opacities, colors=colors, backgrounds=backgrounds, **inputs)
    torch.testing.assert_close(frame.render_colors, expected)
    expected, _, _ = rasterization(opacities=thermal, colors=features, **inputs)
    torch.testing.assert_close(frame.render_thermal_features, expected)


def test_a_lens_that_is_not_finite_draws_nothing(device: torch.device) -> None:
    """Everything is counted as non-finite, and gradients are finite."""
    scene = lens_scene("radial", n=10)
    scene["radial_coeffs"][0, 1] = torch.nan
    inputs = leaves(scene, device, torch.float64)
    image, alphas, info = rasterization(**inputs)
    assert alphas.max() == 0
    assert info["num_nonfinite"] == 10
    image.sum().backward()
    assert inputs["means"].grad.isfinite().all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"camera_model": "fisheye", "tangential_coeffs": 2}, "camera_model='fisheye' does not take tangential_coeffs"),
        ({"camera_model": "ortho", "radial_coeffs": 6}, "takes no coefficients"),
        ({"camera_model": "ftheta"}, "camera_model='ftheta' needs ftheta_coeffs, got None."),
        ({"radial_coeffs": 5}, r"radial_coeffs must have shape \[1, 6\]"),
        ({"camera_model": "fisheye", "radial_coeffs": 6}, r"radial_coeffs must have shape \[1, 4\]"),
        ({"thin_prism_coeffs": 2}, r"thin_prism_coeffs must have shape \[1, 4\]"),
        ({"camera_model": "lidar"}, "camera_model must be one of 'pinhole', 'ortho', 'fisheye', 'ftheta'"),
        ({"rolling_shutter": "ROLLING_TOP_TO_BOTTOM"}, "needs viewmats_rs, the poses at the end"),
        ({"rolling_shutter": "UPWARDS"}, r"must be a RollingShutterType \(ROLLING_TOP_TO_BOTTOM, .*got 'UPWARDS'"),
        ({"viewmats_rs": (4, 4)}, "viewmats_rs was given with a global shutter"),
        ({"rolling_shutter": 0, "viewmats_rs": (3, 4)}, r"viewmats_rs must have shape \[1, 4, 4\]"),
        ({"ut_params": object()}, "does not support ut_params"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], message: str) -> None:
    """One sentence says what was expected and what was found; a number stands for a tensor of that width."""
    tensors = {
        key: torch.zeros(1, *(value if isinstance(value, tuple) else (value,)), dtype=torch.float64)
        for key, value in arguments.items()
        if key.endswith(("_coeffs", "_rs"))
    }
    with pytest.raises(UserError, match=message):
        rasterization(**(random_scene(n=2) | arguments | tensors))


def test_covariances_do_not_go_through_a_lens() -> None:
    """Points are taken along the Gaussian's axes, which covariances do not have."""
    scene = random_scene(n=2, with_covars=True) | {"radial_coeffs": torch.zeros(1, 6, dtype=torch.float64)}
    with pytest.raises(UserError, match="covars cannot be projected through a lens"):
        rasterization(**scene)
