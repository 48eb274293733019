"""rasterization(): images and every gradient against the dense reference, and finite differences in float64."""

import itertools
from functools import partial
from typing import Any

import pytest
import torch

import reference_rasterizer
from gaussian_scenes import (
    assert_matches_reference,
    gradients,
    leaves,
    random_scene,
    relative_error,
    upstream_gradients,
)
from thermosplat import rasterization
from thermosplat.errors import UserError

pytestmark = pytest.mark.rotating

RENDER_MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]
CAMERA_MODELS = ["pinhole", "ortho", "fisheye"]
RASTERIZE_MODES = ["classic", "antialiased"]
DTYPES = [torch.float32, torch.float64]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("camera_model", CAMERA_MODELS)
@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
def test_cameras_and_filters(device: torch.device, rasterize_mode: str, camera_model: str, dtype: torch.dtype) -> None:
    """Both camera models, with and without antialiasing compensation, two cameras."""
    scene = random_scene(cameras=2, rasterize_mode=rasterize_mode, camera_model=camera_model)
    _, (_, _, info) = assert_matches_reference(rasterization, scene, device, dtype)
    assert info["visible"].float().mean() > 0.5


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3, 4])
def test_spherical_harmonics(device: torch.device, sh_degree: int, dtype: torch.dtype) -> None:
    """SH colours of each degree, whose gradient also reaches the means and the camera poses."""
    assert_matches_reference(rasterization, random_scene(cameras=2, sh_degree=sh_degree), device, dtype)


def test_fewer_active_bases_than_coefficients(device: torch.device) -> None:
    """An active degree below the stored one uses the first bases; the others get zero gradients."""
    scene = random_scene(sh_degree=3) | {"sh_degree": 1}
    assert_matches_reference(rasterization, scene, device)
    inputs = leaves(scene, device, torch.float32)
    rasterization(**inputs)[0].square().sum().backward()
    assert (inputs["colors"].grad[:, 4:] == 0).all()
    assert (inputs["colors"].grad[:, :4] != 0).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_black_may_become_brighter(device: torch.device, dtype: torch.dtype) -> None:
    """A colour of exactly 0 passes its gradient, as torch.clamp does; one below 0 is drawn black and passes none."""
    scene = random_scene(n=6, sh_degree=0, backgrounds=False)
    black = torch.tensor(-0.5, dtype=dtype) / torch.tensor(0.28209479177387814, dtype=dtype)
    scene["colors"] = black.double().expand(6, 1, 3).clone()
    scene["colors"][3:] *= 1.1
    inputs = leaves(scene, device, dtype)
    image, _, _ = rasterization(**inputs)
    image.sum().backward()
    assert (image == 0).all()
    assert (inputs["colors"].grad[:3] > 0).all()
    assert (inputs["colors"].grad[3:] == 0).all()


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
@pytest.mark.parametrize("render_mode", RENDER_MODES)
def test_render_modes(device: torch.device, render_mode: str, rasterize_mode: str) -> None:
    """Colours, accumulated and expected depth, with backgrounds that never reach the depth."""
    scene = random_scene(cameras=2, render_mode=render_mode, rasterize_mode=rasterize_mode)
    assert_matches_reference(rasterization, scene, device)


@pytest.mark.parametrize("render_mode", RENDER_MODES)
def test_render_modes_in_double_precision(device: torch.device, render_mode: str) -> None:
    """The same kernels in float64 differ from the reference by rounding only."""
    assert_matches_reference(rasterization, random_scene(render_mode=render_mode), device, torch.float64)


@pytest.mark.parametrize("channels", [1, 3, 4, 8, 11, 16, 17, 32, 33, 64])
def test_any_number_of_channels(device: torch.device, channels: int) -> None:
    """1 to 64 channels, also those that must be blended in several traversals."""
    assert_matches_reference(rasterization, random_scene(n=30, channels=channels), device)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (17, 5), (16, 16), (309, 233), (1, 40)])
def test_ragged_image_sizes(device: torch.device, width: int, height: int) -> None:
    """Sizes that are no multiple of a tile, down to one pixel."""
    # Not seed 0: there the Gaussians' parts of the principal point's gradient cancel to a hundredth of themselves, and
    # what is left shows that a means2d of 300 px is rounded to 3e-5 px.
    assert_matches_reference(rasterization, random_scene(n=25, width=width, height=height, seed=1), device)


@pytest.mark.parametrize("tile_size", [8, 16, 32])
def test_tile_size_does_not_change_the_image(device: torch.device, tile_size: int) -> None:
    """The tiles are an implementation detail: image and gradients stay the reference's."""
    assert_matches_reference(rasterization, random_scene(width=70, height=41, tile_size=tile_size), device)


