"""Interleaved timing of competing calls, in wall-clock time on the CPU and CUDA events on a GPU."""

import functools
import time
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

WARM_UP = 3
SLOW_S = 1.0
"""On the CPU a call that takes longer needs no warm-up, once it is compiled: its first time counts."""

SECONDS_PER_CALL = 20.0
"""On the CPU a call that has taken this long in all, and ran three times, is not repeated again."""

FLUSHED_BYTES = 256 * 2**20
"""Written before each measurement on a GPU, so that no call finds its data in the cache (50 MB on an H200)."""

HEAD_START_CYCLES = 1_000_000
"""The device is kept busy for about half a millisecond while the host launches a stage."""


def time_interleaved(
    calls: Mapping[str, Callable[[], object]], device: torch.device, repeats: int, *, hide_host: bool = False
) -> dict[str, dict[str, float]]:
    """Times calls A, B, A, B, ... so that both see the same clocks and neighbours.

    Args:
        calls: by name; compiled, that is called before.
        device: where the calls compute.
        repeats: measurements of each.
        hide_host: let the host run ahead of the device, so that launching a stage of a few microseconds is not counted
            as its time. Otherwise each call begins with nothing queued, as in a loop that reads its loss.

    Returns:
        For each name the median, 10th and 90th percentile [ms], and ``host_ms``, the median time until the call
        returns without waiting for the device (where the call itself waits for the device, that is in it).
    """
    measured: dict[str, list[float]] = {name: [] for name in calls}
    host: dict[str, list[float]] = {name: [] for name in calls}
    for name, call in calls.items():
        for _ in range(WARM_UP):
            start_s = time.perf_counter()
            call()
            took_s = time.perf_counter() - start_s
            if device.type == "cpu" and took_s > SLOW_S:
                measured[name].append(1e3 * took_s)
                host[name].append(1e3 * took_s)
                break
    for _ in range(repeats):
        for name, call in calls.items():
            if device.type == "cuda":
                device_ms, host_ms = _time_on_gpu(call, device, hide_host)
            elif len(measured[name]) >= 3 and sum(measured[name]) > 1e3 * SECONDS_PER_CALL:
                continue
            else:
                start_s = time.perf_counter()
                call()
                device_ms = host_ms = 1e3 * (time.perf_counter() - start_s)
            measured[name].append(device_ms)
            host[name].append(host_ms)
    return {name: summary(values) | {"host_ms": summary(host[name])["median_ms"]} for name, values in measured.items()}


def wait(device: torch.device) -> None:
    """Until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _time_on_gpu(call: Callable[[], object], device: torch.device, hide_host: bool) -> tuple[float, float]:
    """Milliseconds on the device, and until the call returned."""
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    _flushed(device).zero_()
    if hide_host:
        torch.cuda._sleep(HEAD_START_CYCLES)
    else:
        torch.cuda.synchronize(device)
    start_s = time.perf_counter()
    start.record()
    call()
    end.record()
    host_s = time.perf_counter() - start_s
    torch.cuda.synchronize(device)
    return start.elapsed_time(end), 1e3 * host_s


@functools.cache
def _flushed(device: torch.device) -> Tensor:
    return torch.empty(FLUSHED_BYTES, dtype=torch.uint8, device=device)


def summary(milliseconds: list[float]) -> dict[str, float]:
    """Median and spread of measurements [ms]."""
    low, median, high = torch.tensor(milliseconds, dtype=torch.float64).quantile(torch.tensor([0.1, 0.5, 0.9]).double())
    numbers = {"median_ms": median.item(), "p10_ms": low.item(), "p90_ms": high.item()}
    return {key: round(value, 4) for key, value in numbers.items()} | {"repeats": len(milliseconds)}
