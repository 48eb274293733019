"""The step that compares an image with its ground truth: its launches, forward and adjoint."""

from dataclasses import dataclass

import warp as wp

from warp_kernels.image_loss import STRIP, image_loss_kernels
from warp_kernels.launching import launch


@dataclass(frozen=True)
class ImageLossSettings:
    """What the loss is made of.

    Attributes:
        ssim_share: λ, share of 1 - SSIM; the rest is the absolute difference.
        sigma: standard deviation of SSIM's window of 11 taps [px].
        c1: SSIM's first constant.
        c2: SSIM's second constant.
        epsilon: added to SSIM's denominator.
    """

    ssim_share: float
    sigma: float
    c1: float
    c2: float
    epsilon: float

    def kernels(self, dtype: type) -> tuple[wp.Kernel, ...]:
        """The kernels, for ``wp.float32`` or ``wp.float64``."""
        return image_loss_kernels(dtype, self.sigma, self.c1, self.c2, self.epsilon)


def image_loss(
    render: wp.array, target: wp.array, settings: ImageLossSettings, losses: wp.array, derivatives: wp.array
) -> None:
    """The loss of every pixel and channel.

    Args:
        render: [H, W, C], any strides; H and W above 5.
        target: [H, W, C].
        settings: what the loss is made of.
        losses: [C, H, W], output.
        derivatives: [3 C, H, W], output for ``image_loss_adjoint``; [0, 0, 0] where it is not wanted.
    """
    height, width, channels = render.shape
    dtype, device = render.dtype, render.device
    blur_rows, finish_columns, _, _ = settings.kernels(dtype)
    moments = wp.empty((5 * channels, height, width), dtype=dtype, device=device)
    launch(blur_rows, channels * height * -(-width // STRIP), [render, target, moments], device)
    launch(
        finish_columns,
        channels * width * -(-height // STRIP),
        [dtype(settings.ssim_share), render, target, moments, losses, derivatives],
        device,
    )


def image_loss_adjoint(
    render: wp.array,
    target: wp.array,
    settings: ImageLossSettings,
    derivatives: wp.array,
    v_mean: wp.array,
    v_render: wp.array,
) -> None:
    """The gradient by the render of the mean of the losses.

    Args:
        render: as in ``image_loss``.
        target: as in ``image_loss``.
        settings: as in ``image_loss``.
        derivatives: what ``image_loss`` wrote.
        v_mean: [1] gradient of the mean.
        v_render: [H, W, C], output, written and not added to.
    """
    height, width, channels = render.shape
    dtype, device = render.dtype, render.device
    _, _, blur_columns_adjoint, finish_rows_adjoint = settings.kernels(dtype)
    blurred = wp.empty_like(derivatives)
    launch(blur_columns_adjoint, 3 * channels * width * -(-height // STRIP), [derivatives, blurred], device)
    launch(
        finish_rows_adjoint,
        channels * height * -(-width // STRIP),
        [dtype(settings.ssim_share), render, target, blurred, v_mean, v_render],
        device,
    )
