"""What rasterization() refuses, and that it says in one sentence what was expected and what was given."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gaussian_scenes import leaves, random_rgbt_scene, random_scene
from thermosplat import UserError, rasterization, rasterization_rgbt, spherical_harmonics


def scene_with(**changes: Any) -> dict[str, Any]:
    """A small float32 scene with some arguments replaced."""
    scene = leaves(random_scene(n=4, cameras=2), "cpu", torch.float32)
    return {key: value.detach() if isinstance(value, torch.Tensor) else value for key, value in scene.items()} | changes


def tangent(function: Any) -> Any:
    """torch.func.jvp in the form of its other transforms."""
    return lambda x: torch.func.jvp(function, (x,), (torch.ones_like(x),))


@pytest.mark.parametrize(
    ("name", "value", "in_place"),
    [
        ("camera_model", "lidar", "one of 'pinhole', 'ortho', 'fisheye', 'ftheta', got 'lidar'"),
        ("lidar_coeffs", object(), "pinhole, ortho, fisheye or ftheta"),
        ("external_distortion_coeffs", object(), "radial_coeffs"),
        ("ut_params", object(), "alpha = 0.1"),
        ("ut_params", SimpleNamespace(alpha=0.5, beta=2.0, kappa=0.0), "alpha = 0.1"),
        ("renderer_config", object(), "in one way"),
    ],
)
def test_unsupported_arguments_are_named(name: str, value: Any, in_place: str) -> None:
    """Each of gsplat's arguments that we do not support is named, with what there is."""
    with pytest.raises(UserError, match=in_place) as caught:
        rasterization(**scene_with(**{name: value}))
    assert name in str(caught.value)


def test_gsplat_defaults_are_accepted() -> None:
    """The defaults of the unsupported arguments, and tuning knobs without influence, are no errors."""
    plain = rasterization(**scene_with())[0]
    same = rasterization(
        **scene_with(
            sparse_grad=False,
            tile_size=None,
            distributed=False,
            with_ut=False,
            with_eval3d=False,
            radial_coeffs=None,
            viewmats_rs=None,
            channel_chunk=2,
            segmented=True,
            ut_params=SimpleNamespace(alpha=np.float32(0.1), beta=2.0, kappa=0.0),
            renderer_config=type("RendererConfig_MixedBatch", (), {})(),
        )
    )[0]
    assert torch.equal(plain, same)


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev, tangent], ids=["grad", "jacrev", "jvp"])
def test_transforms_of_torch_func_are_refused(transform: Any) -> None:
    """In one sentence, by the steps too; torch.autograd's jacobian works."""
    scene = scene_with()
    means = scene.pop("means")

    def total(means: torch.Tensor) -> torch.Tensor:
        return rasterization(means=means, **scene)[0].sum()

    def harmonics(means: torch.Tensor) -> torch.Tensor:
        return spherical_harmonics(0, means, torch.ones(4, 1, 3)).sum()

    for function in (total, harmonics):
        with pytest.raises(UserError, match=r"Renders are differentiated by torch\.autograd"):
            transform(function)(means)
    assert torch.autograd.functional.jacobian(total, means).norm() > 0


def test_numpys_integers_are_sizes() -> None:
    """Image sizes read from an array's shape or a file are whole numbers too; halves of pixels are none."""
    scene = scene_with()
    sizes = {"width": np.int64(scene["width"]), "height": np.int32(scene["height"])}
    image, _, info = rasterization(**scene | sizes)
    assert torch.equal(image, rasterization(**scene)[0])
    assert type(info["width"]) is type(info["height"]) is int
    for size in (8.5, 8.0, "8", torch.tensor(8.0), True, np.True_, torch.tensor(True)):
        with pytest.raises(UserError, match="width must be a positive whole number of pixels"):
            rasterization(**scene_with(width=size))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sh_degree", np.int64(2)),
        ("sh_degree", torch.tensor(2)),
        ("tile_size", np.int64(8)),
        ("channel_chunk", np.int32(2)),
        ("near_plane", np.float32(0.5)),
        ("near_plane", torch.tensor(0.5)),
        ("far_plane", np.float32(7.0)),
        ("radius_clip", np.int64(3)),
        ("eps2d", np.float32(0.5)),
    ],
)
def test_numbers_of_other_libraries_are_numbers(name: str, value: Any) -> None:
    """Those of NumPy and torch mean what Python's do."""
    scene = leaves(random_scene(n=20, sh_degree=2), "cpu", torch.float32)
    given, expected = (rasterization(**scene | {name: number})[0] for number in (value, value.item()))
    assert torch.equal(given, expected)
    given.sum().backward()


