"""gsplat's steps one after the other: images and gradients are the dense reference's, values those of gsplat's own."""

import inspect
from typing import Any

import pytest
import torch
from torch import Tensor

import gsplat_reference
import reference_projection
from gaussian_scenes import assert_matches_reference, leaves, random_scene
from thermosplat import (
    UserError,
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    rasterization,
    rasterize_to_pixels,
    spherical_harmonics,
)

pytestmark = pytest.mark.rotating

TILE = 8


def chained(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    backgrounds: Tensor | None = None,
    sh_degree: int | None = None,
    rasterize_mode: str = "classic",
    camera_model: Any = "pinhole",
    *,
    exact: bool = False,
    masks: Tensor | None = None,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """What a trainer writes that calls gsplat's steps itself."""
    antialiased = rasterize_mode == "antialiased"
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        means, None, quats, scales, viewmats, Ks, width, height, calc_compensations=antialiased,
        camera_model=camera_model, opacities=opacities,
    )  # fmt: skip
    per_image = opacities.unsqueeze(-2).expand(radii.shape[:-1])
    per_image = per_image * compensations if antialiased else per_image
    if sh_degree is None:
        shown = colors.unsqueeze(-3).expand(*radii.shape[:-1], colors.shape[-1])
    else:
        sums = spherical_harmonics(sh_degree, means, viewmats, colors, masks=(radii > 0).all(-1))
        shown = (sums + 0.5).clamp(min=0.0)
    tiles = -(-width // TILE), -(-height // TILE)
    further = {"conics": conics, "opacities": per_image} if exact else {}
    _, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, TILE, *tiles, **further)
    images = radii.shape[:-2].numel()
    offsets = isect_offset_encode(isect_ids, images, *tiles).reshape(*radii.shape[:-2], tiles[1], tiles[0])
    lists = (TILE, offsets, flatten_ids)
    image, alphas = rasterize_to_pixels(
        means2d, conics, shown, per_image, width, height, *lists, backgrounds, masks, absgrad=absgrad
    )
    return image, alphas, {"pairs": len(flatten_ids), "means2d": means2d}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_steps_render_what_rasterization_does(
    device: torch.device, rasterize_mode: str, camera_model: str, dtype: torch.dtype
) -> None:
    """Two cameras and backgrounds, every gradient."""
    scene = random_scene(cameras=2, n=40, rasterize_mode=rasterize_mode, camera_model=camera_model)
    # conics in float32 have lost what their roots keep
    how = {"image_tolerance": 2e-5, "gradient_tolerance": 1e-4} if dtype == torch.float32 else {}
    assert_matches_reference(chained, scene, device, dtype, **how)


@pytest.mark.parametrize("sh_degree", [0, 2, 4])
def test_steps_with_harmonics(device: torch.device, sh_degree: int) -> None:
    """Colours of spherical harmonics, with their gradients to means and poses."""
    scene = random_scene(cameras=2, n=30, sh_degree=sh_degree)
    # gsplat's cameras are -Rᵀ t of a rigid matrix: only of those are the gradients the same
    scene["viewmats"] = rigid(scene["viewmats"])
    result = chained(**scene)
    expected = rasterization(**scene, packed=False)
    torch.testing.assert_close(result[0], expected[0], atol=1e-12, rtol=1e-12)
    ours, theirs = leaves(scene, device, torch.float64), leaves(scene, device, torch.float64)
    chained(**ours)[0].square().sum().backward()
    rasterization(**theirs)[0].square().sum().backward()
    for name in ("means", "quats", "scales", "opacities", "colors", "Ks"):
        torch.testing.assert_close(ours[name].grad, theirs[name].grad, atol=1e-10, rtol=1e-9)


def rigid(viewmats: Tensor) -> Tensor:
    """The nearest matrices with rotations, in float64."""
    u, _, v = torch.linalg.svd(viewmats[..., :3, :3])
    found = viewmats.clone()
    found[..., :3, :3] = u @ v
    return found


