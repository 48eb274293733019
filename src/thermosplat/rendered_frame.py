"""What a model renders of one frame: the tensors that losses, metrics and densification read."""

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor


@dataclass
class RenderedFrame:
    """Both images of one exposure, and what they were decoded from; None where a spectrum was not rendered."""

    rgb: Tensor | None = None
    """RGB image, shape [H, W, 3]. The raw sum of SH colour and decoded part: it may exceed 1. The image losses see it
    as it is, so that saturated pixels keep their gradient; metrics and 8-bit images clamp it to [0, 1]."""
    thermal: Tensor | None = None
    """Thermal image, shape [H, W, thermal channels]; in (0, 1) where it is decoded, raw where it is an SH render."""
    visible_features: Tensor | None = None
    """A_f, features rendered with the visible opacities, shape [H, W, d]."""
    thermal_features: Tensor | None = None
    """A_ft, features rendered with the thermal opacities, shape [H, W, d]."""
    rgb_alpha: Tensor | None = None
    """Accumulated visible opacity in [0, 1], shape [H, W, 1]."""
    thermal_alpha: Tensor | None = None
    """Accumulated thermal opacity in [0, 1], shape [H, W, 1]."""
    depth_spreads: list[Tensor] = field(default_factory=list)
    """How far depths spread along the rays of each spectrum that was rendered, scalars; empty where not asked for."""
    infos: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    """What the rasterization says about every call (means2d, radii, ...), by the name of the Gaussian set; a set that
    was rendered by two calls has two, and under "modality" the spectrum that each is of. Densification reads it."""
