"""The step that bins: what it refuses. Its lists are tested in test_tile_binning."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_kernels.binning import binning_step
from warp_kernels.binning.binning_step import PAIRS_MAX, TooManyPairsError, bin_tiles
from warp_kernels.binning.tile_bins import Room
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.projection.projection import ProjectedArrays, ProjectionSettings
from warp_kernels.rasterization import scalar_view
from warp_scene import image_opacities, projected, warp_scene


def covering(n: int, size: int) -> dict[str, Any]:
    """Arguments of ``bin_tiles``: Gaussians that each cover an image of so many pixels."""

    def array(values: bool | float | tuple[float, ...], kind: type) -> wp.array:
        return wp.array(np.tile(values, (n, 1)).squeeze(), dtype=kind, device="cpu")

    opacities = array(0.9, wp.float32)
    arrays = ProjectedArrays(
        means2d=array((size / 2, size / 2), wp.vec2),
        depths=array(1.0, wp.float32),
        roots=array((1e-6, 0.0, 1e-6), wp.vec3),
        compensations=array(1.0, wp.float32),
        visible=array(True, wp.bool),
        extents=array((3e6, 3e6), wp.vec2),
        packed_roots=array((1e-6, 0.0, 1e-6, 0.0), wp.vec4),
    )
    features = wp.zeros((n, 3), dtype=wp.float32, device="cpu")
    settings = ProjectionSettings(width=size, height=size, num_gaussians=n, num_cameras=1, num_images=1)
    return {
        "projected": arrays,
        "opacities": opacities,
        "thermal_opacities": opacities,
        "features": features,
        "settings": settings,
        "tile_size": 8,
        "by_slot": True,
    }


@pytest.fixture
def nothing_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays of a GiB are not to be asked for."""
    empty = wp.empty

    def small(shape: int, dtype: type, **options: object) -> wp.array:
        assert shape * wp.types.type_size_in_bytes(dtype) < 2**30, "the limit came too late"
        return empty(shape, dtype, **options)

    monkeypatch.setattr(wp, "empty", small)


@pytest.mark.usefixtures("nothing_large")
@pytest.mark.parametrize(("n", "pairs"), [(600, "2,516,582,400"), (256, "1,073,741,824")])
@pytest.mark.parametrize("compacted", [True, False])
def test_more_pairs_than_a_call_can_number(
    monkeypatch: pytest.MonkeyPatch, n: int, pairs: str, compacted: bool
) -> None:
    """Gaussians that each cover 2048 x 2048 tiles: refused before memory for the pairs is asked for."""
    monkeypatch.setattr(binning_step, "COMPACTED", 0 if compacted else 2**18)
    found = f"{pairs} overlaps of {n} Gaussians with 4,194,304 tiles of 8 px exceed the 1,073,741,823 that one call"
    with pytest.raises(TooManyPairsError, match=found):
        bin_tiles(**covering(n, 16384))


@pytest.mark.usefixtures("nothing_large")
def test_the_most_pairs_are_allowed() -> None:
    """Up to the limit it is a matter of memory, of which the arrays as they are to be made can be asked for."""
    with pytest.raises(AssertionError, match="too late") as raised:
        bin_tiles(**covering(255, 16384))
    assert "1,069,547,520 overlaps of 255 Gaussians" in raised.value.__notes__[0]
    assert ArrayView(0, (2 * PAIRS_MAX,), wp.int32, wp.get_device("cpu")).size == 2 * PAIRS_MAX


@pytest.mark.usefixtures("nothing_large")
def test_more_room_than_a_call_can_number() -> None:
    """What is asked for beforehand has the same limit."""
    with pytest.raises(TooManyPairsError, match="1,073,741,824 overlaps of 4 Gaussians with 9 tiles of 8 px exceed"):
        bin_tiles(**covering(4, 20), room=Room(PAIRS_MAX + 1, PAIRS_MAX + 1, 9))


@pytest.mark.usefixtures("nothing_large")
def test_more_tiles_than_a_call_can_number() -> None:
    """An image that no device could hold says so itself."""
    with pytest.raises(TooManyPairsError, match="2,147,488,281 tiles of 8 px exceed the 2,147,483,646 of one call"):
        bin_tiles(**covering(1, 8 * 46341))


def test_what_there_was_no_memory_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """An allocator's own error passes through, with the numbers it does not know."""
    scene = warp_scene(n=60, width=23, height=18)
    arrays, opacities = projected(scene), image_opacities(scene, scene.gaussians.opacities)
    features = scalar_view(scene.features)
    pairs = bin_tiles(arrays, opacities, opacities, features, scene.settings, 8, by_slot=True).num_pairs
    empty = wp.empty

    def exhausted(shape: int, *arguments: object, **options: object) -> wp.array:
        if shape == 2 * pairs:
            raise RuntimeError(f"Failed to allocate {8 * pairs} bytes on device 'cpu'")
        return empty(shape, *arguments, **options)

    monkeypatch.setattr(wp, "empty", exhausted)
    with pytest.raises(RuntimeError, match="Failed to allocate") as raised:
        bin_tiles(arrays, opacities, opacities, features, scene.settings, 8, by_slot=True)
    assert f"{pairs:,} overlaps of 60 Gaussians with 9 tiles of 8 px" in raised.value.__notes__[0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 40, 3000, binning_step.FEW_SORTED, binning_step.FEW_SORTED + 1])
def test_sorting_digit_by_digit_is_one_sort(dtype: type, count: int) -> None:
    """Few keys are sorted by some bits at a time, into the order of Warp's sort by all, whatever numbers they are."""
    rng = np.random.default_rng(count)
    keys = rng.normal(0, 1, count).astype(dtype).round(2)  # many are equal, which keep their order
    special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, np.finfo(dtype).tiny / 8, 1e30], dtype)
    places = rng.integers(0, count, 30)
    keys[places] = rng.choice(special, 30)

    def pairs() -> tuple[wp.array, wp.array]:
        values = np.arange(2 * count, dtype=np.int32)
        return wp.array(np.tile(keys, 2), device="cpu"), wp.array(values, device="cpu")

    found, expected = pairs(), pairs()
    binning_step.sort_by_depth(*found, count)
    wp.utils.radix_sort_pairs(*expected, count)
    for mine, theirs in zip(found, expected, strict=True):
        assert mine.numpy()[:count].tobytes() == theirs.numpy()[:count].tobytes()


@pytest.mark.parametrize("tile_size", [0, 12])
def test_tiles_are_powers_of_two(tile_size: int) -> None:
    """Kernels shift where others divide."""
    with pytest.raises(ValueError, match=f"tile_size must be a power of two, got {tile_size}"):
        bin_tiles(**covering(3, 16) | {"tile_size": tile_size})
