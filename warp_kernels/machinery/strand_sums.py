"""Sums of many records per image in float64: strands first, then their total; the same on every run."""

import warp as wp

from warp_kernels.machinery.array_views import empty
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.loading import made_once

STRANDS = 256
"""Partial sums per image."""


@made_once
def strand_sum_kernel(dtype: type, length: int) -> wp.Kernel:
    """Partial sums of every STRANDS-th record of an image, one thread an (image, strand) pair.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the records.
        length: numbers in a record.

    Returns:
        The Warp kernel.
    """
    record = wp.types.vector(length, dtype)
    record64 = wp.types.vector(length, wp.float64)

    @wp.kernel(name=f"strand_sums_{length}_{dtype.__name__}", enable_backward=False, module="unique")
    def strand_sums_kernel(
        num_gaussians: int,
        records: wp.array(dtype=record),  # [images · N]
        # outputs
        partial_sums: wp.array(dtype=record64),  # [images · STRANDS]
    ):
        tid = wp.tid()
        image = tid // wp.static(STRANDS)
        total = record64()
        for n in range(tid % wp.static(STRANDS), num_gaussians, wp.static(STRANDS)):
            r = records[image * num_gaussians + n]
            for k in range(wp.static(length)):
                total[k] += wp.float64(r[k])
        partial_sums[tid] = total

    return strand_sums_kernel


def strand_sums(records: wp.array, images: int) -> wp.array:
    """Launches the kernel.

    Args:
        records: vec [images · N].
        images: number of images.

    Returns:
        float64 vec [images · STRANDS]; an image's strands lie side by side.
    """
    length, dtype = records.dtype._length_, records.dtype._wp_scalar_type_
    sums = empty(images * STRANDS, wp.types.vector(length, wp.float64), records.device)
    launch_again(
        strand_sum_kernel(dtype, length),
        images * STRANDS,
        [len(records) // max(images, 1), records, sums],
        records.device,
    )
    return sums
