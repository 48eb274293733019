"""The kernels of a training step as it runs, captured or not, by name, and which part of the step they belong to."""

import re
from typing import Any

from steady_training import run_steps
from torch.profiler import ProfilerActivity, profile

from thermosplat.training.trainer import Trainer

PROFILED = 20
"""Steps that are profiled."""

PARTS = {
    "rasterization forward": r"^(project|sh_colors|blend)_(?!adjoint)|^(count_tiles|gather_counts|emit_pairs"
    r"|tile_ranges)|RadixSort|DeviceScan",
    "rasterization backward": r"^(project|sh_colors|blend|camera_position)_adjoint|^(distribute|strand_sums"
    r"|finish_camera)",
    "decoders": r"^(forward|backward|square_weights|narrow_weights)_kernel|^triton_|gemm|cutlass|xmma",
    "image losses": r"^image_loss_",
    "optimizer": r"^adam_|multi_tensor_apply|[Ff]used_?[Aa]dam",
    "copies": r"^Mem(cpy|set)",
}
"""Patterns of kernel names; the first that is found decides. What none is found in is torch's: "others"."""


def part_of(kernel: str) -> str:
    """The part of a step that a kernel belongs to, a key of ``PARTS`` or "others".

    Args:
        kernel: Its name, as the profiler gives it.
    """
    return next((part for part, pattern in PARTS.items() if re.search(pattern, kernel)), "others")


def step_kernels(trainer: Trainer) -> list[dict[str, Any]]:
    """Kernels of a step (on the CPU torch's operators): name, microseconds and calls a step, the costliest first.

    Args:
        trainer: Warm.
    """
    on_cuda = trainer.device.type == "cuda"
    with profile(activities=[ProfilerActivity.CUDA if on_cuda else ProfilerActivity.CPU]) as recorded:
        run_steps(trainer, PROFILED)
    kernels = []
    for event in recorded.key_averages():
        total = event.self_device_time_total if on_cuda else event.self_cpu_time_total
        if total > 0:
            kernels.append({"name": event.key, "microseconds": total / PROFILED, "calls": event.count / PROFILED})
    return sorted(kernels, key=lambda kernel: -kernel["microseconds"])


def milliseconds_by_part(kernels: list[dict[str, Any]]) -> dict[str, float]:
    """Milliseconds a step of each part that has kernels.

    Args:
        kernels: From :func:`step_kernels`, on CUDA.
    """
    parts: dict[str, float] = {}
    for kernel in kernels:
        part = part_of(kernel["name"])
        parts[part] = parts.get(part, 0.0) + kernel["microseconds"] / 1e3
    return parts
