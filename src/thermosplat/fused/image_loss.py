"""Image losses in Warp as a torch function: the fast path of losses/image_terms.py on CUDA."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.image_quality.ssim import C1, C2, EPSILON, SSIM_SIGMA
from thermosplat.torch_bridge.arrays import SCALARS, strided_view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.image_loss.image_loss import TERMS, image_loss_kernels
from warp_kernels.image_loss.image_loss_adjoint import image_loss_adjoint_kernel
from warp_kernels.image_loss.image_tiles import threads_of, tiles_of
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.launching import launch_again, launch_tiles


@dataclass(frozen=True, eq=False)
class ImageTerm:
    """One weighted image loss: some channels of an image against a target.

    Attributes:
        name: Of the loss.
        weight: Of the loss.
        image: [H, W, X], H and W > 5.
        target: Ground truth in [0, 1], [H, W, C].
        first: The channels from this one on, C of them, are compared.
        squared: k of |d| + k d² in place of |d|.
    """

    name: str
    weight: float
    image: Tensor
    target: Tensor
    first: int = 0
    squared: float = 0.0

    @property
    def render(self) -> Tensor:
        """The channels that are compared, [H, W, C]."""
        channels = self.target.shape[-1]
        return self.image if channels == self.image.shape[-1] else self.image[..., self.first : self.first + channels]


class ImageLosses(NamedTuple):
    """What ``warp_image_losses`` returns."""

    losses: tuple[Tensor, ...]
    """Weighted losses, scalars, one for each term."""
    smoothness: Tensor
    """Weighted |∂x| + |∂y|; 0 where no term is smoothed."""
    squared_errors: tuple[Tensor, ...]
    """Mean squared error of each term's image, clamped to [0, 1]; without weights and gradients."""


def warp_image_loss(render: Tensor, target: Tensor, ssim_lambda: float) -> Tensor:
    """(1 - λ_s) |render - target|_1 + λ_s (1 - SSIM), each the mean over pixels and channels (equation 9).

    The same number and gradient as ``ssim_map`` gives in ``losses.image_loss``, to rounding.

    Args:
        render: Rendered image, shape [H, W, C], H and W > 5; a view with strides is fine. Receives a gradient.
        target: Ground truth in [0, 1], shape [H, W, C].
        ssim_lambda: λ_s, the share of the SSIM term, 0 to 1.

    Returns:
        The loss, a scalar.
    """
    return warp_image_losses([ImageTerm("image", 1.0, render, target)], ssim_lambda).losses[0]


def warp_image_losses(
    terms: Sequence[ImageTerm], ssim_lambda: float, *, smoothed: int | None = None, smoothness: float = 0.0
) -> ImageLosses:
    """Image losses of several images of one size, by the same few kernels.

    Args:
        terms: At least one; the kernels compare ``TERMS`` of them in a launch. Their images receive gradients.
        ssim_lambda: λ_s, the share of the SSIM term, 0 to 1.
        smoothed: The term whose image's mean |∂x| + |∂y| is a loss too (``losses.smoothness``).
    """
    losses: list[Tensor] = []
    squared_errors: list[Tensor] = []
    smooth: Tensor | None = None
    for first in range(0, len(terms), TERMS):
        members = terms[first : first + TERMS]
        within = smoothed is not None and first <= smoothed < first + len(members)
        at = smoothed - first if smoothed is not None and within else None
        numbers = _Numbers(members, ssim_lambda, at, smoothness)
        results = _Results.of(_ImageLosses.apply(members, numbers, *(term.image for term in members)), len(members))
        losses += results.losses
        squared_errors += results.squared_errors
        if smooth is None or within:
            smooth = results.smoothness
    if smooth is None:
        raise ValueError("terms must hold at least one image loss, found none.")
    return ImageLosses(tuple(losses), smooth, tuple(squared_errors))


class _Numbers:
    """What the launches share: sizes, and settings as kernel arguments.

    Args:
        terms: At most ``TERMS``, of images of one size.
        ssim_share: λ_s; the rest is the absolute difference.
        smoothed: The term whose image's |∂x| + |∂y| is a loss too; None: of none.
        smoothness: Weight of that loss.
    """

    def __init__(self, terms: Sequence[ImageTerm], ssim_share: float, smoothed: int | None, smoothness: float) -> None:
        image = terms[0].image
        self.height, self.width, _ = image.shape
        self.dtype = SCALARS[image.dtype]
        channels = [term.target.shape[-1] for term in terms]
        ends = list(accumulate(channels))
        starts = [0, *ends]
        self.channels = ends[-1]
        self.tiles = tiles_of(self.height, self.width, self.dtype)
        self.ends = (ends + [self.channels] * TERMS)[: TERMS - 1]
        self.pixels = self.height * self.width
        self.shares = self._padded([term.weight / (self.pixels * of) for term, of in zip(terms, channels, strict=True)])
        smooth = [0, 0] if smoothed is None else [starts[smoothed], starts[smoothed + 1]]
        self.smooth_share = self.dtype(smoothness / (self.pixels * max(smooth[1] - smooth[0], 1)))
        self.settings = [self.dtype(ssim_share), *self._padded([term.squared for term in terms]), *smooth]

    def _padded(self, values: Sequence[float]) -> list[Any]:
        return [self.dtype(value) for value in [*values, *[0.0] * TERMS][:TERMS]]