def test_numpys_degree_of_features() -> None:
    """The features' degree is a number like the colours'; there are as many degrees, and 1.0 or True is none."""
    scene = rgbt_with(features=torch.randn(4, 25, 3))
    given, expected = (rasterization_rgbt(**scene, features_sh_degree=degree) for degree in (np.int64(1), 1))
    assert torch.equal(given.render_features, expected.render_features)
    for degree in (5, 1.0, True):
        with pytest.raises(UserError, match="features_sh_degree must be one of None, 0, 1, 2, 3, 4"):
            rasterization_rgbt(**scene, features_sh_degree=degree)


@pytest.mark.parametrize("channel_chunk", [0, -1, 2.5])
def test_chunks_have_channels(channel_chunk: float) -> None:
    """No channel at a time would never end, and channels cannot be divided."""
    with pytest.raises(UserError, match="channel_chunk must be at least 1"):
        rasterization(**scene_with(channel_chunk=channel_chunk))


def test_gsplats_global_shutter_is_accepted() -> None:
    """gsplat's own default of rolling_shutter means no rolling shutter."""
    wrapper = pytest.importorskip("gsplat.cuda._wrapper", reason="gsplat 1.5.3 is not installed")
    rasterization(**scene_with(rolling_shutter=wrapper.RollingShutterType.GLOBAL))
    with pytest.raises(UserError, match="rolling_shutter"):
        rasterization(**scene_with(rolling_shutter=wrapper.RollingShutterType.ROLLING_TOP_TO_BOTTOM))


SHAPES = [
    ("quats", (5, 4), "[4, 4]"),
    ("means", (4, 2), "N, 3]"),
    ("scales", (4, 4), "[4, 3]"),
    ("opacities", (4, 1), "[4]"),
    ("colors", (5, 3), "N = 4"),
    ("viewmats", (2, 3, 4), "C, 4, 4]"),
    ("Ks", (3, 3, 3), "[2, 3, 3]"),
    ("backgrounds", (2, 4), "[2, 3]"),
    ("backgrounds", (3,), "[2, 3]"),
    ("covars", (4, 5), "[4, 3, 3]"),
]


@pytest.mark.parametrize(("name", "shape", "expected"), SHAPES)
def test_wrong_shapes(name: str, shape: tuple[int, ...], expected: str) -> None:
    """The argument, the expected shape with its numbers and the given shape, in one sentence."""
    with pytest.raises(UserError) as caught:
        rasterization(**scene_with(**{name: torch.zeros(shape)}))
    text = str(caught.value)
    assert text.startswith(name), text
    assert expected in text, text
    assert str(list(shape)) in text, text
    assert text.count(". ") == 0
    assert text.endswith(".")


def test_shape_message_is_the_documented_sentence() -> None:
    """The letter of the message users see most."""
    with pytest.raises(UserError) as caught:
        rasterization(**scene_with(quats=torch.zeros(5, 4)))
    assert str(caught.value) == "quats must have shape [4, 4] = [..., N, 4] with N from means, got [5, 4]."


@pytest.mark.parametrize(
    ("colors", "sh_degree", "expected"),
    [
        ((4, 3), 1, "K"),  # SH asked for, features given
        ((4, 3, 3), 1, "4"),  # fewer coefficients than the degree needs
        ((4, 4, 0), 1, "at least one channel"),
        ((4, 16, 3), 5, "0, 1, 2, 3, 4"),
        ((4, 16, 3), -1, "0, 1, 2, 3"),
        ((3, 4, 5), None, "colors"),  # three cameras' colours for two cameras
        ((4, 0), None, "at least one channel"),
    ],
)
def test_wrong_colors(colors: tuple[int, ...], sh_degree: int | None, expected: str) -> None:
    """Colours that do not fit the Gaussians, the cameras, the SH degree or the kernels."""
    with pytest.raises(UserError) as caught:
        rasterization(**scene_with(colors=torch.zeros(colors), sh_degree=sh_degree, backgrounds=None))
    assert expected in str(caught.value)
    assert "colors" in str(caught.value) or "sh_degree" in str(caught.value)


