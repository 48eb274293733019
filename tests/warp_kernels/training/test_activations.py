"""Activations and their adjoint: numpy's formulas, and nothing written beyond the last Gaussian."""

from typing import Literal

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.machinery.lanes import whole_warps
from warp_kernels.machinery.launching import launch
from warp_kernels.training.activations import activation_kernels

Second = Literal["offsets", "own", "none"]

ROOM = 40
"""Gaussians behind the last one, more than a warp: none of them is to be written."""


class Numbers:
    """Random numbers for N Gaussians, and room for results.

    Args:
        count: N.
        dtype: Of the numbers.
        device: Where.
    """

    def __init__(self, count: int, dtype: type, device: torch.device) -> None:
        self.count, self.dtype, self.device = count, dtype, wp.get_device(str(device))
        self.random = np.random.default_rng(count)

    def array(self, values: np.ndarray) -> wp.array:
        """One or three numbers a Gaussian, on the device."""
        kind = self.dtype if values.ndim == 1 else wp.types.vector(3, self.dtype)
        return wp.array(values, dtype=kind, device=self.device)

    def drawn(self, *shape: int) -> np.ndarray:
        """Numbers that the type holds exactly."""
        return self.random.normal(size=shape).astype(np.float32).astype(np.float64)

    def room(self, *width: int, count: int | None = None) -> wp.array:
        """NaN for all of ``count`` Gaussians, by default N, and for those behind the last."""
        count = self.count if count is None else count
        return self.array(np.full((count + ROOM, *width), np.nan))[:count]

    def check(self, written: wp.array, expected: np.ndarray) -> None:
        """Compares to a few units in the last place of the inputs, and looks whether the room behind is as it was."""
        tolerance = 2e-15 if self.dtype is wp.float64 else 1e-6
        np.testing.assert_allclose(written.numpy(), expected, rtol=tolerance, atol=tolerance)
        whole = wp.array(
            ptr=written.ptr, dtype=written.dtype, shape=len(expected) + ROOM, device=self.device, copy=False
        )
        assert np.isnan(whole.numpy()[len(expected) :]).all()


def activate(*inputs: object, adjoint: bool = False) -> None:
    logits = inputs[1]
    kernel = activation_kernels(logits.dtype)[adjoint]
    launch(kernel, whole_warps(len(logits), logits.device), list(inputs), logits.device)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("second", ["offsets", "own", "none"])
@pytest.mark.parametrize("count", [1, 32, 77, 5000])
def test_same_as_numpy(device: torch.device, count: int, second: Second, dtype: type) -> None:
    """One Gaussian, whole warps and not, more than one CPU thread takes; the adjoint is that of what was written."""
    numbers = Numbers(count, dtype, device)
    log_scales, logits = numbers.drawn(count, 3), numbers.drawn(count)
    seconds = numbers.drawn(0 if second == "none" else count)
    stored = [numbers.array(values) for values in (log_scales, logits, seconds)]
    made = [numbers.room(3), numbers.room(), numbers.room(count=len(seconds))]
    activate(*stored, second == "offsets", *made)
    scales, opacities = np.exp(log_scales), sigmoid(logits)
    thermal_opacities = sigmoid(seconds + (logits if second == "offsets" else 0.0))
    for written, expected in zip(made, (scales, opacities, thermal_opacities), strict=True):
        numbers.check(written, expected)

    v_scales, v_opacities, v_thermal = numbers.drawn(count, 3), numbers.drawn(count), numbers.drawn(len(seconds))
    given = [numbers.array(values) for values in (v_scales, v_opacities, v_thermal)]
    gradients = [numbers.room(3), numbers.room(), numbers.room(count=len(seconds))]
    activate(*made, *given, second == "offsets", *gradients, adjoint=True)
    v_seconds = v_thermal * thermal_opacities * (1.0 - thermal_opacities)
    v_logits = v_opacities * opacities * (1.0 - opacities) + (v_seconds if second == "offsets" else 0.0)
    for written, expected in zip(gradients, (v_scales * scales, v_logits, v_seconds), strict=True):
        numbers.check(written, expected)


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_a_gradient_that_is_not_given_is_zero(device: torch.device, missing: int) -> None:
    """Of scales, of α and of α_t; what it would have gone to is written all the same."""
    count = 45
    numbers = Numbers(count, wp.float64, device)
    made = [np.exp(numbers.drawn(count, 3)), sigmoid(numbers.drawn(count)), sigmoid(numbers.drawn(count))]
    given = [numbers.drawn(count, 3), numbers.drawn(count), numbers.drawn(count)]
    arrays = [numbers.array(values) for values in given]
    arrays[missing] = arrays[missing][:0]
    given[missing] = np.zeros_like(given[missing])
    gradients = [numbers.room(3), numbers.room(), numbers.room()]
    activate(*map(numbers.array, made), *arrays, True, *gradients, adjoint=True)
    v_log_scales = given[0] * made[0]
    v_opacities, v_seconds = (v * y * (1.0 - y) for v, y in zip(given[1:], made[1:], strict=True))
    for written, expected in zip(gradients, (v_log_scales, v_opacities + v_seconds, v_seconds), strict=True):
        numbers.check(written, expected)
