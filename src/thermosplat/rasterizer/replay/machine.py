"""What replaying asks of a device: how fast it copies, how much memory it has, and who records."""

import functools
from collections.abc import Callable

import torch

from thermosplat.rasterizer.replay.call_signature import Place, cuda_place
from thermosplat.rasterizer.replay.cuda_graphs import CudaGraphs, Recorder

COPIES_MS = 0.15
"""Most time that the copies of a call may take on the device [ms]. A replay saves 0.4 ms of the host's time or more
(benchmarks/notes/calls-from-python.md); a frame with more to copy is not limited by the host."""

COPIES_WITH_GRADIENTS_MS = 0.4
"""The same for a call that is differentiated: its replay saves 0.9 ms or more, and has more to copy."""


class Machine:
    """What replaying needs of a device; tests have another one.

    Attributes:
        serves: Whether anything may be replayed at all.
        place: Where a call's work is done, or None where nothing may be replayed.
    """

    serves: Callable[[], bool] = staticmethod(torch.cuda.is_initialized)
    place: Place = staticmethod(cuda_place)

    def recorder(self, device: torch.device) -> Recorder:
        """Records a call."""
        return CudaGraphs(device)

    def copied_at_most(self, device: torch.device, differentiated: bool) -> float:
        """Bytes that may be copied in a call, with its backward pass if there is one, from measured speed."""
        return 1e-3 * (COPIES_WITH_GRADIENTS_MS if differentiated else COPIES_MS) * bytes_copied_per_s(device)

    def memory(self, device: torch.device) -> tuple[int, int]:
        """Bytes that are allocated and those that there are."""
        return torch.cuda.memory_reserved(device), torch.cuda.get_device_properties(device).total_memory

    def wait(self, device: torch.device) -> None:
        """Until nothing that is let go is used any more."""
        torch.cuda.synchronize(device)


@functools.cache
def bytes_copied_per_s(device: torch.device) -> float:
    """How fast the device copies, measured once."""
    source = torch.empty(2**26, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    times = []
    for _ in range(4):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        target.copy_(source)
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return 1e3 * source.nbytes / min(times)
