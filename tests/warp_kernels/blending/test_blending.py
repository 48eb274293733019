"""Blending with other deals of pixels to lanes and threads: the same image and the same gradients."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_kernels.binning.binning_step import bin_tiles
from warp_kernels.binning.tile_bins import TileBins
from warp_kernels.blending import blending_step
from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.blending.blended_arrays import BlendedArrays
from warp_kernels.blending.blending_step import blend
from warp_kernels.blending.list_segments import LONG_LIST
from warp_kernels.machinery import launching
from warp_kernels.projection.projection import ProjectedArrays
from warp_kernels.rasterization import scalar_view
from warp_scene import WarpScene, image_opacities, projected, warp_scene

pytestmark = pytest.mark.rotating

CROWD = 900
"""Gaussians of which hundreds share a tile."""


def blended(
    scene: WarpScene,
    layout: BlendLayout,
    thermal_channels: int = 0,
    first_channels: int | None = None,
    *,
    by_slot: bool = True,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Images, and gradients of means2d, roots, opacities and features for a fixed random loss."""
    settings, dtype = scene.settings, scene.gaussians.opacities.dtype
    rows = settings.num_images * settings.height
    opacities = thermal = image_opacities(scene, scene.gaussians.opacities)
    if thermal_channels:
        other = scene.gaussians.opacities.numpy()[::-1].copy()
        scene.gaussians.thermal_opacities = wp.array(other, dtype=dtype, device="cpu")
        thermal = image_opacities(scene, scene.gaussians.thermal_opacities)
    arrays: ProjectedArrays = projected(scene, wp.Tape())
    flat = scalar_view(scene.features)
    bins = bin_tiles(arrays, opacities, thermal, flat, settings, layout.tile_size, by_slot=by_slot)

    def image(kind: type, requires_grad: bool = True) -> wp.array:
        return wp.zeros((rows, settings.width), dtype=kind, device="cpu", requires_grad=requires_grad)

    result = BlendedArrays(image(scene.features.dtype), image(dtype), image(wp.int32, False))
    result.alphas = image(dtype, False)
    outputs = [result.render, result.transmittance]
    if thermal_channels:
        result.thermal_render = image(wp.types.vector(thermal_channels, dtype))
        result.thermal_transmittance = image(dtype)
        result.thermal_ends = image(wp.int32, False)
        result.thermal_alphas = image(dtype, False)
        outputs += [result.thermal_render, result.thermal_transmittance]
    tape = wp.Tape()
    features, rest = apart(scene.features, first_channels)
    blend(arrays, opacities, thermal, features, bins, settings, result, tape, rest=rest, layout=layout)
    assert (result.alphas.numpy() == 1 - result.transmittance.numpy()).all()
    if thermal_channels:
        assert (result.thermal_alphas.numpy() == 1 - result.thermal_transmittance.numpy()).all()
    rng = np.random.default_rng(1)
    for output in outputs:
        output.grad.assign(rng.normal(size=output.numpy().shape))
    tape.backward()
    inputs = [arrays.means2d, arrays.roots, opacities, features] + [thermal] * bool(thermal_channels)
    # numpy() of a CPU array is its memory: copies, because gradients accumulate
    gradients = [array.grad.numpy().copy() for array in inputs]
    if rest is not None:
        gradients[3] = np.concatenate([gradients[3], rest.grad.numpy()], axis=-1)
    return [output.numpy().copy() for output in outputs], gradients


def apart(features: wp.array, first_channels: int | None) -> tuple[wp.array, wp.array | None]:
    """The first channels and the others, each in an array of their own; None: all of them as they are."""
    if first_channels is None:
        return features, None
    values, scalar = features.numpy(), features.dtype._wp_scalar_type_
    first, rest = (
        wp.array(part, dtype=wp.types.vector(part.shape[1], scalar), device="cpu", requires_grad=True)
        for part in (values[:, :first_channels].copy(), values[:, first_channels:].copy())
    )
    return first, rest


@pytest.mark.parametrize("thermal_channels", [0, 2])
def test_channels_may_lie_apart(thermal_channels: int) -> None:
    """Channels in two arrays give the images and gradients of one array, to the bit."""
    layout, results = BlendLayout(16, 16, 16, 1), []
    for first_channels in (None, 1):
        scene = warp_scene(wp.float64, n=80, cameras=2, channels=3, requires_grad=True)
        images, gradients = blended(scene, layout, thermal_channels, first_channels)
        results.append(images + gradients)
    for one, other in zip(*results, strict=True):
        assert np.linalg.norm(one) > 0
        assert np.array_equal(one, other)


