"""Interleaved timing of competing calls, in wall-clock time on the CPU and CUDA events on a GPU."""

import time
from collections.abc import Callable, Mapping

import torch
import warp as wp

WARM_UP = 3
SECONDS_PER_CALL = 20.0
"""On the CPU a call that has taken this long in all, and ran three times, is not repeated again."""


def time_interleaved(
    calls: Mapping[str, Callable[[], object]], device: torch.device, repeats: int
) -> dict[str, dict[str, float]]:
    """Times calls A, B, A, B, ... so that both see the same clocks and neighbours.

    Args:
        calls: by name. Each is called a few times first, which compiles it.
        device: where the calls compute.
        repeats: measurements of each.

    Returns:
        For each name the median, 10th and 90th percentile [ms].
    """
    for call in calls.values():
        start_s = time.perf_counter()
        for _ in range(WARM_UP):
            call()
            if device.type == "cpu" and time.perf_counter() - start_s > SECONDS_PER_CALL / 10:
                break
    measured: dict[str, list[float]] = {name: [] for name in calls}
    if device.type == "cuda":
        events: dict[str, list[tuple[torch.cuda.Event, torch.cuda.Event]]] = {name: [] for name in calls}
        torch.cuda.synchronize(device)
        for _ in range(repeats):
            for name, call in calls.items():
                start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
                start.record()
                call()
                end.record()
                events[name].append((start, end))
                torch.cuda.synchronize(device)
        measured = {name: [start.elapsed_time(end) for start, end in pairs] for name, pairs in events.items()}
    else:
        for _ in range(repeats):
            for name, call in calls.items():
                if len(measured[name]) >= 3 and sum(measured[name]) > 1e3 * SECONDS_PER_CALL:
                    continue
                start_s = time.perf_counter()
                call()
                measured[name].append(1e3 * (time.perf_counter() - start_s))
    return {name: summary(values) for name, values in measured.items()}


def summary(milliseconds: list[float]) -> dict[str, float]:
    """Median and spread of measurements [ms]."""
    low, median, high = torch.tensor(milliseconds, dtype=torch.float64).quantile(torch.tensor([0.1, 0.5, 0.9]).double())
    numbers = {"median_ms": median.item(), "p10_ms": low.item(), "p90_ms": high.item()}
    return {key: round(value, 4) for key, value in numbers.items()} | {"repeats": len(milliseconds)}


def peak_memory(call: Callable[[], object], device: torch.device) -> float | None:
    """GPU memory a call needs beyond what is held before it, in torch's pool and Warp's together [MiB].

    Args:
        call: what to run once.
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
    warp_before = wp.get_mempool_used_mem_current(warp_device) if pooled else 0
    call()
    torch.cuda.synchronize(device)
    torch_peak = torch.cuda.max_memory_allocated(device) - torch_before
    # Warp's high-water mark cannot be reset: an upper bound once larger cases have run.
    warp_peak = max(0, wp.get_mempool_used_mem_high(warp_device) - warp_before) if pooled else 0
    return round((torch_peak + warp_peak) / 2**20, 1)
