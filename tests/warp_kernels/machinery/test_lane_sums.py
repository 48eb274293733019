"""Sums over the lanes of a warp, and over rows of a matrix on the CPU."""

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.machinery.lane_sums import accumulate_snippet, butterfly_widths, column_sums_snippet, total_function
from warp_kernels.machinery.lanes import lanes_of


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_every_lane_has_the_sum_of_its_warp(device: torch.device, dtype: type) -> None:
    """Every lane has the sum of its warp: on the CPU its own number."""
    warp_total = total_function(dtype)

    @wp.kernel(name=f"totals_{dtype.__name__}", enable_backward=False, module="unique")
    def totals_kernel(x: wp.array(dtype=dtype), y: wp.array(dtype=dtype)):
        i = wp.tid()
        y[i] = warp_total(x[i])

    where = wp.get_device(str(device))
    x = np.random.default_rng(0).normal(size=(4, 32))
    y = wp.zeros(x.size, dtype=dtype, device=where)
    wp.launch(totals_kernel, dim=x.size, inputs=[wp.array(x.ravel(), dtype=dtype, device=where), y], device=where)
    lanes = x.reshape(-1, lanes_of(where))
    expected = np.broadcast_to(lanes.sum(axis=1, keepdims=True), lanes.shape)
    assert np.allclose(y.numpy(), expected.ravel(), rtol=0, atol=2e-6 if dtype is wp.float32 else 1e-14)


@pytest.mark.parametrize("length", [1, 7, 9, 17, 18, 31, 32, 33, 42, 74])
def test_butterfly_sums_over_a_warp(length: int) -> None:
    """The CUDA source of the reduction, replayed in Python lane by lane, sums every component over 32 lanes."""
    source = accumulate_snippet(length, wp.float32)
    lane = np.arange(32)
    values = np.random.default_rng(length).normal(size=(32, length))
    stored: dict[int, float] = {}
    for start, group in enumerate(source.split("float total = (float)0;")[1:]):
        start, total, first = 32 * start, np.zeros(32), 0
        end = min(32, length - start)
        for part in group.split("float r[")[1:]:
            width = int(part.split("]")[0])
            count = min(width, end - first)
            assert part.count("v[") == count
            assert f"v[{start + first}]" in part
            r = np.zeros((32, width))
            r[:, :count] = values[:, start + first : start + first + count]
            half = width // 2
            while half:
                upper = (lane & half) != 0
                keep = np.where(upper[:, None], r[:, half : 2 * half], r[:, :half])
                send = np.where(upper[:, None], r[:, :half], r[:, half : 2 * half])
                assert f"__shfl_xor_sync(0xffffffffu, send, {half})" in part
                r = keep + send[lane ^ half]
                half //= 2
            distance = width
            while distance < 32:
                assert f"__shfl_xor_sync(0xffffffffu, r[0], {distance})" in part
                r = r + r[lane ^ distance]
                distance *= 2
            assert f"if (lane >= {first}) total = r[0];" in part
            total = np.where(lane >= first, r[:, 0], total)
            first += width
        assert f"const int k = {start} + lane; if (lane < {end}) p[k] = total;" in group
        stored |= {start + k: total[k] for k in range(end)}
    expected = values.sum(0)
    assert len(stored) == length
    assert max(abs(stored[k] - expected[k]) for k in range(length)) < 1e-12


def test_sums_go_to_several_arrays() -> None:
    """Added atomically, components of two ranges go to the features' gradients, and what is around side by side."""
    source = accumulate_snippet(40, wp.float32, apart=[("features", 6, 38)])
    assert "float* of_features = (float*)(features.data + index) - 6;" in source
    assert "atomicAdd((k < 6 ? p + k - 0 : of_features + k), total);" in source  # the first 32
    assert "atomicAdd((k < 38 ? of_features + k : p + k - 32), total);" in source
    source = accumulate_snippet(40, wp.float32, apart=[("features", 6, 9), ("rest", 9, 38)])
    assert "float* of_rest = (float*)(rest.data + index) - 9;" in source
    assert "atomicAdd((k < 6 ? p + k - 0 : k < 9 ? of_features + k : of_rest + k), total);" in source
    assert "atomicAdd((k < 38 ? of_rest + k : p + k - 32), total);" in source
    source = accumulate_snippet(40, wp.float32, apart=[("means2d", 0, 2), ("features", 2, 40)])
    assert "dst" not in source
    assert "atomicAdd((k < 2 ? of_means2d + k : of_features + k), total);" in source
    assert "atomicAdd((of_features + k), total);" in source


def test_butterflies_cover_every_count() -> None:
    """Widths fall, so that a component's lane is its number, cover the count, and cost no more than one."""
    for count in range(1, 33):
        widths = butterfly_widths(count)
        assert list(widths) == sorted(widths, reverse=True)
        assert sum(widths) >= count > sum(widths[:-1])
        shuffles = sum(width - 1 + 6 - width.bit_length() for width in widths)
        whole = 1 << (count - 1).bit_length()
        assert shuffles <= whole - 1 + 6 - whole.bit_length()


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("columns", [8, 16, 32])
@pytest.mark.parametrize("length", [1, 7, 16, 19])
def test_the_sum_of_each_row_is_in_its_place(length: int, columns: int, dtype: type) -> None:
    """Each row's sum in its place, for more and fewer rows than a vector has numbers."""
    record, matrix = wp.types.vector(length, dtype), wp.types.matrix((length, columns), dtype)

    @wp.func_native(column_sums_snippet(length, columns, dtype))
    def store_column_sums(out: wp.array(dtype=record), index: int, m: matrix): ...

    @wp.kernel(name=f"sums_{length}_{columns}_{dtype.__name__}", enable_backward=False, module="unique")
    def sums_kernel(values: wp.array(dtype=matrix), out: wp.array(dtype=record)):
        i = wp.tid()
        store_column_sums(out, i, values[i])

    values = np.random.default_rng(0).normal(size=(3, length, columns))
    out = wp.zeros(3, dtype=record, device="cpu")
    wp.launch(sums_kernel, dim=3, inputs=[wp.array(values, dtype=matrix, device="cpu"), out], device="cpu")
    assert np.allclose(
        out.numpy().reshape(3, length), values.sum(-1), rtol=0, atol=1e-5 if dtype is wp.float32 else 1e-13
    )
