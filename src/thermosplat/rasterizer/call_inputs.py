"""What one call renders, as its caller gave it: the Gaussians, the cameras, and what is drawn in which way.

``rasterization``, ``rasterization_rgbt`` and ``project`` make these objects once, and everything behind them takes
them. Their fields have the shapes and the meaning of ``rasterization``'s arguments of the same names.
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from torch import Tensor

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED", "d", "Ed", "RGB-d", "RGB-Ed"]
RasterizeMode = Literal["classic", "antialiased"]
CameraModel = Literal["pinhole", "ortho", "fisheye", "ftheta"]


class Splats(NamedTuple):
    """The Gaussians."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    covars: Tensor | None = None
    thermal_opacities: Tensor | None = None
    """Second opacities, [..., N]; None: there is one opacity."""


class LensArguments(NamedTuple):
    """gsplat's arguments that describe lenses and shutters; their meaning is that of ``rasterization``'s."""

    with_ut: bool = False
    radial_coeffs: Tensor | None = None
    tangential_coeffs: Tensor | None = None
    thin_prism_coeffs: Tensor | None = None
    ftheta_coeffs: Any | None = None
    rolling_shutter: Any | None = None
    viewmats_rs: Tensor | None = None

    def is_asked_for(self, camera_model: str) -> bool:
        """Whether pixels' rays are others than those of a plain pinhole or orthographic camera."""
        coefficients = self[1:5]
        return (
            camera_model not in ("pinhole", "ortho")
            or self.viewmats_rs is not None
            or any(one is not None for one in coefficients)
        )


PLAIN = LensArguments()
"""Those of a camera without a lens, whose image is read out all at once."""


class Cameras(NamedTuple):
    """The cameras, which have the size of their images, planes, model and shutter in common."""

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    near_plane: float = 0.01
    far_plane: float = 1e10
    camera_model: CameraModel = "pinhole"
    lens: LensArguments = PLAIN


class BlendedValues(NamedTuple):
    """Something to be blended: final values, or coefficients of spherical harmonics."""

    values: Any
    """[..., (C,) N, X]; with ``sh_degree`` [..., (C,) N, K, 3], or the first coefficient and the others apart."""
    sh_degree: int | None
    """Active degree, or None of final values."""
    clamped: bool = True
    """Sums of spherical harmonics below 0 become 0, as those of colours do."""


class Drawn(NamedTuple):
    """What is drawn, and how."""

    values: Mapping[str, BlendedValues]
    """By the name that messages call it."""
    radius_clip: float = 0.0
    eps2d: float = 0.3
    tile_size: int = 16
    rasterize_mode: RasterizeMode = "classic"
    deterministic: bool = False
    global_z_order: bool = True
    distributed: bool = False