@pytest.mark.parametrize("sh_degree", [None, 2])
@pytest.mark.parametrize("batch", [(2,), (1, 2)])
def test_batches_and_colors_of_each_camera(device: torch.device, batch: tuple[int, ...], sh_degree: int | None) -> None:
    """Leading batch dimensions, with colours shared by the cameras or their own."""
    for per_camera_colors in (False, True):
        scene = random_scene(
            n=25, batch=batch, cameras=3, sh_degree=sh_degree, per_camera_colors=per_camera_colors, seed=2
        )
        assert_matches_reference(rasterization, scene, device)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
def test_covariances_in_place_of_quats_and_scales(
    device: torch.device, rasterize_mode: str, dtype: torch.dtype
) -> None:
    """covars in place of quats and scales; as in gsplat only the upper triangle is read."""
    scene = random_scene(cameras=2, with_covars=True, rasterize_mode=rasterize_mode)
    assert_matches_reference(rasterization, scene, device, dtype)


def test_quats_and_scales_are_ignored_when_covariances_are_given(device: torch.device) -> None:
    """As in gsplat: covars win, and what they replace gets no gradient."""
    scene = random_scene(with_covars=True)
    other = random_scene(seed=9)
    image = rasterization(**leaves(scene, device, torch.float32))[0]
    inputs = leaves(scene | {name: other[name] for name in ("quats", "scales")}, device, torch.float32)
    same = rasterization(**inputs)[0]
    assert torch.equal(image, same)
    same.sum().backward()
    assert inputs["covars"].grad.abs().sum() > 0
    assert inputs["quats"].grad is None or (inputs["quats"].grad == 0).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_crowded_pixels(device: torch.device, dtype: torch.dtype) -> None:
    """Deep stacks of opaque Gaussians: the alpha clamp and the early stop are where the reference has them."""
    scene = random_scene(n=400, seed=3)
    scene["opacities"] = scene["opacities"].sqrt().sqrt().float().double()
    scene["scales"] = scene["scales"] * 2
    (_, alphas, _), _ = assert_matches_reference(rasterization, scene, device, dtype)
    assert (alphas > 0.999).float().mean() > 0.3


@pytest.mark.parametrize(
    "arguments",
    [
        {"near_plane": 3.9, "far_plane": 4.6},
        {"radius_clip": 6.0},
        {"eps2d": 0.0},
        {"eps2d": 1.5, "rasterize_mode": "antialiased"},
        {"near_plane": -100.0, "camera_model": "ortho"},
    ],
    ids=str,
)
def test_culling_and_filter_arguments(device: torch.device, arguments: dict[str, Any]) -> None:
    """Planes, radius_clip and eps2d cull and widen exactly what the reference does."""
    plain = random_scene(n=80)
    scene = random_scene(n=80, **arguments)
    (image, _, info), (_, _, truth) = assert_matches_reference(rasterization, scene, device)
    assert torch.equal(info["visible"].cpu(), truth["visible"])
    if "eps2d" not in arguments and "camera_model" not in arguments:
        assert truth["visible"].sum() < reference_rasterizer.rasterization(**plain)[2]["visible"].sum()
    assert image.abs().max() > 0.1


def test_field_of_view_clamp(device: torch.device) -> None:
    """Large Gaussians beside the image reach into it with a clamped Jacobian, whose gradient is clamped too."""
    scene = random_scene(n=60, width=20, height=16, seed=4)
    scene["means"] = scene["means"] * 3
    scene["scales"] = scene["scales"] * 4
    for dtype in DTYPES:
        assert_matches_reference(rasterization, scene, device, dtype)
    depth = scene["means"] @ scene["viewmats"][0, :3, :3].T + scene["viewmats"][0, :3, 3]
    outside = (depth[:, 0] / depth[:, 2]).abs() > 0.55 / 1.25 + 0.3 * 0.5 / 1.25
    visible = reference_rasterizer.rasterization(**scene)[2]["visible"][0]
    assert (outside & visible).sum() >= 3


