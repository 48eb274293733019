"""What a model renders of one frame: the tensors that losses, metrics and densification read."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from thermosplat.scene.lens_distortion import distorted

if TYPE_CHECKING:
    from thermosplat.scene.formations.formation import Formation
    from thermosplat.scene.offloaded import GaussiansInView


LEAST_COVER = 0.9
"""Values of pixels that Gaussians cover less are not told: nothing is there. Open choice."""


@dataclass
class RenderedFrame:
    """The images of one exposure, and what they were decoded from, by spectrum; of those that were rendered."""

    images: dict[str, Tensor] = field(default_factory=dict)
    """Images, shape [H, W, channels]. Decoded ones lie in (0, 1), or reach beyond it by ``decoder.padding``. SH
    renders, and the raw sum of SH colour and decoded part, may exceed 1: the image losses see them as they are, so that
    saturated pixels keep their gradient; metrics and 8-bit images clamp them to [0, 1]."""
    formations: dict[str, "Formation"] = field(default_factory=dict)
    """How each image was formed, which says what losses it has; one without is compared as an image."""
    features: dict[str, Tensor] = field(default_factory=dict)
    """A_f, features rendered with the spectrum's opacities, shape [H, W, d]; empty for a model without features."""
    alphas: dict[str, Tensor] = field(default_factory=dict)
    """Accumulated opacity in [0, 1], shape [H, W, 1]."""
    log_depths: dict[str, Tensor] = field(default_factory=dict)
    """Blended log z [world units], Σ w log z, shape [H, W, 1]: over the accumulated opacity it is the mean. Where
    depths were asked for."""
    depth_spreads: list[Tensor] = field(default_factory=list)
    """How far depths spread along the rays of each opacity that was rendered, scalars; empty where not asked for."""
    infos: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    """What the rasterization says about every call (means2d, radii, ...), by the name of the Gaussian set. Under
    "spectra" an info names the spectra that the call was for. Densification reads it."""
    in_view: dict[str, "GaussiansInView"] = field(default_factory=dict)
    """By the name of the set, the Gaussians that were rendered of a set of which some is offloaded. What infos say is
    about these."""
    blank: list[Tensor] = field(default_factory=list)
    """Images of nothing, of calls that were made for the views of other ranks alone."""

    def covered(self) -> Tensor:
        """Where there is a surface in any of the spectra, bool [H, W]; all images are of one camera.

        Behind Gaussians lies black, which is the lowest value. A surface as cold as that may stay transparent in the
        thermal image, and its value is right all the same (benchmarks/records/map.md).
        """
        return torch.stack([alpha[..., 0] for alpha in self.alphas.values()]).amax(0) >= LEAST_COVER

    def include(self, part: "RenderedFrame") -> None:
        """Take over the images of another frame, and what they were made of; not what was said of calls.

        Args:
            part: Other spectra of the same exposure.
        """
        self.formations |= part.formations
        for held, found in (
            (self.images, part.images),
            (self.features, part.features),
            (self.alphas, part.alphas),
            (self.log_depths, part.log_depths),
        ):
            held.update(found)
        self.depth_spreads += part.depth_spreads

    def bend(self, spectrum: str, K: Tensor, coefficients: Tensor) -> None:
        """Resample all that was rendered of a spectrum as its lens shows it.

        Args:
            spectrum: Its name.
            K: Intrinsics [px], shape [3, 3].
            coefficients: k1 and k2, shape [2], as ``lens_distortion.distorted`` takes them.
        """
        holders = [
            images for images in (self.images, self.features, self.alphas, self.log_depths) if spectrum in images
        ]
        parts = [images[spectrum] for images in holders]
        bent = distorted(torch.cat(parts, dim=-1), K, coefficients)
        for images, part in zip(holders, bent.split([part.shape[-1] for part in parts], dim=-1), strict=True):
            images[spectrum] = part
