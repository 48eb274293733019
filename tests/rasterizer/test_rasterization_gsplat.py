"""Standing in for gsplat.rasterization: its reference's numbers, its info, its densification strategies."""

import inspect
from collections.abc import Callable
from typing import Any

import pytest
import torch

import reference_rasterizer
from gaussian_scenes import gradients, gsplat_training, leaves, random_scene, relative_error, upstream_gradients
from thermosplat import SelectiveAdam, rasterization

GSPLAT_KEYS = {
    "batch_ids",
    "camera_ids",
    "gaussian_ids",
    "radii",
    "means2d",
    "depths",
    "conics",
    "opacities",
    "tile_width",
    "tile_height",
    "tiles_per_gauss",
    "isect_ids",
    "flatten_ids",
    "isect_offsets",
    "width",
    "height",
    "tile_size",
    "n_batches",
    "n_cameras",
}


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("sh_degree", [None, 3])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_matches_gsplat_reference(
    gsplat_reference: Callable[..., Any], render_mode: str, sh_degree: int | None, rasterize_mode: str
) -> None:
    """Images within 2e-6 and gradients within 1e-5 of gsplat's own torch reference run in float64."""
    scene = random_scene(cameras=2, sh_degree=sh_degree, render_mode=render_mode, rasterize_mode=rasterize_mode)
    certain = ~reference_rasterizer.rasterization(**scene)[2]["uncertain"]
    theirs_in = leaves(scene, "cpu", torch.float64)
    theirs_in.pop("camera_model")
    theirs = list(gsplat_reference(**theirs_in)[:2])
    ours_in = leaves(scene, "cpu", torch.float32)
    ours = list(rasterization(**ours_in)[:2])
    scale = torch.ones(theirs[0].shape[-1])
    if "D" in render_mode:
        scale[-1] = 8.0  # depths are up to about 8 units
    if "ED" in render_mode:  # an expected depth is only as good as the alpha it was divided by
        weight = torch.ones(theirs[0].shape)
        weight[..., -1:] = theirs[1].detach()
        theirs[0], ours[0] = theirs[0] * weight, ours[0] * weight
    assert ((ours[0] - theirs[0]) / scale).detach().abs()[certain].max() <= 2e-6
    assert (ours[1] - theirs[1]).detach().abs()[certain].max() <= 2e-6
    upstream = upstream_gradients(theirs, certain)
    upstream[0] = upstream[0] / scale
    truth = gradients(theirs, upstream, theirs_in)
    for name, gradient in gradients(ours, upstream, ours_in).items():
        if name != "Ks":  # gsplat's kernels have no gradient to Ks, its reference differentiates the unused skew
            assert relative_error(gradient, truth[name]) <= 1e-5, name


def test_signature_is_gsplats() -> None:
    """Names, order and defaults of all of gsplat's arguments."""
    gsplat = pytest.importorskip("gsplat", reason="gsplat 1.5.3 is not installed")
    theirs = inspect.signature(gsplat.rasterization).parameters
    ours = inspect.signature(rasterization).parameters
    assert list(ours)[: len(theirs)] == list(theirs)
    for name, parameter in theirs.items():
        if name != "rolling_shutter":  # an enum of gsplat's own
            assert ours[name].default == parameter.default, name


@pytest.mark.parametrize("batch", [(), (2,)])
def test_info_has_gsplats_keys_and_shapes(device: torch.device, batch: tuple[int, ...]) -> None:
    """Every key of gsplat's info, with the shapes of its packed=False."""
    scene = random_scene(n=30, cameras=3, batch=batch, width=40, height=25, tile_size=16)
    image, alphas, info = rasterization(**leaves(scene, device, torch.float32), packed=False)
    assert set(info) >= GSPLAT_KEYS
    assert all(info.get(key) is info[key] for key in GSPLAT_KEYS)
    lead = (*batch, 3)
    assert image.shape == (*lead, 25, 40, 3)
    assert alphas.shape == (*lead, 25, 40, 1)
    shapes = {"radii": (30, 2), "means2d": (30, 2), "depths": (30,), "conics": (30, 3), "opacities": (30,)}
    for key, shape in shapes.items():
        assert info[key].shape == (*lead, *shape), key
    assert info["radii"].dtype == torch.int32
    assert info["tiles_per_gauss"].shape == (*lead, 30)
    assert info["isect_offsets"].shape == (*lead, 2, 3)
    assert info["isect_offsets"].dtype == info["flatten_ids"].dtype == torch.int32
    assert len(info["flatten_ids"]) == len(info["isect_ids"]) == info["tiles_per_gauss"].sum()
    images = 2 if batch else 1
    expected = {"width": 40, "height": 25, "tile_size": 16, "tile_width": 3, "tile_height": 2}
    assert {key: info[key] for key in expected} == expected
    assert (info["n_cameras"], info["n_batches"]) == (3, images)
    assert info["batch_ids"] is info["camera_ids"] is info["gaussian_ids"] is None


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_info_numbers(device: torch.device, rasterize_mode: str) -> None:
    """Projected quantities of visible Gaussians equal the reference's; radii are opacity-aware as gsplat's."""
    scene = random_scene(n=200, cameras=2, rasterize_mode=rasterize_mode)
    info = rasterization(**leaves(scene, device, torch.float32), packed=False)[2]
    truth = reference_rasterizer.rasterization(**scene)[2]
    visible = truth["visible"]
    assert torch.equal(info["radii"].cpu(), truth["radii"])
    assert (info["radii"].cpu()[~visible] == 0).all()
    for key in ("means2d", "depths", "conics", "opacities"):
        expected = truth[key].reshape(info[key].shape)[visible]
        assert relative_error(info[key].detach().double().cpu()[visible], expected) < 1e-6, key
    assert truth["radii"].float().std() > 0


