"""The lists of Gaussians a tile: complete, tight, in depth order."""

import itertools

import numpy as np
import pytest
import warp as wp

from drawn_tiles import PARTS, drawn_parts, drawn_tiles, listed_tiles
from warp_kernels.binning import binning_step
from warp_kernels.binning.binning_step import bin_tiles
from warp_kernels.binning.tile_bins import Room, TileBins
from warp_kernels.constants import ALPHA_MIN
from warp_kernels.projection.projection import ProjectedArrays
from warp_kernels.rasterization import scalar_view
from warp_scene import image_opacities, projected, warp_scene

SCENES = {
    "small": {"n": 60, "width": 23, "height": 18},
    "ragged": {"n": 150, "width": 77, "height": 51, "cameras": 2},
    "wide": {"n": 100, "width": 130, "height": 9},
}


@pytest.fixture(autouse=True, params=[True, False], ids=["compacted", "all"])
def compacted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test with Gaussians without tiles left out before the sort, as of many, and with all of them sorted."""
    monkeypatch.setattr(binning_step, "COMPACTED", 0 if request.param else 2**18)


def bin_scene(name: str, tile_size: int, needles: bool, by_slot: bool = True) -> tuple[ProjectedArrays, TileBins, dict]:
    """Projects and bins a scene; also returns what the brute-force comparison needs."""
    scene = warp_scene(seed=8, **SCENES[name])
    if needles:
        scales = scene.gaussians.scales.numpy()
        scales[::2] *= np.array([8.0, 0.02, 0.02], np.float32)
        scene.gaussians.scales.assign(scales)
    arrays = projected(scene)
    opacities = image_opacities(scene, scene.gaussians.opacities)
    bins = bin_tiles(
        arrays, opacities, opacities, scalar_view(scene.features), scene.settings, tile_size, by_slot=by_slot
    )
    return arrays, bins, {"opacities": opacities.numpy().astype(np.float64), "settings": scene.settings}


@pytest.mark.parametrize("needles", [False, True])
@pytest.mark.parametrize("tile_size", [8, 16, 32])
@pytest.mark.parametrize("name", SCENES)
def test_lists_are_complete_and_tight(name: str, tile_size: int, needles: bool) -> None:
    """Every pair that draws something is listed once; few that draw nothing are."""
    arrays, bins, extra = bin_scene(name, tile_size, needles)
    listed = listed_tiles(bins)
    assert len(listed) == len(set(listed)) == bins.num_pairs
    needed = drawn_tiles(arrays, bins, extra, ALPHA_MIN * (1 + 1e-5))
    assert needed <= set(listed)
    # The ellipse may pass between the pixel centres of a row: those pairs are listed and draw nothing.
    assert len(listed) <= 1.25 * len(drawn_tiles(arrays, bins, extra, ALPHA_MIN * (1 - 1e-4))) + 2
    assert len(needed) > 50


@pytest.mark.parametrize("needles", [False, True])
@pytest.mark.parametrize("tile_size", [8, 16, 32])
@pytest.mark.parametrize("name", SCENES)
def test_masks_are_complete_and_tight(
    name: str, tile_size: int, needles: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pair's mask names every part of its tile in which it draws something, and few others."""
    without = listed_tiles(bin_scene(name, tile_size, needles)[1])
    monkeypatch.setattr(binning_step, "wants_masks", lambda device: True)
    arrays, bins, extra = bin_scene(name, tile_size, needles)
    assert listed_tiles(bins) == without
    masks = bins.masks.numpy()
    assert len(masks) == bins.num_pairs
    masked = {
        (tile, g, part)
        for (tile, g), mask in zip(without, masks, strict=True)
        for part in range(PARTS)
        if mask >> part & 1
    }
    needed = drawn_parts(arrays, bins, extra, ALPHA_MIN * (1 + 1e-5))
    assert needed <= masked
    assert len(masked) <= 1.35 * len(drawn_parts(arrays, bins, extra, ALPHA_MIN * (1 - 1e-4))) + 2
    assert len(needed) > 50


