"""One variant of the blending: how many channels, at how many opacities, in which precision, on which deal of pixels.

Its kernels have what is here in common. The forward pass (``blending``), the light that segments of long lists let
through (``segment_light``), the joining of segments (``list_segments``) and the adjoint (``blending_adjoint``) take
their types, functions and names from one ``BlendVariant``.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import warp as wp

from warp_kernels.blending.alpha import AlphaFunctions, alpha_functions
from warp_kernels.blending.blend_arguments import BlockFunctions, block_functions, pixel_ends_type, splats_type
from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.blending.survivors import WalkFunctions, stages_features, walk_functions
from warp_kernels.machinery.loading import made_once


class BlendTypes(NamedTuple):
    """Types of a variant's arrays and of what a lane keeps.

    Attributes:
        vec2: a position.
        vec3: a conic's root.
        vec4: a packed root.
        vecC: all channels.
        vecD: channels blended with the second opacity; one number where there is no second opacity.
        vecA: channels of the first array of features.
        vecB: channels of the other array; one number where there is no other.
        vecQ: a number for each pixel of a lane's row.
        vecP: a number for each pixel of a lane.
        vecPi: a whole number for each pixel of a lane.
        matCP: all channels for each pixel of a lane.
        matDP: channels of the second opacity for each pixel of a lane.
        Splats: projected Gaussians; see blend_arguments.
        PixelEnds: where pixels' walks ended; likewise.
    """

    vec2: Any
    vec3: Any
    vec4: Any
    vecC: Any
    vecD: Any
    vecA: Any
    vecB: Any
    vecQ: Any
    vecP: Any
    vecPi: Any
    matCP: Any
    matDP: Any
    Splats: Any
    PixelEnds: Any


@dataclass(frozen=True, eq=False)
class BlendVariant:
    """A variant; ``blend_variant`` makes it. Two with the same fields are the same object, which makes them quick keys.

    Attributes:
        channels: C, channels blended with the first opacity.
        thermal_channels: D <= C; the last D channels are blended with the second opacity too. 0: one opacity.
        dtype: ``wp.float32`` or ``wp.float64``.
        layout: deal of pixels to lanes.
        first_channels: A, of the C those that lie in an array of their own, in front of the others; C: all.
    """

    channels: int
    thermal_channels: int
    dtype: type
    layout: BlendLayout
    first_channels: int

    @cached_property
    def dual(self) -> bool:
        """Whether there are two opacities."""
        return self.thermal_channels > 0

    @property
    def cuda(self) -> bool:
        """Whether lanes of a warp share the work."""
        return self.layout.lanes > 1

    @property
    def pixels(self) -> int:
        """Pixels of a lane."""
        return self.layout.rows * self.layout.columns

    @property
    def first_thermal(self) -> int:
        """The first channel that is blended with the second opacity; without one, the last channel."""
        return self.channels - max(self.thermal_channels, 1)

    @property
    def first_behind(self) -> int:
        """Where in a pixel's state at a boundary of segments the colours begin; see ``state_length``."""
        return 2 if self.dual else 1

    @property
    def first_behind_thermal(self) -> int:
        """Where in such a state the colours of the second opacity begin."""
        return self.first_behind + self.channels

    @cached_property
    def state_length(self) -> int:
        """Numbers in a pixel's state at a boundary of segments: T, [thermal T], colours behind (C), [thermal ones (D)].

        Until the segments are joined, T is what the segment before the boundary lets through, and the colours are those
        of the segment behind it alone.
        """
        return self.channels + 1 + (self.thermal_channels + 1 if self.dual else 0)

    @property
    def stages_features(self) -> bool:
        """Whether there is room for the features in the records of shared memory."""
        return stages_features(self.channels, self.dtype, self.layout)

    @cached_property
    def types(self) -> BlendTypes:
        """Types of arrays, and of what a lane keeps."""
        C, D, A, dtype = self.channels, max(self.thermal_channels, 1), self.first_channels, self.dtype
        vector, matrix, pixels = wp.types.vector, wp.types.matrix, self.pixels
        return BlendTypes(
            vec2=vector(2, dtype),
            vec3=vector(3, dtype),
            vec4=vector(4, dtype),
            vecC=vector(C, dtype),
            vecD=vector(D, dtype),
            vecA=vector(A, dtype),
            vecB=vector(max(C - A, 1), dtype),
            vecQ=vector(self.layout.columns, dtype),
            vecP=vector(pixels, dtype),
            vecPi=vector(pixels, wp.int32),
            matCP=matrix((C, pixels), dtype),
            matDP=matrix((D, pixels), dtype),
            Splats=splats_type(A, max(C - A, 1), dtype),
            PixelEnds=pixel_ends_type(dtype),
        )

    @cached_property
    def response(self) -> AlphaFunctions:
        """What a Gaussian does to a pixel."""
        return alpha_functions(self.dtype)

    @cached_property
    def blocks(self) -> BlockFunctions:
        """Which pixels a warp has."""
        return block_functions(self.dtype, self.layout)

    def walk(self, *, staged: bool, backwards: bool = False) -> WalkFunctions:
        """Functions of a warp's walk along a list.

        Args:
            staged: records of Gaussians hold features.
            backwards: from the back of the list to its front.
        """
        return walk_functions(self.channels, self.first_channels, staged, self.dual, self.dtype, self.layout, backwards)

    def name(self, kernel: str, *, of_arrays: bool = True) -> str:
        """Name of one of the kernels.

        Args:
            of_arrays: it depends on how features lie in arrays.
        """
        apart = f"_{self.first_channels}" if of_arrays and self.first_channels < self.channels else ""
        return f"{kernel}_{self.channels}_{self.thermal_channels}_{self.dtype.__name__}_{self.layout.tag}{apart}"


@made_once
def blend_variant(
    channels: int, thermal_channels: int, dtype: type, layout: BlendLayout, first_channels: int | None = None
) -> BlendVariant:
    """A variant, the same object for the same arguments. The other arguments are those of ``BlendVariant``.

    Args:
        first_channels: as in ``BlendVariant``; None: all.
    """
    first = channels if first_channels is None else first_channels
    return BlendVariant(channels, thermal_channels, dtype, layout, first)
