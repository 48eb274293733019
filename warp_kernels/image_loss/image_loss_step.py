"""The step that compares images with their ground truth: its launches, forward and adjoint."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import warp as wp

from warp_kernels.image_loss.image_loss import TERMS, image_loss_kernels
from warp_kernels.image_loss.image_loss_adjoint import image_loss_adjoint_kernel
from warp_kernels.image_loss.image_tiles import threads_of, tiles_of
from warp_kernels.machinery.launching import launch_again, launch_tiles


@dataclass(frozen=True)
class ImageLossSettings:
    """What the losses are made of.

    Attributes:
        ssim_share: λ, share of 1 - SSIM; the rest is the absolute difference.
        sigma: standard deviation of SSIM's window of 11 taps [px].
        c1: SSIM's first constant.
        c2: SSIM's second constant.
        epsilon: added to SSIM's denominator.
        weights: of each pair's loss; at most TERMS pairs.
        squared: k of each pair, |d| + k d² in place of |d|.
        smoothed: the pair whose image's |∂x| + |∂y| is a loss too; None: of none.
        smoothness: weight of that loss.
    """

    ssim_share: float
    sigma: float
    c1: float
    c2: float
    epsilon: float
    weights: tuple[float, ...] = (1.0,)
    squared: tuple[float, ...] = (0.0,)
    smoothed: int | None = None
    smoothness: float = 0.0

    def kernels(self, dtype: type) -> tuple[wp.Kernel, ...]:
        """The kernels of the losses, for ``wp.float32`` or ``wp.float64``."""
        return image_loss_kernels(dtype, self.sigma, self.c1, self.c2, self.epsilon)


class _Numbers:
    """What the launches share: sizes, and settings as kernel arguments."""

    def __init__(self, renders: Sequence[wp.array], settings: ImageLossSettings) -> None:
        if not 1 <= len(renders) <= TERMS:
            raise ValueError(f"renders must be 1 to {TERMS} images a launch, found {len(renders)}.")
        self.height, self.width, _ = renders[0].shape
        self.dtype, self.device = renders[0].dtype, renders[0].device
        ends = list(accumulate(render.shape[2] for render in renders))
        starts = [0, *ends]
        self.channels = ends[-1]
        self.blocks = self.channels * tiles_of(self.height, self.width, self.dtype)
        self.ends = (ends + [self.channels] * TERMS)[: TERMS - 1]
        pixels = self.height * self.width
        shares = [weight / (pixels * render.shape[2]) for weight, render in zip(settings.weights, renders, strict=True)]
        self.shares = self._padded(shares)
        smoothed = settings.smoothed
        self.smooth = [0, 0] if smoothed is None else [starts[smoothed], starts[smoothed + 1]]
        count = pixels * max(self.smooth[1] - self.smooth[0], 1)
        self.smooth_share = self.dtype(settings.smoothness / count)
        self.terms = [self.dtype(settings.ssim_share), *self._padded(settings.squared), *self.smooth]

    def _padded(self, values: Sequence[float]) -> list[Any]:
        return [self.dtype(value) for value in [*values, *[0.0] * TERMS][:TERMS]]


def _filled(images: Sequence[wp.array]) -> list[wp.array]:
    """Images for the kernels' places; those that are not used repeat the first."""
    return [*images, *[images[0]] * TERMS][:TERMS]


def image_losses(
    renders: Sequence[wp.array],
    targets: Sequence[wp.array],
    settings: ImageLossSettings,
    sums: wp.array,
    derivatives: wp.array,
) -> None:
    """Losses, squared errors and |∂x| + |∂y| of every channel, summed over tiles.

    Args:
        renders: 1 to TERMS images [H, W, Ct] of one size, any strides; H and W above 5.
        targets: [H, W, Ct] each.
        sums: [3 C, tiles_of(H, W)], output: losses without weights, squared errors, absolute differences.
        derivatives: [3 C, H, W], output for ``image_losses_adjoint``; [0, 0, 0] where it is not wanted.
    """
    n = _Numbers(renders, settings)
    tiles, _ = settings.kernels(n.dtype)
    arguments = [*_filled(renders), *_filled(targets), *n.ends, *n.terms, sums, derivatives]
    launch_tiles(tiles, n.blocks, threads_of(n.device), arguments, n.device)


def image_loss_totals(
    renders: Sequence[wp.array],
    settings: ImageLossSettings,
    sums: wp.array,
    losses: wp.array,
    squared_errors: wp.array,
) -> None:
    """The weighted mean losses of all pairs. The other arguments are those of ``image_losses``.

    Args:
        sums: [3 C], sums over tiles of what ``image_losses`` wrote.
        losses: [TERMS + 1], output: each pair's, and in the last place that of |∂x| + |∂y|.
        squared_errors: [TERMS], output: mean squared errors of the images clamped to [0, 1], without weights.
    """
    n = _Numbers(renders, settings)
    arguments = [n.channels, *n.ends, *n.shares, n.smooth_share, n.height * n.width, sums, losses, squared_errors]
    launch_again(settings.kernels(n.dtype)[1], TERMS + 1, arguments, n.device)


def image_losses_adjoint(
    renders: Sequence[wp.array],
    targets: Sequence[wp.array],
    settings: ImageLossSettings,
    derivatives: wp.array,
    v_losses: wp.array,
    v_renders: Sequence[wp.array],
) -> None:
    """The gradients by the renders. The other arguments are those of ``image_losses``.

    Args:
        derivatives: what ``image_losses`` wrote.
        v_losses: [TERMS + 1] gradients of the losses.
        v_renders: [H, W, Ct] each, any strides, output, written and not added to.
    """
    n = _Numbers(renders, settings)
    arguments = [*_filled(renders), *_filled(targets), *n.ends, *n.terms, *n.shares, n.smooth_share]
    arguments += [derivatives, v_losses, *_filled(v_renders)]
    kernel = image_loss_adjoint_kernel(n.dtype, settings.sigma)
    launch_tiles(kernel, n.blocks, threads_of(n.device), arguments, n.device)
