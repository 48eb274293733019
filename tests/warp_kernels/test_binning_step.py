"""The step that bins: what it refuses. Its lists are tested in test_tile_binning."""

import numpy as np
import pytest
import warp as wp
from warp_scene import image_opacities, projected, warp_scene

from warp_kernels.binning_step import TooManyPairsError, bin_tiles
from warp_kernels.projection import ProjectedArrays, ProjectionSettings
from warp_kernels.rasterization import scalar_view


def test_more_pairs_than_indices_can_number() -> None:
    """600 Gaussians that each cover 2048 x 2048 tiles: refused before memory for the pairs is asked for."""
    n, size = 600, 16384

    def array(values: float | tuple[float, ...], kind: type) -> wp.array:
        return wp.array(np.tile(values, (n, 1)).squeeze(), dtype=kind, device="cpu")

    opacities = array(0.9, wp.float32)
    arrays = ProjectedArrays(
        means2d=array((size / 2, size / 2), wp.vec2),
        depths=array(1.0, wp.float32),
        roots=array((1e-6, 0.0, 1e-6), wp.vec3),
        compensations=array(1.0, wp.float32),
        radii=array((3e6, 3e6), wp.vec2i),
        extents=array((3e6, 3e6), wp.vec2),
        packed_roots=array((1e-6, 0.0, 1e-6, 0.0), wp.vec4),
    )
    features = wp.zeros((n, 3), dtype=wp.float32, device="cpu")
    settings = ProjectionSettings(width=size, height=size, num_gaussians=n, num_cameras=1, num_images=1)
    found = r"2,516,582,400 overlaps of 600 Gaussians with 4,194,304 tiles of 8 px exceed the 2,147,483,647"
    with pytest.raises(TooManyPairsError, match=found):
        bin_tiles(arrays, opacities, opacities, features, settings, 8, by_slot=True)


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
