"""Which tensors first held something that is not finite, by one Warp kernel."""

import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import numbered_parts, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.tensor_tables import BLOCK, addresses, counts, launches
from warp_kernels.training.finite_check import note_bad_kernel


def note_by_warp(named: list[list[Tensor]], step: Tensor, first_bad_step: Tensor, blocked: Tensor) -> None:
    """Note the step where something is not finite, or so large that its square is not. Never waits for the device.

    Args:
        named: float32 tensors by name.
        step: The step's number, int64 scalar.
        first_bad_step: int64, one for each name, 0 as long as all was finite; changed in place.
        blocked: float32 scalar; 1 afterwards where something was not finite, else as before.
    """
    flat = [
        (place, part)
        for place, tensors in enumerate(named)
        for tensor in tensors
        for part in numbered_parts(tensor.contiguous())
    ]
    places, sizes = [place for place, _ in flat], [part.numel() for _, part in flat]
    with launches_on_torch_stream(step.device) as device:
        arrays = [view(part, wp.float32) for _, part in flat]
        scalars = [view(step, wp.int64), view(first_bad_step, wp.int64), view(blocked, wp.float32)]
        for some, ends in launches(sizes):
            tables = [counts(ends), counts(sizes[some]), counts(places[some]), addresses(arrays[some])]
            launch_again(note_bad_kernel, ends[-1], [*tables, *scalars], device, BLOCK)