@pytest.mark.parametrize("channels", [1, 33])
def test_batches_and_many_channels(device: torch.device, channels: int) -> None:
    """Leading dimensions; more channels than one traversal blends."""
    scene = random_scene(n=20, batch=(2,), cameras=2, channels=channels)
    assert_matches_reference(chained, scene, device, torch.float64)


def test_exact_tiles_render_the_same_from_fewer_pairs(device: torch.device) -> None:
    """With conics and opacities, as gsplat's main branch has it, only pairs that no pixel sees are left out."""
    scene = leaves(random_scene(n=60, seed=1), device, torch.float64)
    scene["scales"] = scene["scales"].detach() * torch.tensor([1.0, 0.1, 0.1], device=device)
    boxes, exact = chained(**scene), chained(**scene, exact=True)
    assert torch.equal(boxes[0], exact[0])
    assert 0 < exact[2]["pairs"] < boxes[2]["pairs"]


def test_chosen_tiles_are_drawn_and_others_show_the_background(device: torch.device) -> None:
    """masks: images and gradients are those of the chosen tiles' pixels alone."""
    scene = random_scene(n=40, width=23, height=18)
    masks = torch.tensor([[[1, 0, 1], [0, 1, 0], [1, 1, 0]]], dtype=torch.bool, device=device)
    pixels = masks.repeat_interleave(TILE, 1).repeat_interleave(TILE, 2)[:, :18, :23, None]
    some, all_ = leaves(scene, device, torch.float64), leaves(scene, device, torch.float64)
    image, alphas, _ = chained(**some, masks=masks)
    whole, whole_alphas, _ = chained(**all_)
    background = all_["backgrounds"][:, None, None, :].expand_as(whole)
    torch.testing.assert_close(image, torch.where(pixels, whole, background))
    torch.testing.assert_close(alphas, torch.where(pixels, whole_alphas, 0.0))
    image.square().sum().backward()
    torch.where(pixels, whole, background).square().sum().backward()
    for name in ("means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats", "Ks"):
        torch.testing.assert_close(some[name].grad, all_[name].grad)


def test_packed_steps(device: torch.device) -> None:
    """Packed projections are the visible rows, and render the same."""
    scene = leaves(random_scene(n=30, cameras=2), device, torch.float64)
    scene["means"] = scene["means"].detach().clone()
    scene["means"][::4] *= -40.0
    geometry = [scene[name] for name in ("quats", "scales", "viewmats", "Ks", "width", "height")]
    dense = fully_fused_projection(scene["means"], None, *geometry, calc_compensations=True)
    batch_ids, camera_ids, gaussian_ids, *rows = fully_fused_projection(
        scene["means"], None, *geometry, calc_compensations=True, packed=True
    )
    assert not batch_ids.any()
    for row, full in zip(rows, dense, strict=True):
        assert torch.equal(row, full[camera_ids, gaussian_ids])
    assert len(gaussian_ids) == (dense[0] > 0).all(-1).sum() < 60
    radii, means2d, depths, conics, _ = rows
    tiles = -(-scene["width"] // TILE), -(-scene["height"] // TILE)
    packed = {"packed": True, "n_images": 2, "image_ids": camera_ids, "gaussian_ids": gaussian_ids}
    counts, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, TILE, *tiles, **packed)
    assert counts.sum() == len(flatten_ids)
    offsets = isect_offset_encode(isect_ids, 2, *tiles)
    image, _ = rasterize_to_pixels(
        means2d, conics, scene["colors"][gaussian_ids], scene["opacities"][gaussian_ids],
        scene["width"], scene["height"], TILE, offsets, flatten_ids, scene["backgrounds"], packed=True,
    )  # fmt: skip
    torch.testing.assert_close(image, chained(**scene)[0], atol=1e-12, rtol=1e-12)
    image.sum().backward()
    assert scene["colors"].grad.isfinite().all()


