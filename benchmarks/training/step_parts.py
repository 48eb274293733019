"""Which part of a training step a profiled kernel, or on the CPU an operator, belongs to."""

from collections.abc import Callable
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from measuring.timing import wait
from thermosplat.training.trainer import Trainer
from training.frozen_training import run_steps

PARTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("image losses", ("image_loss_", "_ImageLoss", "_WindowFilter", "conv2d", "convolution")),
    (
        "projection adjoint",
        (
            *("project_adjoint", "activate_adjoint", "finish_camera_gradients", "strand_sums", "ProjectBackward"),
            *("affine_camera_adjoint", "finish_lens_gradients", "motion_adjoint"),
        ),
    ),
    ("projection", ("project_", "activate_", "affine_cameras", "lens_limits", "make_motions", "Project")),
    # small products: SH from the coordinates that the fit of splats learns
    ("SH adjoint", ("sh_colors_adjoint", "camera_position_adjoint", "small_product_transposed")),
    ("SH", ("sh_colors", "camera_positions", "small_product")),
    ("blending adjoint", ("blend_adjoint", "distribute_", "finish_moments", "BlendBackward")),
    (
        "blending",
        ("blend_", "deal_states", "segment_light", "join_segments", "median_depth_", "Blend"),
    ),
    (
        "binning",
        ("count_tiles", "compact_gaussians", "gather_counts", "emit_pairs", "tile_ranges", "RadixSort", "DeviceScan"),
    ),
    ("exchange", ("gather_rows", "place_rows", "nccl", "Exchange")),  # of several ranks
    ("optimizer", ("adam", "Adam", "row_fetch")),
    ("bookkeeping", ("note_bad", "note_density", "note_pairs")),
    ("penalties, noise", ("gaussian_means", "join_moments", "take_spreads", "add_position_noise")),
    (
        "decoders",
        (
            *("decode_", "gemm", "triton", "_Branch"),
            *("cutlass", "nvjet", "splitK", "aten::mm", "addmm", "silu", "cover_", "point_spread"),
        ),
    ),
)
"""Parts and what their kernels' names contain; the first that fits. The rest is "rest"."""

REST = "rest"

TORCH_FIRST: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("NCCL", ("nccl",)),
    ("rows for ranks", ("gather_rows", "place_rows")),
    ("sums in a row (torch)", ("at_cuda_detail", "tensor_kernel_scan")),  # the binning has sorts and sums of its own
)
TORCH_LAST: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("copies", ("Memcpy", "direct_copy", "CatArray", "_copy_kernel", "multi_tensor_apply")),
    ("fills", ("Memset", "FillFunctor")),
    ("places of rows", ("arange", "scatter_gather", "where_kernel", "CompareFunctor", "compare_scalar", "index")),
    ("sums (torch)", ("reduce_kernel",)),
    ("sums and products (torch)", ("elementwise_kernel",)),
)
"""What torch's own kernels do, before and after ``PARTS``."""


def part_of(kernel: str) -> str:
    """The part that a kernel of that name belongs to."""
    return next((part for part, words in PARTS if any(word in kernel for word in words)), REST)


def finer_part_of(kernel: str) -> str:
    """The part that a kernel of that name belongs to, with exchanges and torch's own kernels told apart."""
    for parts in (TORCH_FIRST, PARTS, TORCH_LAST):
        for part, words in parts:
            if any(word in kernel for word in words):
                return part
    return REST


def profiled_steps(trainer: Trainer, steps: int) -> list[dict[str, Any]]:
    """Kernels (on the CPU operators) of so many steps, the costliest first.

    Returns:
        For each ``name``, ``part``, and a step's ``microseconds`` and ``calls``.
    """
    return profiled(lambda: run_steps(trainer, steps), steps, trainer.device)


def profiled(work: Callable[[], object], count: int, device: torch.device) -> list[dict[str, Any]]:
    """Kernels (on the CPU operators) of some work, the costliest first.

    Args:
        work: Launches what is profiled.
        count: How often it does so.
        device: Where.

    Returns:
        For each ``name``, ``part``, and of one time ``microseconds`` and ``calls``.
    """
    on_cuda = device.type == "cuda"
    wait(device)
    with profile(activities=[ProfilerActivity.CUDA if on_cuda else ProfilerActivity.CPU]) as recorded:
        work()
        wait(device)
    kernels = []
    for event in recorded.key_averages():
        total = event.self_device_time_total if on_cuda else event.self_cpu_time_total
        if total > 0:
            kernel = {"name": event.key, "part": part_of(event.key)}
            kernels.append(kernel | {"microseconds": total / count, "calls": event.count / count})
    return sorted(kernels, key=lambda kernel: -kernel["microseconds"])


def part_times(kernels: list[dict[str, Any]]) -> dict[str, float]:
    """Milliseconds a step of each part, in the order of a step as far as kernels have one."""
    names = ["projection", "SH", "binning", "blending", "decoders", "image losses"]
    names += ["blending adjoint", "SH adjoint", "projection adjoint", "exchange", "optimizer"]
    names += ["bookkeeping", "penalties, noise", REST]
    times = dict.fromkeys(names, 0.0)
    for kernel in kernels:
        times[kernel["part"]] += kernel["microseconds"] / 1e3
    return {name: milliseconds for name, milliseconds in times.items() if milliseconds > 0}
