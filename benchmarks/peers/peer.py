"""What a renderer under comparison is, what it is given, and what it returns."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from torch import Tensor

from measuring.agreement import SAME_CONVENTIONS, Tolerance

NEAR_PLANE = 0.01
"""gsplat's and thermosplat's default [world units]."""

CASES = ("rgb", "features8", "features11", "features32", "rgbt")
"""rgb: SH colour of degree 3. featuresN: N channels. rgbt: SH colour and 8 features at α, the 8 features at α_t."""

Tensors = dict[str, Tensor]


class Rendered(NamedTuple):
    """What a renderer made of a case.

    Attributes:
        images: [1, H, W, X] colours and alphas, the same for every renderer of a case.
        infos: one dictionary of gsplat's kind per rasterization; none where the renderer has no such thing.
    """

    images: list[Tensor]
    infos: list[Mapping[str, Any]]

    @property
    def intersections(self) -> int | None:
        """(Gaussian, tile) pairs of all rasterizations together."""
        return sum(len(info["flatten_ids"]) for info in self.infos) if self.infos else None


Renderer = Callable[[str, Tensors, int, int], Callable[[], Rendered]]


class RawParameters(NamedTuple):
    """What a renderer is given that activates its parameters itself.

    Attributes:
        leaves: the case's tensors before their activations, as leaves, and its camera.
        gradients: (the case's tensors, gradients to those leaves) -> gradients to the case's tensors.
    """

    leaves: Callable[[Tensors], Tensors]
    gradients: Callable[[Tensors, tuple[Tensor, ...]], tuple[Tensor, ...]]


@dataclass(frozen=True)
class Peer:
    """A renderer by name.

    Attributes:
        name: as printed.
        description: version and kind.
        renderer: (case, tensors, width, height) -> a call that renders.
        cases: those it can render.
        near_plane: Gaussians nearer than this are not drawn [world units].
        tolerance: how far its images and gradients may be from thermosplat's.
        release: gives back memory that it keeps between calls.
        captured: what is captured in CUDA graphs that are replayed: nothing, each of the two calls of a case
            ("call"), or, by ``torch.cuda.make_graphed_callables``, a function's forward and backward pass ("function").
        raw: how it is given parameters that it activates itself; None: it takes them as they are.
        num_images: so many of a case's images it renders, the first of them; None: all.
    """

    name: str
    description: str
    renderer: Renderer
    cases: tuple[str, ...] = CASES
    near_plane: float = NEAR_PLANE
    tolerance: Tolerance = SAME_CONVENTIONS
    release: Callable[[], object] = lambda: None
    captured: Literal["call", "function"] | None = None
    raw: RawParameters | None = None
    num_images: int | None = None