def test_sparse_gradients_of_a_packed_projection(device: torch.device) -> None:
    """As gsplat's: rows of visible Gaussians."""
    scene = leaves(random_scene(n=30), device, torch.float64)
    scene["means"].data[::2] *= -40.0
    geometry = [scene[name] for name in ("quats", "scales", "viewmats", "Ks", "width", "height")]
    *_, gaussian_ids, _, means2d, _, _, _ = fully_fused_projection(
        scene["means"], None, *geometry, packed=True, sparse_grad=True
    )
    means2d.sum().backward()
    assert scene["means"].grad.is_sparse
    assert torch.equal(scene["means"].grad.coalesce().indices()[0], gaussian_ids)


def test_covariances_as_upper_triangles(device: torch.device) -> None:
    """Six numbers for each Gaussian mean the same as its quaternion and scales."""
    scene = random_scene(n=20, with_covars=True)
    upper = scene["covars"][..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].to(device)
    camera = [scene[name].to(device) for name in ("viewmats", "Ks")]
    size = scene["width"], scene["height"]
    radii, means2d, _, conics, _ = fully_fused_projection(scene["means"].to(device), upper, None, None, *camera, *size)
    *_, info = rasterization(**leaves(scene, device, torch.float64), packed=False)
    drawn = (info["radii"] > 0).all(-1)
    assert (radii[drawn] >= info["radii"][drawn]).all()  # without opacities they are no smaller
    torch.testing.assert_close(means2d[drawn], info["means2d"][drawn])
    torch.testing.assert_close(conics[drawn], info["conics"][drawn])


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("with_covars", [False, True])
def test_gradients_of_a_projection_are_differences(device: torch.device, with_covars: bool, camera_model: str) -> None:
    """Of positions, depths, conics and compensations to all that is projected, upper triangles too."""
    scene = leaves(random_scene(n=3, with_covars=with_covars), device, torch.float64)
    drawn = ["covars"] if with_covars else ["quats", "scales"]
    if with_covars:
        scene["covars"] = scene["covars"].detach()[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].requires_grad_()
    inputs = [scene[name] for name in ("means", *drawn, "viewmats", "Ks")]

    def projected(means: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
        *shapes, viewmats, Ks = others
        given = (*shapes, None, None) if with_covars else (None, *shapes)
        radii, *found = fully_fused_projection(
            means, *given, viewmats, Ks, scene["width"], scene["height"], calc_compensations=True,
            camera_model=camera_model,
        )  # fmt: skip
        assert (radii > 0).any()
        return tuple(found)

    assert torch.autograd.gradcheck(projected, inputs, eps=1e-6, atol=1e-5, rtol=1e-4)


def test_absgrad_is_where_gsplat_has_it(device: torch.device) -> None:
    """On the tensor that was given."""
    scene = leaves(random_scene(n=30), device, torch.float64)
    image, _, info = chained(**scene, absgrad=True)
    info["means2d"].retain_grad()
    image.square().sum().backward()
    assert (info["means2d"].absgrad >= info["means2d"].grad.abs() - 1e-12).all()
    assert info["means2d"].absgrad.sum() > info["means2d"].grad.abs().sum()


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho", "fisheye"])
def test_projections_are_those_of_gsplats_reference(device: torch.device, camera_model: Any) -> None:
    """Values and gradients of gsplat's own torch code, of Gaussians all over a wide image."""
    reference = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat 1.5.3 is not installed")
    scene = random_scene(n=60, cameras=2, width=60, height=50, camera_model=camera_model)
    scene["means"] = 1.5 * scene["means"]
    scene["Ks"][..., [0, 1], [0, 1]] = torch.tensor([20.0, 18.0], dtype=torch.float64)
    found = []
    for ours in (True, False):
        at = leaves(scene, device if ours else "cpu", torch.float64)
        shape, camera = (at["quats"], at["scales"]), (at["viewmats"], at["Ks"], 60, 50)
        if ours:
            results = fully_fused_projection(at["means"], None, *shape, *camera, camera_model=camera_model)
        else:
            covars, _ = reference._quat_scale_to_covar_preci(*shape, compute_preci=False, triu=False)
            results = reference._fully_fused_projection(at["means"], covars, *camera, camera_model=camera_model)
        seen = (results[0] > 0).all(-1).cpu()
        found.append([seen, *(one.cpu() for one in results[1:4]), at])
    both = found[0][0] & found[1][0]
    assert both.float().mean() > 0.5
    weights = [
        torch.randn(one[both].shape, generator=torch.Generator().manual_seed(k)) for k, one in enumerate(found[0][1:4])
    ]
    gradients = []
    for _, *results, at in found:
        loss = sum((one[both] * weight.double()).sum() for one, weight in zip(results, weights, strict=True))
        gradients.append(torch.autograd.grad(loss, [at[name] for name in ("means", "quats", "scales", "viewmats")]))
    # gsplat adds 1e-7 to lengths in a fisheye camera
    close = {"rtol": 1e-5, "atol": 1e-6} if camera_model == "fisheye" else {"rtol": 1e-9, "atol": 1e-11}
    for one, other in zip(found[0][1:4], found[1][1:4], strict=True):
        torch.testing.assert_close(one[both], other[both], **close)
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one.cpu(), other, **close)