class _Results(NamedTuple):
    """What the function of one launch returns side by side, or the gradients to it."""

    losses: tuple[Any, ...]
    smoothness: Any
    squared_errors: tuple[Any, ...]

    @classmethod
    def of(cls, tensors: Sequence[Any], count: int) -> "_Results":
        """From so many losses, the smoothness, and as many squared errors."""
        return cls(tuple(tensors[:count]), tensors[count], tuple(tensors[count + 1 :]))


class _Saved(NamedTuple):
    """What the adjoint reads."""

    images: tuple[Tensor, ...]
    targets: tuple[Tensor, ...]
    derivatives: Tensor

    @classmethod
    def of(cls, tensors: Sequence[Tensor], count: int) -> "_Saved":
        """From so many images, as many targets, and the derivatives."""
        return cls(tuple(tensors[:count]), tuple(tensors[count : 2 * count]), tensors[-1])


class _ImageLosses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, terms: Sequence[ImageTerm], n: _Numbers, *images: Tensor) -> tuple[Tensor, ...]:
        ctx.firsts, ctx.numbers = [term.first for term in terms], n
        targets = [term.target for term in terms]
        renders = _compared(images, targets, ctx.firsts)
        wanted = any(ctx.needs_input_grad)
        made = images[0].new_empty
        sums = made(3 * n.channels, n.tiles)
        derivatives = made(*((3 * n.channels, n.height, n.width) if wanted else (0, 0, 0)))
        losses, squared_errors = made(TERMS + 1), made(TERMS)
        of_tiles, of_terms = image_loss_kernels(n.dtype, SSIM_SIGMA, C1, C2, EPSILON)
        with launches_on_torch_stream(images[0].device) as device:
            given = [*_places(renders), *_places(targets), *n.ends, *n.settings]
            outputs = _arrays([sums, derivatives])
            launch_tiles(of_tiles, n.channels * n.tiles, threads_of(device), [*given, *outputs], device)
            totals = sums.sum(1)
            given = [n.channels, *n.ends, *n.shares, n.smooth_share, n.pixels]
            launch_again(of_terms, TERMS + 1, [*given, *_arrays([totals, losses, squared_errors])], device)
        ctx.save_for_backward(*images, *targets, derivatives)
        errors = squared_errors.unbind()[: len(terms)]
        ctx.mark_non_differentiable(*errors)
        ctx.set_materialize_grads(False)
        each = losses.unbind()
        return *each[: len(terms)], each[TERMS], *errors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        count = len(ctx.firsts)
        if all(gradient is None for gradient in gradients):
            return (None,) * (2 + count)
        images, targets, derivatives = _Saved.of(ctx.saved_tensors, count)
        v = _Results.of(gradients, count)
        v_losses = _side_by_side([*v.losses, *[v.smoothness] * (TERMS + 1 - count)])
        v_images = [
            torch.empty_like(image, memory_format=torch.contiguous_format)
            if image.shape[-1] == target.shape[-1]
            else torch.zeros_like(image, memory_format=torch.contiguous_format)
            for image, target in zip(images, targets, strict=True)
        ]
        n = ctx.numbers
        kernel = image_loss_adjoint_kernel(n.dtype, SSIM_SIGMA)
        with launches_on_torch_stream(derivatives.device) as device:
            renders, v_renders = (_places(_compared(one, targets, ctx.firsts)) for one in (images, v_images))
            inputs = [*renders, *_places(targets), *n.ends, *n.settings, *n.shares, n.smooth_share]
            inputs += [*_arrays([derivatives, v_losses]), *v_renders]
            launch_tiles(kernel, n.channels * n.tiles, threads_of(device), inputs, device)
        return None, None, *v_images


def _side_by_side(gradients: Sequence[Tensor | None]) -> Tensor:
    """Gradients of scalars, of which at least one is there, as one tensor."""
    if any(gradient is None for gradient in gradients):
        zero = torch.zeros_like(next(gradient for gradient in gradients if gradient is not None))
        gradients = [zero if gradient is None else gradient for gradient in gradients]
    return torch.stack([gradient for gradient in gradients if gradient is not None])


def _compared(images: Sequence[Tensor], targets: Sequence[Tensor], firsts: Sequence[int]) -> list[Tensor]:
    """The channels of images that are compared with the targets."""
    return [
        image[..., first : first + target.shape[-1]]
        for image, target, first in zip(images, targets, firsts, strict=True)
    ]


def _places(images: Sequence[Tensor]) -> list[ArrayView]:
    """Images for the kernels' places; those that are not used repeat the first."""
    return _arrays([*images, *[images[0]] * TERMS][:TERMS])


def _arrays(tensors: Sequence[Tensor]) -> list[ArrayView]:
    return [strided_view(tensor) for tensor in tensors]