@pytest.mark.parametrize("name", ["quats", "opacities", "colors", "viewmats", "Ks", "backgrounds"])
def test_mixed_dtypes(name: str) -> None:
    """One tensor in another dtype than means: which, what it is, what it should be."""
    with pytest.raises(UserError) as caught:
        rasterization(**scene_with(**{name: scene_with()[name].double()}))
    text = str(caught.value)
    assert name in text
    assert "float32" in text
    assert "float64" in text


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int32])
def test_unsupported_dtypes(dtype: torch.dtype) -> None:
    """Half precision and integers are refused by name, with what is supported."""
    scene = {k: v.to(dtype) if isinstance(v, torch.Tensor) else v for k, v in scene_with().items()}
    with pytest.raises(UserError) as caught:
        rasterization(**scene)
    assert str(dtype).removeprefix("torch.") in str(caught.value)
    assert "float32" in str(caught.value)


@pytest.mark.parametrize("name", ["scales", "colors", "Ks"])
def test_mixed_devices(name: str) -> None:
    """A tensor on another device than means is named with both devices."""
    with pytest.raises(UserError) as caught:
        rasterization(**scene_with(**{name: scene_with()[name].to("meta")}))
    text = str(caught.value)
    assert name in text
    assert "meta" in text
    assert "cpu" in text


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("width", 0, "width"),
        ("height", -3, "height"),
        ("width", 20.5, "width"),
        ("tile_size", 7, "8, 16"),
        ("render_mode", "depth", "RGB+ED"),
        ("rasterize_mode", "smooth", "antialiased"),
        ("camera_model", "pin hole", "pinhole"),
        ("tile_size", 16.0, "8, 16"),
        ("tile_size", True, "8, 16"),
        ("sh_degree", 1.5, "sh_degree"),
        ("sh_degree", 1.0, "0, 1, 2, 3"),
        ("sh_degree", True, "0, 1, 2, 3"),
        ("near_plane", "near", "must be a number"),
        ("far_plane", None, "must be a number"),
        ("eps2d", -1.0, "eps2d"),
        ("radius_clip", float("nan"), "radius_clip"),
    ],
)
def test_wrong_values(name: str, value: Any, expected: str) -> None:
    """Numbers and words out of range: the argument, what is allowed, what was given."""
    with pytest.raises(UserError) as caught:
        rasterization(**scene_with(**{name: value}))
    text = str(caught.value)
    assert name in text
    assert expected in text
    assert str(value) in text


@pytest.mark.parametrize("name", ["means", "opacities", "colors", "viewmats", "Ks"])
def test_what_is_no_tensor(name: str) -> None:
    """None, lists and arrays in place of tensors."""
    for value in (None, [1.0, 2.0]):
        with pytest.raises(UserError, match=name):
            rasterization(**scene_with(**{name: value}))


def test_missing_geometry() -> None:
    """Neither quats and scales nor covars."""
    with pytest.raises(UserError, match="covars"):
        rasterization(**scene_with(quats=None, scales=None))
    with pytest.raises(UserError, match="scales"):
        rasterization(**scene_with(scales=None))


def rgbt_with(**changes: Any) -> dict[str, Any]:
    """A small float32 scene for rasterization_rgbt with some arguments replaced."""
    scene = leaves(random_rgbt_scene(n=4, cameras=2), "cpu", torch.float32)
    return {key: value.detach() if isinstance(value, torch.Tensor) else value for key, value in scene.items()} | changes


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("features", (5, 8)),
        ("features", (4,)),
        ("thermal_opacities", (5,)),
        ("colors", (5, 3)),
        ("backgrounds", (2, 11)),
        ("quats", (4, 3)),
    ],
)
def test_wrong_shapes_of_rgbt(name: str, shape: tuple[int, ...]) -> None:
    """The arguments rasterization_rgbt adds are checked like the others."""
    with pytest.raises(UserError) as caught:
        rasterization_rgbt(**rgbt_with(**{name: torch.zeros(shape)}))
    assert str(caught.value).startswith(name)
    assert str(list(shape)) in str(caught.value)