def test_tiles_are_those_of_gsplats_reference(device: torch.device) -> None:
    """Counts, keys and order of the pairs, two images."""
    scene = random_scene(n=50, cameras=2, width=70, height=41)
    geometry = [scene[name].to(device) for name in ("quats", "scales", "viewmats", "Ks")]
    radii, means2d, depths, _, _ = fully_fused_projection(scene["means"].to(device), None, *geometry, 70, 41)
    found = isect_tiles(means2d, radii, depths, 16, 5, 3)
    expected = gsplat_reference.isect_tiles(means2d.cpu(), radii.cpu(), depths.cpu(), 16, 5, 3)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one.cpu(), other)
        assert one.dtype == other.dtype
    offsets = isect_offset_encode(found[1], 2, 5, 3).cpu()
    torch_impl = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat 1.5.3 is not installed")
    assert torch.equal(offsets, torch_impl._isect_offset_encode(expected[1], 2, 5, 3).reshape(2, 3, 5).int())


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
@pytest.mark.parametrize("channels", [3, 1, 5])
def test_harmonics_towards_directions(device: torch.device, channels: int, degree: int) -> None:
    """Values and gradients of the reference, directions of any length, rows that are masked."""
    generator = torch.Generator().manual_seed(degree)
    dirs = (3 * torch.randn(4, 7, 3, generator=generator)).double().to(device).requires_grad_()
    coeffs = torch.randn(4, 7, 25, channels, generator=generator).double().to(device).requires_grad_()
    masks = torch.rand(4, 7, generator=generator).to(device) > 0.3
    found = spherical_harmonics(degree, dirs, coeffs, masks)
    basis = reference_projection.spherical_harmonics(torch.nn.functional.normalize(dirs, dim=-1), degree)
    sums = (basis[..., None] * coeffs[..., : basis.shape[-1], :]).sum(-2)
    expected = sums * masks[..., None] + 0.0 * dirs.sum()
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=1e-12)
    upstream = torch.randn(found.shape, generator=generator).to(found)
    ours = torch.autograd.grad((found * upstream).sum(), [dirs, coeffs])
    theirs = torch.autograd.grad((expected * upstream).sum(), [dirs, coeffs])
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, atol=1e-11, rtol=1e-11)


