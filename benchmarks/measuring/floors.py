"""How fast a stage could be at best: the bytes it must move and the operations it must do, over the measured peaks.

What is counted, in float32, N Gaussians of which V are in some tile's list, P pairs, W·H pixels, C channels in all:

- Bytes: every array that a stage has to read or write, once. Gaussians out of view cost their mean and a byte, and a
  gradient of zero. A sort of 32-bit keys with 32-bit values by radix passes over both every 8 bits: 16 bytes a pass, of
  V depths (4 passes) and of P tile numbers (as many passes as they have bytes).
- Operations: fused multiply-adds or what takes a slot as long, a fragment (a drawn pair of pixel and Gaussian). Pairs
  that turn out not to be drawn, reductions over a warp and atomics are left out: a better kernel avoids them.

Forward, a fragment: offset 2, whitening 3, exponent 2, exponential 2, alpha 2, transmittance 1, test 1, weight 1, and 1
a channel; a second opacity adds alpha, transmittance, test and weight: 5.
Backward: offset to alpha as above 11, 1 / (1 - alpha) 2, transmittance 2, weight 1, gradient of alpha 2, colour behind
1, exponent's gradient 1, opacity 1, mean 4, conic 3, and 2 a channel; a second opacity adds 12.
"""

import math
from typing import Any

from measuring.device_peaks import DevicePeaks
from measuring.fragments import Fragments

FORWARD_OPERATIONS, FORWARD_PER_CHANNEL, FORWARD_SECOND_OPACITY = 14, 1, 5
BACKWARD_OPERATIONS, BACKWARD_PER_CHANNEL, BACKWARD_SECOND_OPACITY = 28, 2, 12

MEAN, QUAT, SCALES, OPACITY, SH = 12, 16, 12, 4, 192
MEAN2D, DEPTH, ROOT, COMPENSATION, VISIBLE, EXTENTS = 8, 4, 12, 4, 1, 8
"""Bytes a Gaussian."""


def stage_floors(
    fragments: Fragments,
    gaussians: int,
    pairs: int,
    size: tuple[int, int],
    tiles: int,
    channels: tuple[int, int],
    peaks: DevicePeaks,
) -> dict[str, dict[str, Any]]:
    """The floor of each stage.

    Args:
        fragments: counted.
        gaussians: N.
        pairs: P.
        size: width and height of the image [px].
        tiles: tiles in the image.
        channels: channels blended at the first opacity, and at the second (0 with one opacity).
        peaks: measured.

    Returns:
        For each stage ``bytes``, ``operations``, ``floor_ms``, the longer of the two times they take at the peaks, and
        ``bound``, which of the two that is.
    """
    width, height = size
    first, second = channels
    opacities = OPACITY * (2 if second else 1)
    visible, pixels = fragments.visible, width * height
    culled = gaussians - visible
    projected = MEAN2D + DEPTH + ROOT + COMPENSATION + VISIBLE + EXTENTS
    record = MEAN2D + ROOT + opacities + 4 * first
    passes = math.ceil(max(1, tiles.bit_length()) / 8)
    outputs = (4 * (first + second) + 8 * (2 if second else 1)) * pixels  # colours, transmittances, last pairs
    geometry = MEAN + QUAT + SCALES
    dual = bool(second)
    per_channel = fragments.drawn * first + fragments.thermal * second
    amounts = {
        "projection": (culled * (MEAN + VISIBLE) + visible * (geometry + opacities + projected), 0),
        "colors": (visible * (MEAN + SH + 12), 0),
        "binning": (
            visible * (MEAN2D + DEPTH + ROOT + VISIBLE + EXTENTS + opacities + 4 * 16)
            + pairs * (8 + 16 * passes + 4)
            + 4 * tiles,
            0,
        ),
        "blending": (
            4 * pairs + visible * record + outputs,
            fragments.either * FORWARD_OPERATIONS
            + (fragments.thermal * FORWARD_SECOND_OPACITY if dual else 0)
            + per_channel * FORWARD_PER_CHANNEL,
        ),
        "blending adjoint": (
            # the gradient to the images, and what of the images is read again; each Gaussian's gradient once
            4 * pairs + visible * 2 * record + outputs + 4 * pixels * (2 if dual else 1),
            fragments.either * BACKWARD_OPERATIONS
            + (fragments.thermal * BACKWARD_SECOND_OPACITY if dual else 0)
            + per_channel * BACKWARD_PER_CHANNEL,
        ),
        "colors adjoint": (culled * SH + visible * (12 + MEAN + SH + SH), 0),
        "projection adjoint": (
            culled * geometry + visible * (2 * geometry + ROOT + COMPENSATION + MEAN2D + DEPTH + ROOT + COMPENSATION),
            0,
        ),
    }
    return {
        stage: {
            "bytes": moved,
            "operations": done,
            "floor_ms": 1e3 * max(moved / peaks.bytes_per_s, done / peaks.fma_per_s),
            "bound": "bytes" if moved / peaks.bytes_per_s > done / peaks.fma_per_s else "operations",
        }
        for stage, (moved, done) in amounts.items()
    }