def test_tile_lists_drive_gsplats_reference(gsplat_reference: Callable[..., Any]) -> None:
    """gsplat's own blending, given our tile lists, draws the same image: the lists mean what gsplat's mean."""
    from gsplat.cuda._torch_impl import _rasterize_to_pixels

    scene = random_scene(n=150, cameras=2, width=45, height=34, backgrounds=False)
    image, _, info = rasterization(**leaves(scene, "cpu", torch.float64), packed=False)
    colors = scene["colors"].expand(2, *scene["colors"].shape)
    theirs, _ = _rasterize_to_pixels(
        info["means2d"],
        info["conics"],
        colors,
        info["opacities"],
        45,
        34,
        info["tile_size"],
        info["isect_offsets"],
        info["flatten_ids"],
    )
    assert (theirs - image).abs().max() < 1e-11
    # isect_ids: image, tile and depth bits, ascending, as gsplat packs them
    assert (info["isect_ids"].diff() >= 0).all()
    _, _, reference_info = gsplat_reference(**{k: v for k, v in scene.items() if k != "camera_model"})
    assert len(info["flatten_ids"]) <= len(reference_info["flatten_ids"])
    assert set(info["isect_ids"].tolist()) <= set(reference_info["isect_ids"].tolist())


@pytest.mark.parametrize(
    ("optimizer", "absgrad", "packed"),
    [
        *(("Adam", absgrad, packed) for absgrad in (False, True) for packed in (False, True)),
        ("SparseAdam", False, True),
        *(("SelectiveAdam", False, packed) for packed in (False, True)),
    ],
)
def test_default_strategy_densifies(optimizer: str, absgrad: bool, packed: bool) -> None:
    """gsplat's DefaultStrategy and its trainer's options --packed, --sparse_grad and --visible_adam run on our info."""
    strategies = pytest.importorskip("gsplat.strategy", reason="gsplat 1.5.3 is not installed")
    scene = random_scene(n=60, backgrounds=False)
    target = reference_rasterizer.rasterization(**random_scene(n=60, seed=1, backgrounds=False))[0].float()
    params, optimizers = gsplat_training(scene, "cpu")
    if optimizer != "Adam":
        makers = {"SparseAdam": torch.optim.SparseAdam, "SelectiveAdam": SelectiveAdam}
        how = {"eps": 1e-15, "betas": (0.9, 0.999)}
        optimizers = {name: makers[optimizer]([{"params": one, "lr": 1e-2}], **how) for name, one in params.items()}
    strategy = strategies.DefaultStrategy(
        refine_start_iter=2, refine_every=3, reset_every=1000, grow_grad2d=1e-5, absgrad=absgrad, prune_opa=0.02
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    counts, losses = [], []
    torch.manual_seed(0)
    for step in range(8):
        image, _, info = rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["colors"],
            scene["viewmats"].float(),
            scene["Ks"].float(),
            23,
            18,
            packed=packed,
            sparse_grad=optimizer == "SparseAdam",
            absgrad=absgrad,
        )
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - target).square().mean()
        loss.backward()
        seen = info["visible"].any(0)
        if packed:
            assert torch.equal(seen, torch.zeros_like(seen).scatter_(0, info["gaussian_ids"], True))
        for name, one in optimizers.items():
            if optimizer == "SparseAdam" and not params[name].grad.is_sparse:  # as gsplat's trainer does
                ids, gradient = info["gaussian_ids"], params[name].grad
                params[name].grad = torch.sparse_coo_tensor(
                    ids[None], gradient[ids], gradient.shape, is_coalesced=True, check_invariants=True
                )
            one.step(*([seen] if optimizer == "SelectiveAdam" else []))
            one.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        counts.append(len(params["means"]))
        losses.append(loss.item())
    assert counts[0] == 60
    assert counts[-1] != 60
    assert losses[-1] < losses[0]
