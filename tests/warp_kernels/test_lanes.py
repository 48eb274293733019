"""Arithmetic of the lane helpers on the CPU."""

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.lanes import (
    accumulate_snippet,
    butterfly_widths,
    column_sums_snippet,
    count_bits,
    lane_functions,
    shuffle_function,
    warp_owner,
    warp_scan,
    warp_shuffle,
)

EXP2_F32, ATTENUATE, RECIPROCAL = lane_functions(wp.float32)
EXP2_F64 = lane_functions(wp.float64)[0]
SHUFFLE_F64 = shuffle_function(wp.float64)


@wp.kernel(enable_backward=False, module="unique")
def exp2_f32_kernel(x: wp.array(dtype=wp.float32), y: wp.array(dtype=wp.float32)):
    """The blend's exponential in float32."""
    i = wp.tid()
    y[i] = EXP2_F32(x[i])


@wp.kernel(enable_backward=False, module="unique")
def exp2_f64_kernel(x: wp.array(dtype=wp.float64), y: wp.array(dtype=wp.float64)):
    """The blend's exponential in float64."""
    i = wp.tid()
    y[i] = EXP2_F64(x[i])


@wp.kernel(enable_backward=False, module="unique")
def attenuate_kernel(t: wp.array(dtype=wp.float32), a: wp.array(dtype=wp.float32), y: wp.array(dtype=wp.float32)):
    """A layer's effect on the transmittance, once for the product that the blend also needs."""
    i = wp.tid()
    y[i] = ATTENUATE(t[i], a[i]) + wp.float32(0.0) * (a[i] * t[i])


@wp.kernel(enable_backward=False, module="unique")
def reciprocal_kernel(x: wp.array(dtype=wp.float32), y: wp.array(dtype=wp.float32)):
    """1 / x without a division's branches."""
    i = wp.tid()
    y[i] = RECIPROCAL(x[i])


@wp.kernel(enable_backward=False, module="unique")
def bits_kernel(x: wp.array(dtype=wp.uint32), count: wp.array(dtype=int), upto: wp.array(dtype=int)):
    """Number of set bits, and the sum over the warp's lanes up to this one."""
    i = wp.tid()
    count[i] = count_bits(x[i])
    upto[i] = warp_scan(i)


@wp.kernel(enable_backward=False, module="unique")
def deal_kernel(
    counts: wp.array(dtype=int),
    items: wp.array(dtype=int),
    owner: wp.array(dtype=int),
    owners_count: wp.array(dtype=int),
    owners_half: wp.array(dtype=wp.float64),
):
    """Whose an item of the warp's lanes is, and two of that lane's numbers."""
    i = wp.tid()
    end = warp_scan(counts[i])
    owner[i] = warp_owner(end, items[i])
    owners_count[i] = warp_shuffle(counts[i], owner[i])
    owners_half[i] = SHUFFLE_F64(wp.float64(counts[i]) / wp.float64(2.0), owner[i])


@pytest.mark.parametrize(("dtype", "tolerance"), [(wp.float32, 1e-7), (wp.float64, 4e-16)])
def test_exponential(dtype: type, tolerance: float) -> None:
    """2^x where alpha can reach 1/255 (x >= -log2 255): relative error of a few roundings, exactly 1 at 0."""
    x = np.concatenate([[0.0], -np.logspace(-8, np.log10(np.log2(255.0)), 4000)])
    array = wp.array(x, dtype=dtype, device="cpu")
    y = wp.zeros(len(x), dtype=dtype, device="cpu")
    wp.launch(exp2_f32_kernel if dtype is wp.float32 else exp2_f64_kernel, dim=len(x), inputs=[array, y], device="cpu")
    truth = np.exp2(array.numpy().astype(np.float64))
    assert np.abs(y.numpy() / truth - 1).max() < tolerance
    assert y.numpy()[0] == 1.0


def test_exponential_far_below_zero() -> None:
    """Exponents beyond float32's range give a negligible number, not garbage."""
    x = wp.array([-130.0, -1e4, -1e30, -np.inf], dtype=wp.float32, device="cpu")
    y = wp.zeros(4, dtype=wp.float32, device="cpu")
    wp.launch(exp2_f32_kernel, dim=4, inputs=[x, y], device="cpu")
    assert (y.numpy() >= 0).all()
    assert (y.numpy() < 1e-37).all()


