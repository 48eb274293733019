"""Sums of many records per image in float64: strands first, then their total; the same on every run."""

import math

import warp as wp

from warp_kernels.machinery.array_views import empty
from warp_kernels.machinery.lane_sums import lane_sum_function
from warp_kernels.machinery.lanes import lanes_of
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.loading import made_once

STRANDS = 256
"""Partial sums per image on the CPU."""


@made_once
def strand_sum_kernel(dtype: type, length: int) -> wp.Kernel:
    """Partial sums of an image's records, one warp an (image, strand) pair; on the CPU a warp is one thread.

    A lane sums every (strands · lanes)-th record.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the records.
    """
    record = wp.types.vector(length, dtype)
    record64 = wp.types.vector(length, wp.float64)
    store_lane_sum = lane_sum_function(length)

    @wp.kernel(name=f"strand_sums_{length}_{dtype.__name__}", enable_backward=False, module="unique")
    def strand_sums_kernel(
        num_records: int,
        strands: int,
        lanes: int,
        records: wp.array(dtype=record),  # [images · records]
        # outputs
        partial_sums: wp.array(dtype=record64),  # [images · strands]
    ):
        row = wp.tid() // lanes
        lane = wp.tid() % lanes
        image = row // strands
        total = record64()
        for n in range((row % strands) * lanes + lane, num_records, strands * lanes):
            total += record64(records[image * num_records + n])
        store_lane_sum(partial_sums, row, lane, total)

    return strand_sums_kernel


def image_sums(records: wp.array, images: int) -> wp.array:
    """Sums of each image's records, by two launches.

    On CUDA there are about as many strands as the root of the number of records, so that neither launch has threads
    with much to do.

    Args:
        records: vec [images · records].

    Returns:
        float64 vec [images].
    """
    count = len(records) // max(images, 1)
    strands = math.isqrt(count) + 1 if records.device.is_cuda else STRANDS
    return _launched(_launched(records, images, count, strands), images, strands, 1)


def _launched(records: wp.array, images: int, count: int, strands: int) -> wp.array:
    """float64 vec [images · strands] of records [images · count]."""
    length, dtype, device = records.dtype._length_, records.dtype._wp_scalar_type_, records.device
    lanes = lanes_of(device)
    sums = empty(images * strands, wp.types.vector(length, wp.float64), device)
    launch_again(
        strand_sum_kernel(dtype, length),
        images * strands * lanes,
        [count, strands, lanes, records, sums],
        device,
    )
    return sums