def test_harmonics_seen_from_cameras(device: torch.device) -> None:
    """The form of gsplat's main branch, dense and packed, is that of 1.5.3 towards means from camera centres."""
    scene = random_scene(n=9, cameras=2, sh_degree=3)
    means, viewmats, coeffs = (scene[name].to(device) for name in ("means", "viewmats", "colors"))
    viewmats = rigid(viewmats)
    later = viewmats.clone()
    later[:, :3, 3] += 0.5
    centres = torch.linalg.inv(viewmats)[:, :3, 3]
    dense = spherical_harmonics(3, means, viewmats, coeffs)
    towards = spherical_harmonics(3, means - centres[:, None], coeffs.expand(2, -1, -1, -1))
    torch.testing.assert_close(dense, towards)
    camera_ids, gaussian_ids = torch.tensor([0, 1, 1], device=device), torch.tensor([4, 0, 8], device=device)
    packed = spherical_harmonics(
        3, means, viewmats, coeffs[gaussian_ids], camera_ids=camera_ids, gaussian_ids=gaussian_ids
    )
    torch.testing.assert_close(packed, dense[camera_ids, gaussian_ids])
    half_way = 0.5 * (centres + torch.linalg.inv(later)[:, :3, 3])
    rolling = spherical_harmonics(3, means=means, viewmats=viewmats, coeffs=coeffs, viewmats_rs=later)
    torch.testing.assert_close(rolling, spherical_harmonics(3, means - half_way[:, None], coeffs.expand(2, -1, -1, -1)))


@pytest.mark.parametrize("rolling", [False, True])
def test_gradients_of_harmonics_seen_from_cameras_are_differences(device: torch.device, rolling: bool) -> None:
    """To means, poses, coefficients and, with a rolling shutter, the later poses."""
    scene = leaves(random_scene(n=4, cameras=2, sh_degree=4), device, torch.float64)
    inputs = [scene[name] for name in ("means", "viewmats", "colors")]
    if rolling:
        inputs.append((scene["viewmats"].detach() + 0.01).requires_grad_())

    def summed(means: Tensor, viewmats: Tensor, coeffs: Tensor, later: Tensor | None = None) -> Tensor:
        return spherical_harmonics(4, means=means, viewmats=viewmats, coeffs=coeffs, viewmats_rs=later)

    assert torch.autograd.gradcheck(summed, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_nothing_in_nothing_out(device: torch.device) -> None:
    """No Gaussians, or none that is visible: backgrounds, and gradients without a row."""
    scene = random_scene(n=1)
    scene["means"][:] = -50.0
    inputs = leaves(scene, device, torch.float32)
    image, alphas, _ = chained(**inputs)
    assert torch.equal(image, inputs["backgrounds"][:, None, None].expand_as(image))
    assert not alphas.any()
    image.sum().backward()
    assert not inputs["means"].grad.any()
    none = spherical_harmonics(2, torch.zeros(0, 3, device=device), torch.zeros(0, 9, 3, device=device))
    assert none.shape == (0, 3)


@pytest.mark.parametrize("batch", [(), (2,), (0,)])
@pytest.mark.parametrize("n", [0, 3])
def test_a_packed_projection_of_nothing(device: torch.device, n: int, batch: tuple[int, ...]) -> None:
    """Of no Gaussians, and of such that no camera sees, the eight values have no rows; through the later steps, too."""
    eyes = torch.eye(4, device=device).expand(*batch, 2, 4, 4), torch.eye(3, device=device).expand(*batch, 2, 3, 3)
    means = torch.full((*batch, n, 3), -50.0, device=device, requires_grad=True)
    quats, scales = torch.ones(*batch, n, 4, device=device), torch.ones(*batch, n, 3, device=device)
    values = fully_fused_projection(means, None, quats, scales, *eyes, 16, 8, packed=True, calc_compensations=True)
    assert [one.shape for one in values] == [(0,), (0,), (0,), (0, 2), (0, 2), (0,), (0, 3), (0,)]
    _, camera_ids, gaussian_ids, radii, means2d, depths, conics, _ = values
    images = 2 * eyes[0].shape[:-3].numel()
    packed = {"packed": True, "n_images": images, "image_ids": camera_ids, "gaussian_ids": gaussian_ids}
    _, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, TILE, 2, 1, **packed)
    offsets = isect_offset_encode(isect_ids, images, 2, 1)
    image, _ = rasterize_to_pixels(
        means2d, conics, torch.ones(0, 3, device=device), depths, 16, 8, TILE, offsets, flatten_ids, packed=True
    )
    assert image.shape == (images, 8, 16, 3)
    assert not image.any()