@pytest.mark.parametrize("largest", [0.008, 0.5, 0.999])
def test_attenuation(largest: float) -> None:
    """t (1 - a) is good to a rounding or two for faint and for opaque layers, where t - a t would cancel."""
    rng = np.random.default_rng(0)
    t, a = rng.random(5000).astype(np.float32), rng.uniform(0.9 * largest, largest, 5000).astype(np.float32)
    y = wp.zeros(5000, dtype=wp.float32, device="cpu")
    wp.launch(
        attenuate_kernel, dim=5000, inputs=[wp.array(t, device="cpu"), wp.array(a, device="cpu"), y], device="cpu"
    )
    truth = t.astype(np.float64) * (1 - a.astype(np.float64))
    assert np.abs(y.numpy() / truth - 1).max() < 1.2e-7


def test_reciprocal(device: torch.device) -> None:
    """1 / x to a rounding for the x that 1 - alpha takes."""
    x = np.concatenate([np.linspace(0.001, 1.0, 100_000), 1.0 - np.logspace(-8, -1, 1000)]).astype(np.float32)
    y = wp.zeros(len(x), dtype=wp.float32, device=str(device))
    wp.launch(reciprocal_kernel, dim=len(x), inputs=[wp.array(x, device=str(device)), y], device=str(device))
    assert np.abs(y.numpy() * x.astype(np.float64) - 1).max() < 7e-8


ON_BOTH = pytest.mark.parametrize("on", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])


@ON_BOTH
def test_bits_and_scans(on: str) -> None:
    """A ballot's takers, and the lanes' sum so far: on the CPU a warp is one lane."""
    x = np.array([0, 1, 3, 0x80000000, 0xFFFFFFFF, 0b10110000] + 58 * [0], np.uint32)
    counts, scans = (wp.zeros(len(x), dtype=int, device=on) for _ in range(2))
    wp.launch(bits_kernel, dim=len(x), inputs=[wp.array(x, dtype=wp.uint32, device=on), counts, scans], device=on)
    assert counts.numpy()[:6].tolist() == [0, 1, 2, 1, 32, 3]
    lanes = np.arange(len(x)).reshape(-1, 32 if on == "cuda" else 1)
    assert scans.numpy().tolist() == lanes.cumsum(axis=1).flatten().tolist()


@ON_BOTH
@pytest.mark.parametrize("most", [1, 3, 40])
def test_items_are_dealt(on: str, most: int) -> None:
    """Each item finds the lane that has it, past lanes that have none; items that nobody has find the last lane."""
    width, rng = 32 if on == "cuda" else 1, np.random.default_rng(most)
    counts = rng.integers(0, most + 1, size=(96 // width, width))
    counts[0] = 0
    items = rng.integers(0, 2 + counts.sum(axis=1, keepdims=True), size=counts.shape)
    given = [wp.array(numbers.ravel(), dtype=int, device=on) for numbers in (counts, items)]
    owner, owners_count = (wp.zeros(counts.size, dtype=int, device=on) for _ in range(2))
    owners_half = wp.zeros(counts.size, dtype=wp.float64, device=on)
    wp.launch(deal_kernel, dim=counts.size, inputs=[*given, owner, owners_count, owners_half], device=on)
    holders = [list(np.repeat(np.arange(width), row)) + 2 * [width - 1] for row in counts]
    expected = np.array([[holder[item] for item in row] for holder, row in zip(holders, items, strict=True)])
    assert owner.numpy().tolist() == expected.ravel().tolist()
    assert owners_count.numpy().tolist() == np.take_along_axis(counts, expected, axis=1).ravel().tolist()
    assert (2 * owners_half.numpy() == owners_count.numpy()).all()


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
    assert source.count("atomicAdd((k < 6 ? p + k - 0 : k < 38 ? of_features + k : p + k - 32), total);") == 2
    source = accumulate_snippet(40, wp.float32, apart=[("features", 6, 9), ("rest", 9, 38)])
    assert "float* of_rest = (float*)(rest.data + index) - 9;" in source
    places = "k < 6 ? p + k - 0 : k < 9 ? of_features + k : k < 38 ? of_rest + k : p + k - 32"
    assert source.count(f"atomicAdd(({places}), total);") == 2


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
def test_column_sums(length: int, columns: int, dtype: type) -> None:
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
