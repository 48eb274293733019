"""The gradients that density control notes, by one Warp kernel."""

import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import given_view, kinds_of, vector_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.launching import launch
from warp_kernels.training.density_notes import density_kernel


def note_gradients(
    gradient: Tensor,
    visible: Tensor,
    half_size: tuple[float, float],
    blocked: Tensor,
    norm_sums: Tensor,
    observations: Tensor,
) -> None:
    """Add a step's gradients to the sums, in place. Never waits for the device.

    Args:
        gradient: Of the means in the image [1 / px], shape [C, N, 2].
        visible: bool, shape [C, N]; whether a camera sees a Gaussian.
        half_size: Multiplied with the components of the gradient [px].
        blocked: float32 scalar; not 0: add nothing.
        norm_sums: float32 [N]; gets the norms where a camera sees a Gaussian.
        observations: float32 [N]; gets the number of those cameras.
    """
    scalar, count = kinds_of(gradient.dtype).scalar, len(norm_sums)
    with launches_on_torch_stream(gradient.device) as device:
        inputs = [
            visible.numel() // max(count, 1),
            *map(scalar, half_size),
            view(blocked, wp.float32),
            given_view(gradient, vector_of(2, gradient.dtype)),
            given_view(visible, wp.bool),
            view(norm_sums, wp.float32),
            view(observations, wp.float32),
        ]
        launch(density_kernel(scalar), count, inputs, device)
