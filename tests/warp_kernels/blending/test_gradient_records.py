"""Records of gradients: their layout, and their sums per Gaussian."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.blending.alpha import UNIT
from warp_kernels.blending.gradient_records import (
    distribute_kernel,
    feature_offset,
    finish_moments_kernel,
    kept_channels,
    ranges_apart,
    record_length,
    sums_apart,
)

pytestmark = pytest.mark.rotating


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
    assert ranges_apart(11, 3, 8, False) == [("rest", 10, 18)]
    assert ranges_apart(11, 11, 0, False, absgrad=True) == [("features", 6, 17)]
    assert ranges_apart(3, 3, 0, False) == []
    assert kept_channels(11, 3, True) == (3, 8)
    assert ranges_apart(11, 3, 8, True) is None


@pytest.mark.parametrize("thermal_channels", [0, 8])
def test_no_record_where_all_features_are_many(thermal_channels: int) -> None:
    """Then every sum is added where its gradient lies; not so with absolute sums, and where records are stored."""
    apart = ranges_apart(27, 5, thermal_channels, False)
    assert apart is not None
    assert [name for name, _, _ in apart[:3]] == ["means2d", "roots", "opacities"]
    assert [name for name, _, _ in apart[3:-2]] == ["thermal_opacities"] * (thermal_channels > 0)
    ends = [end for _, _, end in apart]
    assert [begin for _, begin, _ in apart] == [0, *ends[:-1]]
    assert ends[-1] == record_length(27, thermal_channels, False)
    assert sums_apart(27, 5, False, False)
    assert not any([sums_apart(27, 5, False, True), sums_apart(27, 5, True, False), sums_apart(27, 3, False, False)])
    assert not sums_apart(11, 11, False, False)


@pytest.mark.parametrize("in_place", [False, True])
def test_moments_become_gradients(in_place: bool) -> None:
    """In place, or added to what gradients hold, as they do from records. Nothing is read of what has no moments."""
    rng = np.random.default_rng(1)
    roots, sums = rng.uniform(0.5, 2.0, size=(40, 3)), rng.normal(size=(40, 6))
    roots[3], sums[3], sums[7] = np.nan, 0.0, np.nan
    vec2, vec3, record = (wp.types.vector(k, wp.float64) for k in (2, 3, 6))

    def arrays(first: np.ndarray, second: np.ndarray) -> list[wp.array]:
        return [wp.array(first.copy(), dtype=vec2, device="cpu"), wp.array(second.copy(), dtype=vec3, device="cpu")]

    before = rng.normal(size=(40, 5)) * (not in_place)
    given, expected = wp.array(roots, dtype=vec3, device="cpu"), arrays(before[:, :2], before[:, 2:])
    of_opacities, of_features = (
        wp.zeros(40, wp.float64, device="cpu"),
        wp.zeros(40, wp.types.vector(5, wp.float64), "cpu"),
    )
    records = wp.array(sums, dtype=record, device="cpu")
    tiles = wp.array((np.arange(40) != 3).astype(np.int32), dtype=wp.int32, device="cpu")
    distribute = distribute_kernel(5, 0, wp.float64, False, 0)
    ranked = [wp.empty(0, wp.int32, device="cpu"), wp.empty(0, wp.int64, device="cpu"), tiles, records, given, False]
    outputs = [*expected, of_opacities, of_opacities, of_features, None, None]
    wp.launch(distribute, dim=40, inputs=[*ranked, *outputs], device="cpu")

    moments = arrays(sums[:, :2], sums[:, 2:5])
    found = moments if in_place else arrays(before[:, :2], before[:, 2:])
    wp.launch(finish_moments_kernel(wp.float64), dim=40, inputs=[given, *moments, in_place, *found], device="cpu")
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.numpy(), other.numpy(), equal_nan=True)
        assert np.isnan(one.numpy()[7]).all()
        assert np.isfinite(one.numpy()[3]).all()
