"""What a profile says of a CUDA device's time."""

from collections.abc import Iterable
from typing import NamedTuple

import torch

TO_DEVICE = "Memcpy HtoD"
"""How torch's profiler calls copies from the host; a copying unit of its own makes them."""


class DeviceTime(NamedTuple):
    """Time of a profile's device [s]."""

    busy_s: float
    """In which some kernel ran, or memory was set or copied within the device."""
    to_device_s: float
    """Of all copies from the host."""


def device_time(profile: torch.profiler.profile) -> DeviceTime:
    """Time of a finished profile of CUDA activities. Kernels that run at the same time count once."""
    kernels, copies = [], 0.0
    for event in profile.events() or ():
        if event.device_type != torch.autograd.DeviceType.CUDA:
            continue
        start, end = event.time_range.start, event.time_range.end
        if event.name.startswith(TO_DEVICE):
            copies += end - start
        else:
            kernels.append((start, end))
    return DeviceTime(1e-6 * covered(kernels), 1e-6 * copies)


def covered(spans: Iterable[tuple[float, float]]) -> float:
    """Length of the union of spans, each from a start to an end."""
    total, reached = 0.0, float("-inf")
    for start, end in sorted(spans):
        total += max(end - max(start, reached), 0.0)
        reached = max(reached, end)
    return total