def test_absolute_gradients_of_means2d(device: torch.device) -> None:
    """means2d.absgrad is the sum over pixels of the absolute gradients, and .grad their plain sum."""
    scene = random_scene(cameras=2, absgrad=True)
    results = []
    for render, dtype, where in (
        (reference_rasterizer.rasterization, torch.float64, "cpu"),
        (partial(rasterization, packed=False), torch.float32, device),
    ):
        inputs = leaves(scene, where, dtype)
        image, alphas, info = render(**inputs)
        info["means2d"].retain_grad()
        if render is reference_rasterizer.rasterization:
            upstream = upstream_gradients([image, alphas], ~info["uncertain"])
        ((image * upstream[0].to(image)).sum() + (alphas * upstream[1].to(image)).sum()).backward()
        means2d = info["means2d"]
        results.append([t.reshape(2, -1, 2).double().cpu() for t in (means2d.absgrad, means2d.grad)])
    for truth, value in zip(*results, strict=True):
        assert relative_error(value, truth) < 1e-5
    assert (results[1][0] >= results[1][1].abs() * (1 - 1e-5) - 1e-6).all()


@pytest.mark.parametrize("seen", [slice(0, 2), slice(2, 4), slice(4, 5)])
def test_absgrad_of_every_chunk_of_channels(device: torch.device, seen: slice) -> None:
    """A loss on some channels has the same absgrad whether they are blended with the others or not."""
    scene = random_scene(channels=5, cameras=2, absgrad=True, backgrounds=False)  # whose gradient is the first chunk's
    sums = []
    for channel_chunk in (32, 2):
        image, _, info = rasterization(
            **leaves(scene, device, torch.float64), channel_chunk=channel_chunk, packed=False
        )
        image[..., seen].square().sum().backward()
        sums.append(info["means2d"].absgrad)
    assert sums[0].max() > 0
    torch.testing.assert_close(sums[1], sums[0])


