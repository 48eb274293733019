"""Peak GPU memory of a call, in torch's pool and in the driver's pool that Warp allocates from."""

import ctypes
from collections.abc import Callable

import torch
import warp as wp

USED_MEM_HIGH = 8
"""CU_MEMPOOL_ATTR_USED_MEM_HIGH of the CUDA driver API."""


def peak_memory(call: Callable[[], object], device: torch.device) -> float | None:
    """GPU memory a call needs beyond what is held before it, what it returns included [MiB].

    Args:
        call: what to run once; compiled and warm.
        device: where it computes.

    Returns:
        The peak, or None on the CPU.
    """
    if device.type != "cuda":
        return None
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    torch_before = torch.cuda.memory_allocated(device)
    warp_device = wp.get_cuda_device(device.index or 0)
    pooled = wp.is_mempool_enabled(warp_device)
    if pooled and not _reset_high_water_mark(warp_device):
        print("The CUDA driver did not reset its pool's high-water mark; peak memory is an upper bound.", flush=True)
    warp_before = wp.get_mempool_used_mem_current(warp_device) if pooled else 0
    call()
    torch.cuda.synchronize(device)
    torch_peak = torch.cuda.max_memory_allocated(device) - torch_before
    warp_peak = max(0, wp.get_mempool_used_mem_high(warp_device) - warp_before) if pooled else 0
    return round((torch_peak + warp_peak) / 2**20, 1)


def _reset_high_water_mark(device: wp.Device) -> bool:
    """Sets the pool's high-water mark to what is used now, which Warp does not offer; whether that worked."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    handle, pool, zero = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_uint64(0)
    codes = [
        driver.cuDeviceGet(ctypes.byref(handle), device.ordinal),
        driver.cuDeviceGetDefaultMemPool(ctypes.byref(pool), handle),
        driver.cuMemPoolSetAttribute(pool, USED_MEM_HIGH, ctypes.byref(zero)),
    ]
    return not any(codes)