def test_signatures_are_gsplats() -> None:
    """Names, order and defaults of gsplat 1.5.3's arguments; what its main branch added comes behind."""
    wrapper = pytest.importorskip("gsplat.cuda._wrapper", reason="gsplat 1.5.3 is not installed")
    for ours in (fully_fused_projection, isect_tiles, isect_offset_encode, rasterize_to_pixels):
        theirs = inspect.signature(getattr(wrapper, ours.__name__)).parameters
        own = inspect.signature(ours).parameters
        assert list(own)[: len(theirs)] == list(theirs)
        assert all(own[name].default == theirs[name].default for name in theirs)


def rendered_with(**changes: Any) -> None:
    """Pixels of a small scene, with some arguments replaced."""
    given = {
        "means2d": torch.rand(1, 4, 2),
        "conics": torch.tensor([1.0, 0.0, 1.0]).expand(1, 4, 3),
        "colors": torch.rand(1, 4, 3),
        "opacities": torch.rand(1, 4),
        "image_width": 16,
        "image_height": 8,
        "tile_size": 8,
        "isect_offsets": torch.zeros(1, 1, 2, dtype=torch.int32),
        "flatten_ids": torch.arange(4, dtype=torch.int32),
    }
    rasterize_to_pixels(**given | changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"tile_size": 4}, "tile_size must be one of 8, 16, 32, got 4"),
        ({"image_width": 17}, "too few for 17 x 8 px"),
        ({"conics": torch.zeros(1, 3, 3)}, "conics must have shape"),
        ({"opacities": torch.zeros(4)}, "opacities must have shape"),
        ({"colors": torch.zeros(4, 3)}, "colors must have shape"),
        ({"backgrounds": torch.zeros(1, 2)}, "backgrounds must have shape"),
        ({"masks": torch.ones(1, 2, 2)}, "masks must have shape"),
        ({"means2d": torch.zeros(1, 4, 2, dtype=torch.float16)}, "means2d must be a float32 or float64"),
        ({"isect_offsets": torch.zeros(2, 1, 2, dtype=torch.int32)}, "isect_offsets has"),
    ],
)
def test_wrong_pixels_are_told(changes: dict[str, Any], said: str) -> None:
    """One sentence that names the argument."""
    rendered_with()
    with pytest.raises(UserError, match=said):
        rendered_with(**changes)


def test_other_mistakes_are_told() -> None:
    """Degrees, shapes and packed images."""
    dirs, coeffs = torch.rand(4, 3), torch.rand(4, 9, 3)
    for degree, said in ((5, "degrees_to_use must be"), (None, "degrees_to_use must be"), (3, "at least 16")):
        with pytest.raises(UserError, match=said):
            spherical_harmonics(degree, dirs, coeffs)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="masks must have shape"):
        spherical_harmonics(2, dirs, coeffs, torch.ones(3, dtype=torch.bool))
    with pytest.raises(UserError, match=r"coeffs must be torch\.float32"):
        spherical_harmonics(2, dirs, coeffs.double())
    with pytest.raises(UserError, match="n_images and image_ids"):
        isect_tiles(torch.rand(3, 2), torch.ones(3, 2), torch.rand(3), 8, 1, 1, packed=True)
    eyes = torch.eye(4)[None], torch.eye(3)[None]
    with pytest.raises(UserError, match=r"covars must have shape \[4, 3, 3\].*or \[..., N, 6\], got \[4, 5\]"):
        fully_fused_projection(dirs, torch.rand(4, 5), None, None, *eyes, 8, 8)
    with pytest.raises(UserError, match="sparse_grad=True needs packed=True"):
        fully_fused_projection(dirs, None, torch.rand(4, 4), torch.rand(4, 3), *eyes, 8, 8, sparse_grad=True)
