"""By how much training images change when the model does, and the most that may be left out of it within a tolerance.

The change of a spectrum's images is measured against their error: the mean squared difference to the renders from
before, divided by the mean squared difference of those to the ground truth. Where the two are independent, a change of
x costs 10 log10(1 + x) dB of the images' PSNR: 0.04 dB for 0.01. So what is noise in a capture sets the scale, in each
spectrum by itself, and nothing needs a threshold in units of its own.
"""

from collections.abc import Callable, Collection, Sequence

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.model import SceneModel


class ImageChange:
    """The images of a model as it is now, to compare later ones with.

    Args:
        model: The scene.
        frames: The frames to look at; their renders are kept on the device.
        sh_degree: Degree of the spherical harmonics in use.
        supervised: Further images to look at, which losses compare with the same ones: of "features_rgb" (A_f[:3]) and
            "features_thermal" (A_ft[3]).
    """

    def __init__(
        self, model: SceneModel, frames: Sequence[FrameTensors], sh_degree: int, supervised: Collection[str] = ()
    ) -> None:
        self.model = model
        self.frames = frames
        self.sh_degree = sh_degree
        self.supervised = supervised
        self._before = [self._images(frame) for frame in frames]
        errors: dict[str, list[Tensor]] = {}
        for frame, images in zip(frames, self._before, strict=True):
            for modality, target in _targets(frame).items():
                if modality in images:
                    errors.setdefault(modality, []).append((images[modality] - target).square().mean())
        self.errors = {modality: max(_mean(found), 1e-12) for modality, found in errors.items()}
        """Mean squared error of the images from before, by name of what has ground truth: "rgb", "thermal", and what is
        supervised beside them."""

    def now(self) -> float:
        """Squared change of the images since then, as a share of their squared error; the largest of all."""
        changes: dict[str, list[Tensor]] = {modality: [] for modality in self.errors}
        for frame, before in zip(self.frames, self._before, strict=True):
            images = self._images(frame)
            for modality in changes:
                if modality in images:
                    changes[modality].append((images[modality] - before[modality]).square().mean())
        return max((_mean(found) / self.errors[modality] for modality, found in changes.items()), default=0.0)

    @torch.no_grad()
    def _images(self, frame: FrameTensors) -> dict[str, Tensor]:
        """What the model renders of a frame, clamped to [0, 1], by modality."""
        rendered = self.model.render(frame.rgb, frame.thermal, sh_degree=self.sh_degree, aligned=frame.aligned)
        images = {"rgb": rendered.rgb, "thermal": rendered.thermal}
        if "features_rgb" in self.supervised and rendered.visible_features is not None:
            images["features_rgb"] = rendered.visible_features[..., :3]
        if "features_thermal" in self.supervised and rendered.thermal_features is not None:
            images["features_thermal"] = rendered.thermal_features[..., 3:4]
        return {modality: image.clamp(0.0, 1.0) for modality, image in images.items() if image is not None}


def most_within(change: ImageChange, most: int, apply: Callable[[int], None], tolerance: float) -> int:
    """The largest number of reductions whose change of the images stays within the tolerance, by bisection.

    Args:
        change: The images from before.
        most: The largest number there can be, >= 0.
        apply: Makes the model one with so many reductions, whatever it was made before.
        tolerance: Largest change.

    Returns:
        The number, to a thousandth of ``most``; the model is left with so many reductions.
    """
    within, beyond = 0, most + 1
    while beyond - within > max(1, most // 1000):
        middle = (within + beyond) // 2
        apply(middle)
        if change.now() <= tolerance:
            within = middle
        else:
            beyond = middle
    apply(within)
    return within


def _targets(frame: FrameTensors) -> dict[str, Tensor]:
    """What images are compared with, by name."""
    rgb = frame.rgb.image if frame.rgb is not None else None
    thermal = frame.thermal.image if frame.thermal is not None else None
    intensity = frame.thermal.intensity if frame.thermal is not None else None
    named = {"rgb": rgb, "thermal": thermal, "features_rgb": rgb}
    named["features_thermal"] = intensity[..., None] if intensity is not None else None
    return {name: target for name, target in named.items() if target is not None}


def _mean(values: list[Tensor]) -> float:
    return torch.stack(values).double().mean().item()
