"""For any scene: the pass that counts pairs and the one that emits them agree, and no tile, or part of a tile, that is
drawn is missing."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from drawn_tiles import PARTS, drawn_parts, listed_tiles
from warp_kernels.binning import binning_step
from warp_kernels.binning.binning_step import bin_tiles
from warp_kernels.constants import ALPHA_MIN
from warp_kernels.rasterization import scalar_view
from warp_scene import image_opacities, projected, warp_scene


@settings(max_examples=30, deadline=None, derandomize=True, database=None)
@given(
    n=st.integers(1, 60),
    width=st.integers(1, 150),
    height=st.integers(1, 150),
    tile_size=st.sampled_from([8, 16, 32]),
    stretch=st.tuples(st.floats(-4, 1), st.floats(-4, 1), st.floats(-4, 1)),
    faint=st.booleans(),
    by_slot=st.booleans(),
    seed=st.integers(0, 10_000),
)
def test_counted_emitted_and_drawn(
    n: int,
    width: int,
    height: int,
    tile_size: int,
    stretch: tuple[float, float, float],
    faint: bool,
    by_slot: bool,
    seed: int,
) -> None:
    """Needles, pancakes, points and giants, at opacities down to the threshold."""
    scene = warp_scene(n=n, width=width, height=height, seed=seed)
    scene.gaussians.scales.assign((scene.gaussians.scales.numpy() * 10.0 ** np.array(stretch)).astype(np.float32))
    if faint:
        values = scene.gaussians.opacities.numpy()
        scene.gaussians.opacities.assign((ALPHA_MIN * (1 + values**8)).astype(np.float32))
    arrays, opacities = projected(scene), image_opacities(scene, scene.gaussians.opacities)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(binning_step, "wants_masks", lambda device: True)
        bins = bin_tiles(
            arrays, opacities, opacities, scalar_view(scene.features), scene.settings, tile_size, by_slot=by_slot
        )
    listed = listed_tiles(bins)
    assert len(set(listed)) == len(listed) == bins.num_pairs
    emitted = np.bincount(bins.gaussian_ids.numpy(), minlength=n) if bins.num_pairs else np.zeros(n, int)
    assert (emitted == bins.tiles_per_gaussian.numpy()).all()
    assert all(0 <= tile < bins.tiles_x * bins.tiles_y for tile, _ in listed)
    extra = {"opacities": opacities.numpy().astype(np.float64), "settings": scene.settings}
    masks = bins.masks.numpy()
    parts = {
        (*pair, part) for pair, mask in zip(listed, masks, strict=True) for part in range(PARTS) if mask >> part & 1
    }
    assert drawn_parts(arrays, bins, extra, ALPHA_MIN * (1 + 1e-5)) <= parts
    assert isinstance(bins.tile_offsets, wp.array)
