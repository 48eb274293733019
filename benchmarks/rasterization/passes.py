"""The two calls of a renderer that bench_rasterization.py checks and times."""

from collections.abc import Callable

import torch
from torch import Tensor

from measuring.gpu_memory import peak_memory
from peers.peer import Rendered, Tensors

Result = tuple[list[Tensor], tuple[Tensor, ...]]


class Passes:
    """The forward pass without gradients, and forward plus backward with random gradients of every image.

    Args:
        render: renders the case.
        inputs: what it renders; gradients go to those that require them.
        num_images: only so many images are looked at, the first of them; None: all.

    Attributes:
        render: as given.
        intersections: (Gaussian, tile) pairs of all its rasterizations together.
    """

    def __init__(self, render: Callable[[], Rendered], inputs: Tensors, num_images: int | None = None) -> None:
        def seen() -> Rendered:
            rendered = render()
            return rendered._replace(images=rendered.images[:num_images])

        self.render = render if num_images is None else seen
        self._leaves = [tensor for tensor in inputs.values() if tensor.requires_grad]
        first = self.forward()
        self.intersections = first.intersections
        device = inputs["means"].device
        generator = torch.Generator(device).manual_seed(0)
        # float32 numbers whatever the images are, in the images' memory order, which need not be that of their shape.
        self._upstream = [
            torch.empty_like(image).copy_(torch.randn(image.shape, generator=generator, device=device))
            for image in first.images
        ]

    def forward(self) -> Rendered:
        """Renders without gradients."""
        with torch.no_grad():
            return self.render()

    def forward_backward(self) -> Result:
        """The images and the gradient of every leaf."""
        images = self.render().images
        gradients = torch.autograd.grad(images, self._leaves, self._upstream)
        # Whoever keeps the images must not keep the autograd graph, whose nodes belong to the stream it was made on.
        return [image.detach() for image in images], gradients

    def peak_memory(self, device: torch.device) -> float | None:
        """GPU memory that ``forward_backward`` needs beyond what is held before it [MiB]; None on the CPU."""
        return peak_memory(self.forward_backward, device)
