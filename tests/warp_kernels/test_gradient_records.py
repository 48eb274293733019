"""Records of gradients: their layout, and their sums per Gaussian."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.gradient_records import distribute_kernel, feature_offset, record_length


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("thermal_channels", [0, 2])
@pytest.mark.parametrize(("per_pair", "store"), [(0, False), (0, True), (1, False), (3, False)])
def test_records_reach_the_gradients(per_pair: int, store: bool, thermal_channels: int, absgrad: bool) -> None:
    """Each Gaussian's records, by pair or already summed and without features, are added to what its gradients hold.

    Stored, gradients of Gaussians without tiles are zeros. With the root (1, 0, 1) moments are the gradients to mean2d
    and root but for the sign.
    """
    rng = np.random.default_rng(0)
    order = np.array([2, 0, 3, 1])  # depth ranks to Gaussians
    tiles = np.array([3, 0, 1, 2])  # of each Gaussian
    ends = np.cumsum(tiles[order])
    channels = 3 if per_pair else 0
    length = record_length(channels, thermal_channels, absgrad)
    records = rng.normal(size=(ends[-1] * per_pair if per_pair else 4, length))
    sums = np.zeros((4, length))
    for g, end in zip(order, ends, strict=True):
        if tiles[g]:
            own = slice((end - tiles[g]) * per_pair, end * per_pair)
            sums[g] = records[own].sum(0) if per_pair else records[g]

    parts = {"means2d": 2, "roots": 3, "opacities": 1, "thermal_opacities": 1, "features": 1, "rest": 2, "absolute": 2}
    before = {name: rng.normal(size=(4, width)) for name, width in parts.items()}
    kinds = {width: wp.types.vector(width, wp.float64) for width in (2, 3)} | {1: wp.float64}
    after = {name: wp.array(before[name].squeeze(), dtype=kinds[width], device="cpu") for name, width in parts.items()}
    after["features"] = wp.array(before["features"], dtype=wp.types.vector(1, wp.float64), device="cpu")
    wp.launch(
        distribute_kernel(3, thermal_channels, wp.float64, absgrad, per_pair, 1),
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
    columns = {"means2d": (0, 2), "roots": (2, 5), "opacities": (5, 6), "features": (first, first + min(channels, 1))}
    columns["rest"] = (first + min(channels, 1), first + channels)
    if thermal_channels:
        columns["thermal_opacities"] = (6, 7)
    if absgrad:
        columns["absolute"] = (length - 2, length)
    covered = sorted(k for begin, end in columns.values() for k in range(begin, end))
    assert covered == list(range(length))
    for name, values in after.items():
        begin, end = columns.get(name, (0, 0))
        added = sums[:, begin:end] * (-1.0 if name in ("means2d", "roots") else 1.0) if end > begin else 0.0
        stored = store and end > begin and name != "absolute"
        expected = added + (0.0 if stored else before[name])
        assert np.allclose(values.numpy().reshape(4, -1), expected, rtol=0, atol=1e-14), name
