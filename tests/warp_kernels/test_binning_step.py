"""The step that bins: what it refuses. Its lists are tested in test_tile_binning."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.binning_step import TooManyPairsError, bin_tiles
from warp_kernels.projection import ProjectedArrays, ProjectionSettings


def test_more_pairs_than_indices_can_number() -> None:
    """600 Gaussians that each cover 2048 x 2048 tiles: refused before memory for the pairs is asked for."""
    n, size = 600, 16384

    def array(values: float | tuple[float, ...], kind: type) -> wp.array:
        return wp.array(np.tile(values, (n, 1)).squeeze(), dtype=kind, device="cpu")

    opacities = array(0.9, wp.float32)
    projected = ProjectedArrays(
        means2d=array((size / 2, size / 2), wp.vec2),
        depths=array(1.0, wp.float32),
        conics=array((1e-12, 0.0, 1e-12), wp.vec3),
        compensations=array(1.0, wp.float32),
        radii=array((3e6, 3e6), wp.vec2i),
        extents=array((3e6, 3e6), wp.vec2),
    )
    features = wp.zeros((n, 3), dtype=wp.float32, device="cpu")
    settings = ProjectionSettings(width=size, height=size, num_gaussians=n, num_cameras=1, num_images=1)
    with pytest.raises(TooManyPairsError, match=r"2,516,582,400 overlaps of 600 Gaussians with tiles of 8 px"):
        bin_tiles(projected, opacities, opacities, features, settings, 8, by_slot=True)
