"""What a device can do at most, measured: the bandwidth of its memory and the rates of its matrix products."""

import time
from collections.abc import Callable
from typing import NamedTuple

import torch

from measuring.timing import wait

REPEATS = 12


class DevicePeaks(NamedTuple):
    """Measured peaks; a fused multiply-add is two operations.

    Attributes:
        bytes_per_s: read and written by a copy within the device's memory.
        flops_fp32: of a float32 matrix product without tensor cores.
        flops_tf32: of a float32 matrix product whose inputs are rounded to TensorFloat-32; on the CPU, which has none,
            the same as ``flops_fp32``.
        flops_fp16: of a float16 matrix product that sums in float32: the fastest with the 10 bits of mantissa of
            TensorFloat-32. On the CPU the same as ``flops_fp32``.
    """

    bytes_per_s: float
    flops_fp32: float
    flops_tf32: float
    flops_fp16: float

    @property
    def fma_per_s(self) -> float:
        """float32 multiply-adds a second."""
        return self.flops_fp32 / 2


def measure_peaks(device: torch.device) -> DevicePeaks:
    """Copies 1 GiB (64 MiB on the CPU), and multiplies square matrices of 8192 (1024) rows in each precision.

    Args:
        device: an idle device. Takes about a second on a GPU.
    """
    on_gpu = device.type == "cuda"
    bytes_per_s = _copied_bytes_per_s(device)
    precision = torch.get_float32_matmul_precision()
    try:
        fp32 = _matmul_flops(device, torch.float32, "highest")
        if not on_gpu:
            return DevicePeaks(bytes_per_s, fp32, fp32, fp32)
        tf32 = _matmul_flops(device, torch.float32, "high")
        return DevicePeaks(bytes_per_s, fp32, tf32, _matmul_flops(device, torch.float16, "high"))
    finally:
        torch.set_float32_matmul_precision(precision)


def _copied_bytes_per_s(device: torch.device) -> float:
    source = torch.ones(2**28 if device.type == "cuda" else 2**24, device=device)
    target = torch.empty_like(source)
    return 2 * source.numel() * source.element_size() / _seconds(lambda: target.copy_(source), device)


def _matmul_flops(device: torch.device, dtype: torch.dtype, precision: str) -> float:
    torch.set_float32_matmul_precision(precision)
    size = 8192 if device.type == "cuda" else 1024
    left, right = torch.randn(2, size, size, device=device).to(dtype)
    product = torch.empty_like(left)
    return 2 * size**3 / _seconds(lambda: torch.mm(left, right, out=product), device)


def _seconds(call: Callable[[], object], device: torch.device) -> float:
    """Shortest of a dozen times of a call that takes milliseconds: a peak is what is reached undisturbed."""
    times = []
    for _ in range(REPEATS):
        wait(device)
        start_s = time.perf_counter()
        call()
        wait(device)
        times.append(time.perf_counter() - start_s)
    return min(times)