@pytest.mark.parametrize("thermal_channels", [0, 2])
@pytest.mark.parametrize("tile_size", [8, 32])
def test_tile_sizes_agree(tile_size: int, thermal_channels: int) -> None:
    """Tiles of 8, 16 and 32 pixels give the same images and gradients to float64 rounding."""
    arguments = {"n": 80, "width": 45, "height": 35, "cameras": 2, "channels": 3, "requires_grad": True}
    results = []
    for size in (16, tile_size):
        images, gradients = blended(
            warp_scene(wp.float64, **arguments), BlendLayout(size, size, size, 1), thermal_channels
        )
        results.append(images + gradients)
    for one, other in zip(*results, strict=True):
        assert np.linalg.norm(one) > 0
        assert np.linalg.norm(one - other) < 1e-12 * np.linalg.norm(one)


@pytest.mark.parametrize("thermal_channels", [0, 2])
@pytest.mark.parametrize("segment", [32, 64])
@pytest.mark.parametrize(("block", "worth_a_wait"), [(16, 2**30), (8, 2**30), (8, 0)])
def test_lists_may_be_cut(
    segment: int, block: int, worth_a_wait: int, thermal_channels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Segments blended side by side, also with several warps a tile, give the images and gradients of whole lists.

    Opacities up to 1 let some pixels finish in an early segment, their neighbours later or never. States have room for
    all pairs, or what is needed.
    """
    monkeypatch.setattr(blending_step, "WORTH_A_WAIT", worth_a_wait)
    arguments = {"n": CROWD, "width": 45, "height": 35, "cameras": 2, "channels": 3, "requires_grad": True}
    whole = blended(warp_scene(wp.float64, **arguments), BlendLayout(16, 16, 16, 1), thermal_channels)
    cut = blended(warp_scene(wp.float64, **arguments), BlendLayout(16, block, block, 1, segment), thermal_channels)
    for one, other in zip([*whole[0], *whole[1]], [*cut[0], *cut[1]], strict=True):
        assert np.linalg.norm(one) > 0
        assert np.linalg.norm(one - other) < 1e-12 * np.linalg.norm(one)


def crowd_bins(scene: WarpScene) -> tuple[wp.array, TileBins]:
    """Opacities, and the lists of the test above."""
    opacities = image_opacities(scene, scene.gaussians.opacities)
    features = scalar_view(scene.features)
    return opacities, bin_tiles(projected(scene), opacities, opacities, features, scene.settings, 16, by_slot=True)


def test_a_cut_list_is_several_segments_long() -> None:
    """The scene of the test above has lists that are long for the longer segment, and some that are not."""
    _, bins = crowd_bins(warp_scene(wp.float64, n=CROWD, width=45, height=35, cameras=2, channels=3))
    lengths = np.diff(bins.tile_offsets.numpy())
    assert lengths.max() > LONG_LIST * 64 > lengths.min()


@pytest.mark.parametrize(("segment", "has_room"), [(64, False), (64, True), (4096, False)])
def test_states_have_the_room_that_is_needed(segment: int, has_room: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A row for each boundary in a long list, none where there is no such list; where nothing may be read back, a row
    for each segment in all pairs. Every row that is needed has a boundary, and no two have the same."""
    monkeypatch.setattr(blending_step, "WORTH_A_WAIT", 0)
    scene = warp_scene(n=CROWD, width=45, height=35, cameras=2, channels=3)
    opacities, bins = crowd_bins(scene)
    offsets = bins.tile_offsets.numpy()
    begin, end = offsets[:-1], offsets[1:]
    cut = end - begin > LONG_LIST * segment
    inside = [np.arange(a // segment + 1, (b - 1) // segment + 1) for a, b in zip(begin[cut], end[cut], strict=True)]
    rows = sum(map(len, inside))
    images = [
        wp.zeros((scene.settings.num_images * scene.settings.height, scene.settings.width), dtype=kind, device="cpu")
        for kind in (scene.features.dtype, wp.float32, wp.int32)
    ]
    bins = replace(bins, has_room=has_room)
    layout, launched = BlendLayout(16, 16, 16, 1, segment), set()

    def told(launch: Callable[..., None], kernel: wp.Kernel, *rest: Any) -> None:
        launched.add(kernel.key.split("_3_0_")[0])
        launch(kernel, *rest)

    for name in ("launch", "launch_again", "launch_tiles"):
        monkeypatch.setattr(blending_step, name, partial(told, getattr(blending_step, name)))
    arrays = (projected(scene), opacities, opacities, scene.features, bins, scene.settings)
    walk = blending_step.blend(*arrays, BlendedArrays(*images), layout=layout)
    # all that a call in a graph may launch, which cannot be loaded there
    assert launched == {"deal_states_kernel", "segment_light", "blend", "join_segments"}
    assert (rows > 0) == (segment == 64)
    assert walk.states.shape[0] == (bins.num_pairs // segment if has_room else rows)
    if rows > 0:
        cuts, tiles = walk.cuts.numpy(), len(offsets) - 1
        dealt = [boundaries + cuts[tile] for tile, boundaries in zip(np.flatnonzero(cut), inside, strict=True)]
        assert sorted(np.concatenate(dealt)) == list(range(rows))
        assert all((cuts[tiles + one] == tile + 1).all() for tile, one in zip(np.flatnonzero(cut), dealt, strict=True))
        assert not cuts[tiles + rows : -1].any()
        assert cuts[-1] == rows


@pytest.mark.parametrize("channels", [3, 6])
def test_images_of_lists_without_numbered_pairs(channels: int) -> None:
    """As CUDA makes them by default: what belongs to the numbers is None in all launches, and images are the same.

    Six channels leave nothing for a record, and then that is None, too.

    Their gradients are added atomically, by code for CUDA alone; ``deterministic`` is compared there.
    """
    images = []
    for by_slot in (True, False):
        scene = warp_scene(n=60, width=45, height=35, channels=channels, requires_grad=True)
        images.append(blended(scene, BlendLayout(16, 16, 16, 1), 2, by_slot=by_slot)[0])
    assert all((one == other).all() for one, other in zip(*images, strict=True))
    assert all(np.linalg.norm(image) > 0 for image in images[0])


def test_gradients_accumulate() -> None:
    """The adjoint adds to gradients that are already there, as a tape with several uses of an array needs."""
    layout = BlendLayout(16, 16, 16, 1)
    scene = warp_scene(wp.float64, n=20, requires_grad=True)
    _, (_, _, _, once) = blended(scene, layout)
    _, (_, _, _, twice) = blended(scene, layout)  # scene.features is the same array with its gradient kept
    assert np.allclose(twice, 2 * once, rtol=1e-12)


@pytest.mark.parametrize("threads", [2, 5])
def test_thread_count_does_not_change_a_bit(threads: int) -> None:
    """Tiles spread over CPU threads give bit-identical images and gradients."""
    before = launching.num_threads()
    results = []
    try:
        for count in (1, threads):
            launching.set_num_threads(count)
            scene = warp_scene(n=400, width=150, height=90, channels=4, requires_grad=True)
            images, gradients = blended(scene, BlendLayout(16, 16, 16, 1))
            results.append(images + gradients)
    finally:
        launching.set_num_threads(before)
    assert all((one == other).all() for one, other in zip(*results, strict=True))


def test_too_many_channels_for_one_traversal() -> None:
    """The limit is named."""
    scene = warp_scene(n=5, channels=33)
    with pytest.raises(ValueError, match="32"):
        blended(scene, BlendLayout(16, 16, 16, 1))


@pytest.mark.parametrize(
    ("layout", "expected"),
    [
        (BlendLayout(16, 16, 16, 1), (1, 16, 16, 1)),
        (BlendLayout(16, 8, 8, 32), (4, 1, 2, 128)),
        (BlendLayout(16, 8, 4, 32), (8, 1, 1, 256)),
        (BlendLayout(32, 16, 8, 32), (8, 1, 4, 256)),
    ],
)
def test_layout_deals_every_pixel_once(layout: BlendLayout, expected: tuple[int, int, int, int]) -> None:
    """Warps, rows, columns and threads of a tile; the lanes' pixels tile the tile."""
    assert (layout.warps, layout.rows, layout.columns, layout.threads) == expected
    pixels = set()
    for warp in range(layout.warps):
        left = warp % layout.blocks_x * layout.block_width
        top = warp // layout.blocks_x * layout.block_height
        for lane in range(layout.lanes):
            for row in range(layout.rows):
                for column in range(layout.columns):
                    q = lane + column * layout.lanes
                    pixels.add((left + q % layout.block_width, top + row + q // layout.block_width))
    assert pixels == {(x, y) for x in range(layout.tile_size) for y in range(layout.tile_size)}
    assert layout.warps * layout.lanes * layout.rows * layout.columns == layout.tile_size**2