def test_rgbt_refuses_other_values() -> None:
    """Dtypes, modes and cameras, as rasterization does."""
    with pytest.raises(UserError, match="thermal_opacities"):
        rasterization_rgbt(**rgbt_with(thermal_opacities=rgbt_with()["thermal_opacities"].double()))
    with pytest.raises(UserError, match="camera_model"):
        rasterization_rgbt(**rgbt_with(camera_model="lidar"))
    with pytest.raises(UserError, match="rasterize_mode"):
        rasterization_rgbt(**rgbt_with(rasterize_mode="soft"))


def test_more_than_the_kernels_can_number() -> None:
    """Gaussians times images, or rows of images, beyond 32 bits: refused before anything is allocated."""
    n, cameras = 2**26, 64  # views without memory of their own
    scene = random_scene(n=1)
    tensors = {
        name: scene[name].expand(n, *scene[name].shape[1:]) for name in ("means", "quats", "scales", "opacities")
    }
    views = {name: scene[name].expand(cameras, *scene[name].shape[1:]) for name in ("viewmats", "Ks")}
    colors = scene["colors"].expand(n, 3)
    with pytest.raises(UserError, match="67,108,864 Gaussians in each of 64 images of 23 x 18 px are more than"):
        rasterization(**tensors, **views, colors=colors, width=23, height=18)
    views = {name: scene[name].expand(256, *scene[name].shape[1:]) for name in ("viewmats", "Ks")}
    with pytest.raises(UserError, match="1 Gaussians in each of 256 images of 1 x 16777216 px are more than"):
        rasterization(**scene | views | {"width": 1, "height": 2**24, "backgrounds": None})


@pytest.mark.parametrize("value", [2**24 + 1, 3_000_000_000, 2**70, 10**5000], ids=["next", "wide", "wider", "endless"])
def test_sizes_have_a_limit(value: int) -> None:
    """Beyond it a pixel has no place of its own in float32; sizes that torch cannot take are told the same way."""
    for name in ("width", "height"):
        with pytest.raises(UserError, match=rf"^{name} must be at most 16,777,216 pixels, got .{{1,80}}\.$"):
            rasterization(**scene_with(**{name: value}))


@pytest.mark.parametrize("name", ["means", "opacities", "colors", "viewmats", "backgrounds"])
def test_sparse_tensors_are_named(name: str) -> None:
    """Torch's own words would be of a memory format."""
    tensors = scene_with(backgrounds=torch.zeros(2, 3))
    tensors["viewmats"], tensors["Ks"] = (tensors[one].expand(2, *tensors[one].shape[1:]) for one in ("viewmats", "Ks"))
    with pytest.raises(UserError, match=rf"^{name} must be a dense tensor, got one of layout sparse_coo\."):
        rasterization(**tensors | {name: tensors[name].to_sparse()})


def test_other_devices_are_named() -> None:
    """Of all tensors."""
    scene = {name: one.to("meta") if isinstance(one, torch.Tensor) else one for name, one in scene_with().items()}
    with pytest.raises(UserError, match=r"means must be on the CPU or on a CUDA device, got meta"):
        rasterization(**scene)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_backgrounds_are_finite(value: float) -> None:
    """Every pixel would be what they are; a gradient is no obstacle to looking."""
    scene = scene_with()
    backgrounds = torch.zeros(len(scene["viewmats"]), scene["colors"].shape[-1])
    backgrounds[0, 1] = value
    with pytest.raises(UserError, match="backgrounds must be finite"):
        rasterization(**scene | {"backgrounds": backgrounds.requires_grad_()})
    assert rasterization(**scene | {"backgrounds": torch.ones_like(backgrounds)})[0].isfinite().all()


def test_numbers_too_large_for_a_float() -> None:
    """Python's whole numbers have no end."""
    with pytest.raises(UserError, match=r"^far_plane must be a number, got 1000+\.\.\.\.$"):
        rasterization(**scene_with(far_plane=10**400))
