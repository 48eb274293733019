"""What gsplat's main branch renders beside colours, against the dense reference: images and every gradient."""

from typing import Any

import pytest
import torch
from torch import Tensor

import reference_rasterizer
from gaussian_scenes import assert_matches_reference, leaves, random_scene, relative_error
from thermosplat import UserError, rasterization, spherical_harmonics

pytestmark = pytest.mark.rotating

DTYPES = [torch.float32, torch.float64]


def with_extras(render: Any) -> Any:
    """A renderer whose image has the extra signals behind its other channels."""

    def rendered(**scene: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        image, alphas, info = render(**scene)
        return torch.cat([info["render_extra_signals"], image], -1), alphas, info

    return rendered


def assert_extras_match(scene: dict[str, Any], device: torch.device, dtype: torch.dtype) -> None:
    """Colours, extra signals and gradients are the reference's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reference_rasterizer, "rasterization", with_extras(reference_rasterizer.rasterization))
        assert_matches_reference(with_extras(rasterization), scene, device, dtype)


def signals(scene: dict[str, Any], *shape: int, seed: int = 3) -> Tensor:
    """Random extra signals, some below zero, that float32 holds exactly."""
    lead = scene["means"].shape[:-1]
    values = torch.randn(*lead, *shape, generator=torch.Generator().manual_seed(seed))
    return (0.5 * values).double()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", [None, 0, 3, 4])
@pytest.mark.parametrize("channels", [1, 5])
def test_extra_signals(device: torch.device, channels: int, degree: int | None, dtype: torch.dtype) -> None:
    """Values, and sums of spherical harmonics of any number of channels, which are not clamped at 0."""
    scene = random_scene(cameras=2, sh_degree=2, n=30)
    shape = (channels,) if degree is None else ((degree + 1) ** 2, channels)
    scene |= {"extra_signals": signals(scene, *shape), "extra_signals_sh_degree": degree}
    assert_extras_match(scene, device, dtype)


@pytest.mark.parametrize("render_mode", ["RGB+D", "RGB+ED"])
def test_extra_signals_beside_depth(device: torch.device, render_mode: str) -> None:
    """The depth is still the last channel of the image; a background of all channels lies behind the signals too."""
    scene = random_scene(n=30, render_mode=render_mode)
    scene["extra_signals"] = signals(scene, 2)
    assert_extras_match(scene, device, torch.float64)
    scene["backgrounds"] = torch.rand(1, 5, generator=torch.Generator().manual_seed(1)).double()
    assert_extras_match(scene, device, torch.float64)


def test_extra_signals_of_each_camera_in_batches(device: torch.device) -> None:
    """Leading dimensions, and signals that differ between cameras."""
    scene = random_scene(n=20, batch=(2,), cameras=3, per_camera_colors=True)
    scene["extra_signals"] = torch.rand(2, 3, 20, 4, generator=torch.Generator().manual_seed(1)).double()
    assert_extras_match(scene, device, torch.float64)


@pytest.mark.parametrize("render_mode", ["D", "ED"])
def test_extra_signals_without_colors(device: torch.device, render_mode: str) -> None:
    """Depth and signals are those that colours would have beside them."""
    scene = leaves(random_scene(n=30, backgrounds=False), device, torch.float64)
    extra = signals(scene, 4).to(device)
    plain = rasterization(**scene | {"render_mode": f"RGB+{render_mode}"}, extra_signals=extra)
    scene["colors"] = None
    image, _, info = rasterization(**scene, render_mode=render_mode, extra_signals=extra)
    torch.testing.assert_close(image, plain[0][..., 3:])
    torch.testing.assert_close(info["render_extra_signals"], plain[2]["render_extra_signals"])


def test_a_non_finite_signal_hides_its_gaussian(device: torch.device) -> None:
    """As a colour that is not finite does; it is counted."""
    scene = random_scene(n=30)
    scene["extra_signals"] = signals(scene, 2)
    scene["extra_signals"][3, 1] = torch.nan
    assert_extras_match(scene, device, torch.float64)
    assert rasterization(**leaves(scene, device, torch.float32))[2]["num_nonfinite"] == 1


@pytest.mark.parametrize("channels", [1, 2, 4, 7])
def test_harmonics_of_any_number_of_channels(device: torch.device, channels: int) -> None:
    """Colours of other than three channels, clamped at 0 as gsplat's are."""
    scene = random_scene(n=30, cameras=2, sh_degree=2)
    scene["colors"] = signals(scene, 9, channels)
    scene["backgrounds"] = torch.rand(2, channels, generator=torch.Generator().manual_seed(1)).double()
    assert_matches_reference(rasterization, scene, device, torch.float64)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+D", "ED"])
@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
def test_order_by_distance(device: torch.device, camera_model: str, render_mode: str, dtype: torch.dtype) -> None:
    """With global_z_order=False order and depth are distances, whose gradients reach means and poses."""
    scene = random_scene(cameras=2, render_mode=render_mode, camera_model=camera_model, seed=4)
    scene["means"] = scene["means"] * torch.tensor([1.6, 1.6, 1.0])  # far from the axis, where the orders differ
    assert_matches_reference(rasterization, scene | {"global_z_order": False}, device, dtype)
    near, far = (
        rasterization(**leaves(scene, device, torch.float32), global_z_order=by_z)[0] for by_z in (True, False)
    )
    assert not torch.allclose(near, far, atol=1e-3)


@pytest.mark.parametrize("render_mode", ["D", "ED"])
def test_depth_needs_no_colors(device: torch.device, render_mode: str) -> None:
    """colors=None renders the same depth, with the same gradients."""
    scene = random_scene(n=30, render_mode=render_mode, backgrounds=False)
    given, without = leaves(scene, device, torch.float64), leaves(scene | {"colors": None}, device, torch.float64)
    images = [rasterization(**inputs)[0] for inputs in (given, without)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    for name in ("means", "quats", "scales", "opacities", "viewmats", "Ks"):
        error = relative_error(without[name].grad, given[name].grad)
        assert error == 0.0 or (device.type == "cuda" and error < 1e-12)  # there the order of additions is not fixed


@pytest.mark.parametrize("pair", [False, True])
@pytest.mark.parametrize("batch", [(2,), (1, 2)])
def test_coefficients_that_scenes_share(device: torch.device, batch: tuple[int, ...], pair: bool) -> None:
    """[N, K, D], as gsplat's main branch has them, are those of every scene, and get the sum of their gradients."""
    scene = random_scene(n=20, cameras=2, batch=batch, sh_degree=1)
    own = scene.pop("colors")[(0,) * len(batch)].to(device)
    rest, results = leaves(scene, device, torch.float64), []
    signals = torch.randn(20, 4, 2, dtype=torch.float64, device=device)
    for expand in (False, True):
        given = [one.detach().clone().requires_grad_() for one in (own, signals)]
        colors, extra = (one.expand(*batch, *one.shape) if expand else one for one in given)
        if pair:
            colors = (colors[..., :1, :], colors[..., 1:, :])
        image, _, info = rasterization(**rest, colors=colors, extra_signals=extra, extra_signals_sh_degree=1)
        (image.square().sum() + info["render_extra_signals"].square().sum()).backward()
        results.append([image.detach(), info["render_extra_signals"].detach(), *[one.grad for one in given]])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_coefficients_of_16_bits(device: torch.device, dtype: torch.dtype) -> None:
    """They are rendered as the numbers that they are, and get gradients of their own type."""
    scene = random_scene(n=20, sh_degree=2)
    half, single = leaves(scene, device, torch.float32), leaves(scene, device, torch.float32)
    half["colors"] = half["colors"].detach().to(dtype).requires_grad_()
    single["colors"] = half["colors"].detach().float().requires_grad_()
    images = [rasterization(**inputs)[0] for inputs in (half, single)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    assert half["colors"].grad.dtype == dtype
    torch.testing.assert_close(half["colors"].grad, single["colors"].grad.to(dtype))
    shown = [spherical_harmonics(2, one["means"], one["colors"]) for one in (half, single)]
    assert torch.equal(*shown)


@pytest.mark.parametrize("name", ["colors", "extra_signals"])
def test_coefficients_without_channels_are_refused(name: str) -> None:
    """Any number of channels is rendered, but not none."""
    scene = random_scene(n=4, sh_degree=1)
    scene |= {name: torch.zeros(4, 4, 0, dtype=torch.float64), f"{'extra_signals_' * (name != 'colors')}sh_degree": 1}
    with pytest.raises(UserError, match=rf"{name} must have at least one channel, got \[4, 4, 0\]"):
        rasterization(**scene)
    with pytest.raises(UserError, match="coeffs must have at least one channel"):
        spherical_harmonics(1, scene["means"], torch.zeros(4, 4, 0, dtype=torch.float64))


def test_triangles_of_covariances(device: torch.device) -> None:
    """[..., N, 6] mean what matrices do, with gradients, sparse ones too."""
    scene = random_scene(n=20, with_covars=True)
    scene["covars"] = scene["covars"][..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    assert_matches_reference(rasterization, scene, device, torch.float64, reference=of_triangles)
    inputs = leaves(scene, device, torch.float64)
    rasterization(**inputs, sparse_grad=True)[0].square().sum().backward()
    assert inputs["covars"].grad.is_sparse


def of_triangles(covars: torch.Tensor, **scene: Any) -> Any:
    """The reference, of upper triangles."""
    full = covars[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))
    return reference_rasterizer.rasterization(covars=full, **scene)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "covars"])
def test_sparse_gradients(device: torch.device, name: str) -> None:
    """Rows of the Gaussians that some camera draws, with the dense gradient's numbers; SparseAdam takes them."""
    scene = random_scene(n=40, cameras=2, sh_degree=2, with_covars=name == "covars")
    scene["means"][::3] *= -50.0  # behind the cameras, or far off
    dense, sparse = leaves(scene, device, torch.float64), leaves(scene, device, torch.float64)
    rasterization(**dense)[0].square().sum().backward()
    image, _, info = rasterization(**sparse, sparse_grad=True)
    image.square().sum().backward()
    found = sparse[name].grad
    assert found.is_sparse
    torch.testing.assert_close(found.to_dense(), dense[name].grad, rtol=1e-12, atol=1e-14)
    drawn = info["visible"].any(0)
    assert 0 < drawn.sum() < 40
    assert torch.equal(found.coalesce().indices()[0], drawn.nonzero()[:, 0])
    assert not sparse["opacities"].grad.is_sparse
    torch.optim.SparseAdam([sparse[name]], lr=0.1).step()
    assert torch.equal(sparse[name][~drawn], dense[name][~drawn])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"colors": None}, "colors must be given with render_mode='RGB'"),
        ({"colors": None, "render_mode": "D", "sh_degree": 2}, "sh_degree must be None where colors is None"),
        ({"sparse_grad": True, "packed": False}, "sparse_grad=True needs packed=True"),
        ({"extra_signals": torch.zeros(3, 2)}, r"extra_signals without sh_degree must have shape"),
        ({"extra_signals": [1.0]}, "extra_signals must be a torch.Tensor"),
        ({"means": torch.zeros(4, 3).to_sparse(), "sparse_grad": True}, "means must be a dense tensor"),
        ({"colors": torch.zeros(4, 4, 5).to_sparse(), "sh_degree": 1}, "colors must be a dense tensor"),
        ({"extra_signals": torch.zeros(4, 9, 2), "extra_signals_sh_degree": 3}, "at least 16 coefficients"),
        ({"extra_signals": torch.zeros(4, 1, 2), "extra_signals_sh_degree": 5}, "extra_signals_sh_degree must be"),
        ({"backgrounds": torch.zeros(2, 4)}, r"backgrounds must have shape \[2, 3\]"),
    ],
)
def test_what_does_not_go_together_is_told(changes: dict[str, Any], said: str) -> None:
    """One sentence that names the argument."""
    scene = leaves(random_scene(n=4, cameras=2), "cpu", torch.float32)
    with pytest.raises(UserError, match=said):
        rasterization(**scene | changes)


def test_sparse_gradients_are_of_one_scene() -> None:
    """Leading dimensions are refused, as gsplat refuses them."""
    scene = leaves(random_scene(n=4, batch=(2,)), "cpu", torch.float32)
    with pytest.raises(UserError, match=r"means must have shape \[N, 3\] with sparse_grad=True"):
        rasterization(**scene, sparse_grad=True)
