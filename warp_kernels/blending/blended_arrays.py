"""What the blending writes: images, and how its lists were walked."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import warp as wp

from warp_kernels.blending.blend_variant import BlendVariant
from warp_kernels.machinery.array_views import ArrayView


@dataclass
class BlendedArrays:
    """Images the blending writes; rows are image · height + y.

    Attributes:
        render: vecC [images · height, width].
        transmittance: [images · height, width]; 1 - alpha. The adjoint reads it where there are no alphas.
        ends: int32 [images · height, width]; last sorted pair drawn, and what rounding took from alpha; see pixel_ends.
        alphas: [images · height, width]; None: not wanted.
        thermal_render: vecD [images · height, width]; None with one opacity.
        thermal_transmittance: as ``transmittance``, of the second opacity.
        thermal_ends: as ``ends``, of the second opacity.
        thermal_alphas: as ``alphas``, of the second opacity.
    """

    render: wp.array
    transmittance: wp.array
    ends: wp.array
    alphas: wp.array | None = None
    thermal_render: wp.array | None = None
    thermal_transmittance: wp.array | None = None
    thermal_ends: wp.array | None = None
    thermal_alphas: wp.array | None = None


@dataclass(frozen=True)
class BlendWalk:
    """How lists were walked, as their adjoint walks them back.

    Attributes:
        variant: of the kernels.
        cuts: which lists are cut, and whose rows in ``states`` are; see list_segments. None where none may be.
        states: [rows, state_length, pixels of a tile] what each segment of a cut list left; None likewise.
        rows: of ``states``.
    """

    variant: BlendVariant
    cuts: wp.array | None
    states: wp.array | None
    rows: int = 0


class BlendLauncher(Protocol):
    """Makes the launches that write images, or read their gradients, or keeps them to be made with other images."""

    def forward(self, launch: Callable[[], None], blended: BlendedArrays) -> None:
        """What ``launch`` does writes ``blended``."""

    def backward(self, launch: Callable[[], None], v_images: tuple[ArrayView | None, ...]) -> None:
        """What ``launch`` does reads gradients.

        They are those of the render's first channels, of its others, of the thermal render, and of both transmittances.
        """
