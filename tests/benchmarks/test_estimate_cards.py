"""Occupancy of kernels on cards that are not at hand."""

from pathlib import Path

import pytest
import warp as wp

from estimate_cards import CARDS, MULTIPROCESSORS, slower
from measuring.cubin_resources import Resources, cubin_resources
from warp_kernels.machinery.strand_sums import strand_sum_kernel


@pytest.mark.parametrize(
    ("arch", "registers", "shared", "threads", "share"),
    [
        (75, 64, 0, 256, 1.0),  # 32 warps of 64 registers fill the 65,536
        (90, 64, 0, 256, 0.5),
        (90, 32, 0, 256, 1.0),
        (86, 16, 50 * 1024, 64, 1 / 24),  # shared memory leaves one block of two warps
        (89, 33, 0, 128, 1.0),  # 40 registers are given out: 51 warps, 48 fit
        (89, 41, 0, 128, 40 / 48),
    ],
)
def test_occupancy_is_what_fits(arch: int, registers: int, shared: int, threads: int, share: float) -> None:
    """By registers, shared memory, warps and blocks, whichever ends first."""
    used = Resources(registers, shared, 0)
    assert MULTIPROCESSORS[arch].occupancy(used, threads, 1024 if shared else 0) == pytest.approx(share)


def test_resources_are_read_out_of_a_cubin(tmp_path: Path) -> None:
    """Every kernel of a module that was compiled without a GPU, with a plausible number of registers."""
    wp.init()
    kernel = strand_sum_kernel(wp.float32, 3)
    wp.compile_aot_module(kernel.module, arch=90, module_dir=str(tmp_path), use_ptx=False)
    (cubin,) = tmp_path.glob("*.cubin")
    found = cubin_resources(cubin)
    assert any(name.startswith(kernel.key) for name in found)
    assert all(8 <= used.registers <= 255 for used in found.values())
    cubin.write_bytes(b"no cubin")
    with pytest.raises(ValueError, match="no cubin"):
        cubin_resources(cubin)


def test_slower_cards_take_longer() -> None:
    """By bandwidth; blending lies between bandwidth and arithmetic."""
    assert slower(CARDS["RTX 4060"], "binning") == pytest.approx((15.34, 15.34), abs=0.01)
    low, high = slower(CARDS["RTX 4090"], "blending")
    assert low < 1 < high
