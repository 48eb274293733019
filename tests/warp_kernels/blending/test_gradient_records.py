"""Records of gradients: their layout, and their sums per Gaussian."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.blending.alpha import UNIT
from warp_kernels.blending.gradient_records import (
    distribute_kernel,
    feature_offset,
    kept_channels,
    ranges_apart,
    record_length,
)


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("thermal_channels", [0, 2])
@pytest.mark.parametrize(("per_pair", "store"), [(0, False), (0, True), (1, False), (3, False)])
@pytest.mark.parametrize(("width", "others"), [(3, 2), (3, 6), (5, 2), (5, 6)])
def test_records_reach_the_gradients(
    width: int, others: int, per_pair: int, store: bool, thermal_channels: int, absgrad: bool
) -> None:
    """Each Gaussian's records, by pair or already summed, are added to what its gradients hold.

    Stored, gradients of Gaussians without tiles are zeros. With the root (1, 0, 1) moments are the gradients to mean2d
    and root but for the sign and the unit.
    """
    rng = np.random.default_rng(0)
    order = np.array([2, 0, 3, 1])  # depth ranks to Gaussians
    tiles = np.array([3, 0, 1, 2])  # of each Gaussian
    ends = np.cumsum(tiles[order])
    kept, kept_others = kept_channels(width + others, width, per_pair > 0)
    length = record_length(kept + kept_others, thermal_channels, absgrad)
    records = rng.normal(size=(ends[-1] * per_pair if per_pair else 4, length))
    sums = np.zeros((4, length))
    for g, end in zip(order, ends, strict=True):
        if tiles[g]:
            own = slice((end - tiles[g]) * per_pair, end * per_pair)
            sums[g] = records[own].sum(0) if per_pair else records[g]

    parts = {"means2d": 2, "roots": 3, "opacities": 1, "thermal_opacities": 1}
    parts |= {"features": width, "rest": others, "absolute": 2}
    before = {name: rng.normal(size=(4, size)) for name, size in parts.items()}
    kinds = {size: wp.types.vector(size, wp.float64) for size in (2, 3, width, others)} | {1: wp.float64}
    after = {name: wp.array(before[name].squeeze(), dtype=kinds[size], device="cpu") for name, size in parts.items()}
    wp.launch(
        distribute_kernel(width + others, thermal_channels, wp.float64, absgrad, per_pair, width),
        dim=4,
        inputs=[
            wp.array(order, dtype=wp.int32, device="cpu"),
            wp.array(ends, dtype=wp.int64, device="cpu"),
            wp.array(tiles, dtype=wp.int32, device="cpu"),
            wp.array(records, dtype=wp.types.vector(length, wp.float64), device="cpu"),
            wp.array(np.tile([1.0, 0.0, 1.0], (4, 1)), dtype=kinds[3], device="cpu"),
            store,
            *after.values(),
        ],
        device="cpu",
    )
    first = feature_offset(thermal_channels)
    columns = {"means2d": (0, 2), "roots": (2, 5), "opacities": (5, 6), "features": (first, first + kept)}
    columns["rest"] = (first + kept, first + kept + kept_others)
    if thermal_channels:
        columns["thermal_opacities"] = (6, 7)
    if absgrad:
        columns["absolute"] = (length - 2, length)
    covered = sorted(k for begin, end in columns.values() for k in range(begin, end))
    assert covered == list(range(length))
    for name, values in after.items():
        begin, end = columns.get(name, (0, 0))
        factor = {"means2d": -UNIT, "roots": -(UNIT**2), "absolute": UNIT**2}.get(name, 1.0)
        added = factor * sums[:, begin:end] if end > begin else 0.0
        stored = store and end > begin and name != "absolute"
        expected = added + (0.0 if stored else before[name])
        assert np.allclose(values.numpy().reshape(4, -1), expected, rtol=0, atol=1e-14), name


def test_few_features_stay_in_the_record() -> None:
    """Of colours and many features the colours do; stored records have all."""
    assert kept_channels(11, 3, False) == (3, 0)
    assert ranges_apart(11, 3, 7, False) == [("rest", 10, 18)]
    assert ranges_apart(11, 11, 6, False) == [("features", 6, 17)]
    assert ranges_apart(3, 3, 6, False) == []
    assert kept_channels(11, 3, True) == (3, 8)
    assert ranges_apart(11, 3, 7, True) is None
