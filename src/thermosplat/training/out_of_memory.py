"""Telling an exhausted device from other errors, and saying what helps."""

import torch

from thermosplat.errors import UserError

_WARP_ALLOCATION = "Failed to allocate"  # the start of Warp's RuntimeError, on the CPU and on CUDA
_TORCH_CPU_ALLOCATION = "can't allocate memory"  # "DefaultCPUAllocator: can't allocate memory: you tried to ..."


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out, be it torch's, Warp's or Python's own."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    text = str(error)
    return isinstance(error, RuntimeError) and (_WARP_ALLOCATION in text or _TORCH_CPU_ALLOCATION in text)


def out_of_memory_error(
    step: int,
    num_gaussians: int,
    image_size: str,
    device: torch.device,
    saved: str,
    resume_command: str,
    *,
    can_offload: bool = False,
    scenes: int = 1,
) -> UserError:
    """The error to show.

    Args:
        can_offload: Whether moving parameters to the host's memory would help.
        scenes: Among how many a limit of the Gaussians is divided.
    """
    where = "memory"
    if device.type == "cuda":
        used = torch.cuda.max_memory_allocated(device) / 2**30
        total = torch.cuda.get_device_properties(device).total_memory / 2**30
        where = f"GPU memory ({used:.1f} of {total:.1f} GiB)"
    return UserError(
        f"Out of {where} at step {step:,} with {num_gaussians:,} Gaussians at {image_size}. {saved}",
        f"Go on with: {resume_command} and --data-factor 2 (smaller images), "
        f"{'--offload on (spherical harmonics and features in the host memory), ' if can_offload else ''}"
        f"or --densification.max-gaussians {scenes * _round_down(num_gaussians)} (no more Gaussians than that).",
    )


def _round_down(count: int) -> int:
    """A count with one significant digit, below ``count``: a cap to suggest."""
    digit = 10 ** max(len(str(count)) - 1, 0)
    return max(count // digit * digit, 1)
