"""The kernels of a training step on the CPU, to compile them before they are needed.

Each is compiled when it is first launched, one after the other. Whoever knows that a training step comes can have them
compiled meanwhile, on several cores.
"""

import warp as wp

from warp_kernels.binning.pair_notes import note_pairs_kernel
from warp_kernels.binning.tile_binning import binning_kernels
from warp_kernels.binning.tile_ranges import fill_room_kernel, tile_ranges_kernel
from warp_kernels.blending.blend_layout import default_layout
from warp_kernels.blending.blend_variant import blend_variant
from warp_kernels.blending.blending import blend_kernel
from warp_kernels.blending.blending_adjoint import blend_adjoint_kernel
from warp_kernels.blending.gradient_records import distribute_kernel
from warp_kernels.color.camera_positions import camera_position_kernels
from warp_kernels.color.spherical_harmonics import ColorVariant, color_adjoint_kernel, color_kernel
from warp_kernels.constants import CHANNELS_MAX
from warp_kernels.machinery.launching import num_threads
from warp_kernels.machinery.loading import load_for_cpu, must_compile
from warp_kernels.projection.projection import projection_kernel
from warp_kernels.projection.projection_adjoint import projection_adjoint_kernel

TILE_SIZE = 16
"""The rasterizer's default [px]."""

COLORS = 3
"""Channels of the colours, which lie apart from the features, as do their images."""


def cpu_step_kernels(channels: int, thermal_channels: int) -> list[wp.Kernel]:
    """What a forward and backward pass in a step of ``PairCapacity`` launches on the CPU.

    The camera is a perspective one that is not trained.

    Args:
        channels: blended with the first opacity: colours from spherical harmonics, and features.
        thermal_channels: blended with the second; 0 for none.

    Returns:
        The kernels, float32, the slowest to compile first. Without those that blend, if there are more channels than
        one traversal blends.
    """
    dtype, camera_model, lanes = wp.float32, "pinhole", 1
    blending = []
    if channels + thermal_channels <= CHANNELS_MAX:
        layout = default_layout(wp.get_device("cpu"), TILE_SIZE, channels, thermal_channels, dtype, 0, 1)
        variant = blend_variant(channels, thermal_channels, dtype, layout, COLORS)
        blending = [
            blend_adjoint_kernel(variant, False, True),
            blend_kernel(variant),
            distribute_kernel(channels, thermal_channels, dtype, False, layout.warps, COLORS),
        ]
    count, _, gather, emit = binning_kernels(dtype, lanes)  # what is compacted on CUDA is few here
    return [
        projection_kernel(dtype, camera_model, False),
        *blending[:1],
        projection_adjoint_kernel(dtype, camera_model, False, False, False),
        *blending[1:2],
        color_adjoint_kernel(dtype, ColorVariant()),
        count,
        emit,
        color_kernel(dtype, False, ColorVariant()),
        *blending[2:],
        tile_ranges_kernel,
        camera_position_kernels(dtype)[0],
        gather,
        fill_room_kernel,
        note_pairs_kernel,
    ]


def must_compile_for_cpu(kernels: list[wp.Kernel]) -> bool:
    """Whether Warp's cache lacks one of them."""
    return must_compile(kernels, wp.get_device("cpu"))


def compile_for_cpu(kernels: list[wp.Kernel]) -> None:
    """Compiles kernels for the CPU on all its cores, or loads them from the cache. Nothing else is compiled meanwhile.

    Raises:
        KernelCacheError: if Warp's cache cannot be read or written.
    """
    load_for_cpu(kernels, num_threads())
