"""Arithmetic of the lane helpers on the CPU."""

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.machinery.lanes import (
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