def test_masks_of_more_tiles_than_there_are_bits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a tile's number takes the mask's bits, every pair may reach all of its tile."""
    without = listed_tiles(bin_scene("ragged", 16, needles=True)[1])
    monkeypatch.setattr(binning_step, "wants_masks", lambda device: True)
    monkeypatch.setattr(binning_step, "MASK_SHIFT", 1)
    _, bins, _ = bin_scene("ragged", 16, needles=True)
    assert listed_tiles(bins) == without
    assert (bins.masks.numpy() == 255).all()


def test_lists_are_in_depth_order_and_ties_in_index_order() -> None:
    """Front to back within each tile; equal depths by index."""
    scene = warp_scene(n=80, width=40, height=30)
    scene.gaussians.viewmats.assign(np.eye(4, dtype=np.float32)[None])
    means = scene.gaussians.means.numpy()
    means[:, 2] = 4.0 + np.arange(80) % 3  # many ties
    scene.gaussians.means.assign(means)
    arrays, opacities = projected(scene), image_opacities(scene, scene.gaussians.opacities)
    bins = bin_tiles(arrays, opacities, opacities, scalar_view(scene.features), scene.settings, 16, by_slot=True)
    depths, offsets, ids = arrays.depths.numpy(), bins.tile_offsets.numpy(), bins.gaussian_ids.numpy()
    longest = 0
    for start, end in itertools.pairwise(offsets):
        keys = [(float(depths[g]), int(g)) for g in ids[start:end]]
        assert keys == sorted(keys)
        longest = max(longest, end - start)
    assert longest > 10
    assert offsets[0] == 0
    assert offsets[-1] == len(ids) == bins.num_pairs


def test_slots_are_contiguous_per_gaussian() -> None:
    """Each pair's slot lies in its Gaussian's own range, which the deterministic adjoint sums over."""
    _, bins, _ = bin_scene("ragged", 16, needles=True)
    order, ends = bins.order.numpy(), bins.pair_ends.numpy()
    counts = bins.tiles_per_gaussian.numpy()
    slots, ids = bins.slots.numpy()[: bins.num_pairs], bins.gaussian_ids.numpy()
    assert sorted(slots.tolist()) == list(range(bins.num_pairs))
    rank = np.empty(len(counts), int)
    rank[order] = np.arange(len(order))
    last = ends[rank[ids]]
    assert (slots < last).all()
    assert (slots >= last - counts[ids]).all()


def test_with_and_without_slots_agree() -> None:
    """The atomic and the deterministic adjoint are given the same lists."""
    lists = [listed_tiles(bin_scene("ragged", 16, needles=False, by_slot=by_slot)[1]) for by_slot in (True, False)]
    assert lists[0] == lists[1]


def test_culled_and_non_finite_gaussians_are_not_listed() -> None:
    """Gaussians behind the camera have no tiles, nor have those whose features are not finite."""
    scene = warp_scene(n=30, width=40, height=30)
    means, features = scene.gaussians.means.numpy(), scene.features.numpy()
    means[4] = (0, 0, -50)
    features[7, 1] = np.nan
    features[9, 0] = np.inf
    scene.gaussians.means.assign(means)
    scene.features.assign(features)
    arrays, opacities = projected(scene), image_opacities(scene, scene.gaussians.opacities)
    assert arrays.visible.numpy()[[7, 9]].all()
    bins = bin_tiles(arrays, opacities, opacities, scalar_view(scene.features), scene.settings, 16, by_slot=True)
    assert not {4, 7, 9} & set(bins.gaussian_ids.numpy().tolist())
    assert (bins.tiles_per_gaussian.numpy()[[4, 7, 9]] == 0).all()
    assert not arrays.visible.numpy()[[4, 7, 9]].any()


def test_gaussians_beyond_the_room_are_left_out() -> None:
    """A room for fewer Gaussians than have tiles is filled, and the totals say how many there are."""
    scene = warp_scene(n=80, width=60, height=40)
    arrays, opacities = projected(scene), image_opacities(scene, scene.gaussians.opacities)
    lists = {}
    for room in (None, 5, 79):
        bins = bin_tiles(
            arrays,
            opacities,
            opacities,
            scalar_view(scene.features),
            scene.settings,
            16,
            by_slot=False,
            room=Room(500, room or 80, 100),
        )
        pairs = bins.tile_offsets.numpy()[-1]
        counts = np.bincount(bins.gaussian_ids.numpy()[:pairs], minlength=80)
        lists[room] = counts
        if bins.totals is not None:
            listed = bins.tiles_per_gaussian.numpy()
            assert bins.totals.numpy()[-1].tolist() == [listed.sum(), (listed > 0).sum()]
            assert (counts > 0).sum() == min(room or 80, (listed > 0).sum()) > 0
    assert (lists[None] == lists[79]).all() == ((lists[None] > 0).sum() <= 79)


def test_second_opacity_widens_the_lists() -> None:
    """A pair is listed when either opacity draws something there."""
    scene = warp_scene(n=60, width=60, height=40)
    faint = wp.array(scene.gaussians.opacities.numpy() * 0.05, dtype=wp.float32, device="cpu")
    strong = scene.gaussians.opacities
    lists = []
    for first, second in ((strong, strong), (faint, strong), (strong, faint), (faint, faint)):
        scene.gaussians.opacities, scene.gaussians.thermal_opacities = first, second
        arrays = projected(scene)
        bins = bin_tiles(arrays, first, second, scalar_view(scene.features), scene.settings, 8, by_slot=True)
        lists.append(listed_tiles(bins))
    assert lists[0] == lists[1] == lists[2]
    assert set(lists[3]) < set(lists[0])