def test_packed_gives_the_same_result(device: torch.device) -> None:
    """packed changes nothing, not even a bit."""
    scene = random_scene(cameras=2)
    results = []
    for packed in (True, False):
        inputs = leaves(scene | {"packed": packed}, device, torch.float32)
        image, alphas, _ = rasterization(**inputs)
        upstream = [torch.ones(image.shape), torch.ones(alphas.shape)]
        results.append([image, alphas, *gradients([image, alphas], upstream, inputs).values()])
    exact = device.type == "cpu"
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other) if exact else torch.allclose(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("backgrounds", [True, False])
@pytest.mark.parametrize("case", ["no Gaussians", "all culled"])
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED"])
def test_nothing_to_draw(device: torch.device, render_mode: str, case: str, backgrounds: bool) -> None:
    """No Gaussian, or none in view: the background, alpha 0, zero gradients."""
    n = 0 if case == "no Gaussians" else 5
    scene = random_scene(n=n, cameras=2, render_mode=render_mode, backgrounds=backgrounds)
    if n:
        scene["means"] = scene["means"] - 100.0  # behind and beside the camera
    inputs = leaves(scene, device, torch.float32)
    image, alphas, info = rasterization(**inputs, packed=False)
    expected = scene["backgrounds"][:, None, None, :].float() if backgrounds else torch.zeros(3)
    assert (image[..., :3].cpu() == expected).all()
    assert (image[..., 3:] == 0).all()
    assert (alphas == 0).all()
    assert (info["radii"] == 0).all()
    (image.sum() + alphas.sum()).backward()
    for name in ("means", "quats", "scales", "opacities", "colors"):
        gradient = inputs[name].grad
        assert gradient is None or (gradient.shape == inputs[name].shape and (gradient == 0).all()), name


def test_input_gradients_are_optional(device: torch.device) -> None:
    """Only the tensors that ask for a gradient get one, and the result does not depend on who asks."""
    scene = random_scene(sh_degree=1)
    all_inputs = leaves(scene, device, torch.float64)
    image = rasterization(**all_inputs)[0]
    image.square().sum().backward()
    for name in ("means", "opacities", "colors", "viewmats", "Ks", "backgrounds"):
        inputs = {
            key: value.detach().requires_grad_(key == name) if isinstance(value, torch.Tensor) else value
            for key, value in all_inputs.items()
        }
        rasterization(**inputs)[0].square().sum().backward()
        assert relative_error(inputs[name].grad, all_inputs[name].grad) < 1e-12, name
        assert all(v.grad is None for k, v in inputs.items() if isinstance(v, torch.Tensor) and k != name)
    with torch.no_grad():
        assert not rasterization(**all_inputs)[0].requires_grad


def test_non_contiguous_inputs_and_upstream_gradients(device: torch.device) -> None:
    """Strided inputs and expanded upstream gradients give what contiguous ones give."""
    scene = leaves(random_scene(), device, torch.float32)
    strided = dict(scene)
    for name in ("means", "quats", "scales", "colors", "opacities"):
        tensor = scene[name].detach()
        strided[name] = torch.stack([tensor, tensor], -1)[..., 0].requires_grad_()
        assert not strided[name].is_contiguous()
    rasterization(**strided)[0].sum().backward()
    image = rasterization(**scene)[0]
    image.backward(torch.ones_like(image).contiguous())
    for name in ("means", "quats", "scales", "colors", "opacities"):
        assert relative_error(strided[name].grad, scene[name].grad) < 1e-5, name


def test_backward_twice_and_two_renders_of_one_scene(device: torch.device) -> None:
    """A graph kept for a second backward gives the same gradient again; two renders do not mix."""
    inputs = leaves(random_scene(cameras=2), device, torch.float64)
    image = rasterization(**inputs)[0]
    other = rasterization(**inputs | {"viewmats": inputs["viewmats"].flip(0)})[0]
    first = torch.autograd.grad(image.square().sum(), inputs["means"], retain_graph=True)[0]
    between = torch.autograd.grad(other.square().sum(), inputs["means"])[0]
    second = torch.autograd.grad(image.square().sum(), inputs["means"])[0]
    assert relative_error(second, first) < 1e-12
    flipped = rasterization(**inputs | {"viewmats": inputs["viewmats"].flip(0)})[0]
    assert relative_error(torch.autograd.grad(flipped.square().sum(), inputs["means"])[0], between) < 1e-12


GRADCHECKS = [
    pytest.param(model, mode, degree, covars, id=f"{model}-{mode}-{'direct' if degree is None else degree}-{covars}")
    for model, mode, degree, covars in [
        *itertools.product(CAMERA_MODELS, RASTERIZE_MODES, [None, 1], [False]),
        ("pinhole", "classic", 0, False),
        ("pinhole", "classic", 2, False),
        ("pinhole", "classic", 3, False),
        *itertools.product(CAMERA_MODELS, RASTERIZE_MODES, [None], [True]),
    ]
]


@pytest.mark.parametrize(("camera_model", "rasterize_mode", "sh_degree", "with_covars"), GRADCHECKS)
def test_gradcheck(
    device: torch.device, camera_model: str, rasterize_mode: str, sh_degree: int | None, with_covars: bool
) -> None:
    """Every gradient equals central differences in float64."""
    scene = random_scene(
        n=4,
        width=5,
        height=4,
        camera_model=camera_model,
        rasterize_mode=rasterize_mode,
        sh_degree=sh_degree,
        with_covars=with_covars,
        render_mode="RGB+D",
        seed=5,
    )
    truth = reference_rasterizer.rasterization(**scene)[2]
    assert not truth["uncertain"].any()
    assert truth["visible"].all()
    inputs = leaves(scene, device, torch.float64)
    names = [name for name, value in inputs.items() if isinstance(value, torch.Tensor)]

    def render(*tensors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return rasterization(**{**inputs, **dict(zip(names, tensors, strict=True))})[:2]

    # Atomic sums on CUDA may come in another order each time: allow rounding between two evaluations.
    assert torch.autograd.gradcheck(
        render, [inputs[name] for name in names], nondet_tol=0.0 if device.type == "cpu" else 1e-10
    )


def test_a_frame_of_many_tiles(device: torch.device) -> None:
    """1200 Gaussians over 6x5 tiles, 11 channels: lists longer than a batch, tiles that stop early, ragged borders."""
    scene = random_scene(n=1200, width=93, height=71, channels=11, seed=11)
    scene["scales"] = (scene["scales"] * 0.5).float().double()
    _, (_, alphas, _) = assert_matches_reference(rasterization, scene, device)
    assert (alphas > 0.999).float().mean() > 0.05
    assert (alphas < 0.9).float().mean() > 0.05


def test_coefficients_in_two_tensors(device: torch.device) -> None:
    """A pair of the first coefficient and the others gives the image and gradients of their concatenation."""
    scene = random_scene(sh_degree=2, cameras=2)
    joined = leaves(scene, device, torch.float64)
    apart = leaves(scene, device, torch.float64)
    pair = tuple(part.detach().clone().requires_grad_() for part in apart["colors"].split([1, 8], dim=-2))
    image, _, _ = rasterization(**joined)
    other, _, _ = rasterization(**{**apart, "colors": pair})
    image.square().sum().backward()
    other.square().sum().backward()
    assert torch.equal(image, other)
    gradient = torch.cat([part.grad for part in pair], dim=-2)
    torch.testing.assert_close(gradient, joined["colors"].grad, rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(apart["means"].grad, joined["means"].grad, rtol=1e-10, atol=1e-14)
    with pytest.raises(UserError, match=r"colors\[1\]"):
        rasterization(**{**apart, "colors": (pair[0], pair[1][..., :5, :])})
